"""The way to a machine: a link of the kind that was asked for, once what answers was judged."""

from __future__ import annotations

import dataclasses
import time

from dtwin.config import Home
from dtwin.errors import DeviceError, GateRefusal, InputError
from dtwin.links.axis_link import AxisLink, Clock, Greeting
from dtwin.links.ur import UrLink
from dtwin.links.virtual_key import proves
from dtwin.serve._axis_inputs import AxisInputs
from dtwin.serve._machine_serving import RATE_HZ, OpenLink
from dtwin.serve.analogue_link import AnalogueLink
from dtwin.serve.bundle import Bundle
from dtwin.serve.controller_kind import is_loopback, is_virtual
from dtwin.serve.loop import Mode
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.serve_request import ServeRequest

_TRIAL_SHARE = 0.25
"""Share of a bundle's clamp that a trial may use."""

_TRY_S = 0.2


class Connection:
    """Opens a link to a robot or a board.

    ``bundle``: its evidence decides what may be moved.
    ``trial``: whether the clamp is tightened.
    ``device``: what answered.
    ``realtime``: whether the newest driver was given real-time priority.
    """

    def __init__(self, request: ServeRequest, bundle: Bundle, trial: bool) -> None:
        self._request, self._bundle, self._trial = request, bundle, trial
        self.device, self.realtime = "", False

    @property
    def finished(self) -> bool:
        """Whether the machine said that its program has ended; only axis links know."""
        return False

    @property
    def rate_hz(self) -> float:
        """Of the machine's states."""
        return self._request.serving().rate_hz

    def close(self) -> None:
        """Close what nobody has taken over."""

    def __call__(self) -> OpenLink:
        """Return an open link to what may be served."""
        request = self._request
        writes = request.mode != "shadow"
        if request.analogue is not None:
            # Nothing that a serial port answers proves that no machine hangs on it.
            self.judge("real")
            return AnalogueLink(request.analogue, writes=writes, moves=request.mode == "live")
        link = UrLink(request.host, RATE_HZ, realtime=request.priority > 0, writes=writes)
        try:
            self.judge("virtual" if is_virtual(link.host) else "real")
        except BaseException:
            link.close()
            raise
        self.realtime = link.realtime
        return link

    def judge(self, device: str) -> None:
        """Take what answered, and refuse what the evidence does not carry."""
        self.device = device
        _require_evidence(self._bundle, device, mode=self._request.mode, trial=self._trial)


class AxisConnection(Connection):
    """Opens a link to a control that takes offsets of its axes.

    ``request``, ``bundle``, ``trial``: as for :class:`Connection`.
    ``home``: where the key of virtual machines lies.
    """

    def __init__(self, request: ServeRequest, bundle: Bundle, trial: bool, inputs: AxisInputs, home: Home) -> None:
        super().__init__(request, bundle, trial)
        self._address, self._writes = str(request.axes), request.mode != "shadow"
        self._inputs, self._home = inputs, home
        self._axes = tuple(dict.fromkeys(_axis_of(o.frame) for o in bundle.outputs))
        self._link: AxisLink | None = None
        self._taken = False

    @property
    def finished(self) -> bool:
        """Whether the control said that its program has ended."""
        return self._link is not None and self._link.finished

    @property
    def clock(self) -> Clock:
        """Clock of the control, once it has greeted."""
        return self.greet().clock

    @property
    def rate_hz(self) -> float:
        """Of the control's states, as it says itself."""
        return 1.0 / self.greet().period_s

    def greet(self) -> Greeting:
        """Return what the control says of itself; connects to it when nobody has, with patience."""
        until_s = time.monotonic() + self._request.patience_s
        while self._link is None:
            try:
                self._link = self._opened()
            except DeviceError as error:
                if error.code != "states.absent" or time.monotonic() >= until_s:
                    raise
                time.sleep(_TRY_S)
        return self._link.greeting

    def __call__(self) -> AxisLink:
        """Return the link that greeted, or another one after it was lost."""
        if self._link is None or self._taken:
            self._link = self._opened()
        self._taken = True
        return self._link

    def close(self) -> None:
        """Close the newest link."""
        if self._link is not None:
            self._link.close()

    def _opened(self) -> AxisLink:
        inputs = self._inputs
        # No window spans the time in which nothing came.
        inputs.forget()
        link = AxisLink(
            self._address,
            inputs.live,
            self._axes,
            channels=inputs.channels,
            channels_hz=inputs.channels_hz,
            samples=inputs.sample if inputs.channels else None,
            writes=self._writes,
        )
        link.open()
        try:
            proven = is_loopback(link.host) and proves(self._home, link.nonce, link.greeting.proof)
            self.judge("virtual" if proven else "real")
        except BaseException:
            link.close()
            raise
        return link


def _axis_of(frame: str) -> str:
    kind, _, axis = frame.partition("_")
    if kind != "base":
        raise InputError(
            "the model corrects along a path, not along axes",
            code="serve.axes",
            got=frame,
            allowed="base_x, base_y, base_z",
            hint="serve it without --link axes",
        )
    return axis


def with_trial_clamp(compiled: CompiledBundle) -> CompiledBundle:
    """Return the model with a quarter of its clamp."""
    safety = compiled.bundle.safety
    return compiled.limited(dataclasses.replace(safety, clamp_um=_TRIAL_SHARE * safety.clamp_um))


def _require_evidence(bundle: Bundle, device: str, *, mode: Mode, trial: bool) -> None:
    """Refuse to move a real device on evidence from a virtual one, outside a trial."""
    evidence = bundle.provenance.evidence
    if device == "virtual" or mode != "live" or trial or evidence == "real":
        return
    raise GateRefusal(
        "the model was never shown to help a real machine",
        code="serve.evidence",
        got=f"evidence: {evidence}",
        allowed="evidence: real",
        hint="try it under a tight clamp with --trial, or look at it with --shadow",
    )
