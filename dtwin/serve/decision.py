"""One decision: newest state and newest window in, one safe correction out."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter_ns
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import DtwinError, InputError
from dtwin.features.catalogue import feature_column
from dtwin.features.compiled import compiled
from dtwin.features.kernel import CONSTANT, NOT_FINITE, VALID
from dtwin.features.path_inputs import PATH_INPUTS, PathInputs
from dtwin.features.windows import WindowContract
from dtwin.links import layout
from dtwin.links.layout import LiveValues
from dtwin.schema import Floats
from dtwin.serve._state_limits import any_machine, impossible, possible
from dtwin.serve.direction import Direction
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import IMPOSSIBLE, OK, Guard

STANDARD_INPUTS: tuple[str, ...] = (*PATH_INPUTS, *layout.NAMES)
"""Inputs that follow from every controller's state."""

_TROUBLE = {VALID: "", CONSTANT: "stuck", NOT_FINITE: "not finite"}
SOUND, SATURATED = 0, 1
_FEWEST, _SHARE = 8, 0.05


class SensorSource(Protocol):
    """Newest sensor window, delivered without waiting."""

    @property
    def contract(self) -> WindowContract:
        """What the sensors deliver."""

    def newest_window(self) -> tuple[NDArray[np.floating] | None, float]:
        """Return a window (channels, n_samples) newer than the last one, or None, and its age.

        The age in s is that of the newest sample of the newest window, new or not;
        infinite before the first.
        """

    def fault(self) -> DtwinError | None:
        """Return why no more windows come, or None."""

    @property
    def over(self) -> bool:
        """Whether they will never come again."""


class Decision:
    """Features, equation, direction and safety of one served bundle.

    Args:
        tcp_mm: Tool centre point in the flange frame, for the levers of the joints. Shape (3,).
        sensors: Required when the bundle has feature inputs.
        live: Inputs that the control sends beside its state.
        largest: Largest magnitudes in a state of this machine; see :mod:`dtwin.serve._state_limits`. Shape (N,).

    Attributes:
        hold (bool): Whether the correction is held at zero, as for a machine that stands still.
        sensor_trouble (str): Which channel of the newest window is stuck, saturated or not finite; empty when none is.

    Raises:
        InputError: When the bundle wants an input that nothing here provides, or other windows.
    """

    def __init__(
        self,
        compiled: CompiledBundle,
        tcp_mm: Floats,
        covariates: Mapping[str, float] | None = None,
        sensors: SensorSource | None = None,
        live: LiveValues | None = None,
        largest: Floats | None = None,
    ) -> None:
        bundle = compiled.bundle
        sent = live or LiveValues({})
        self.compiled, self.sensors = compiled, sensors
        self._largest = any_machine() if largest is None else largest
        self._nothing, self._impossible = np.zeros(3), ""
        self._path = PathInputs(dict(layout.INDEX), tcp_mm)
        given = dict(covariates or {})
        n_path = len(PATH_INPUTS)
        names = [*STANDARD_INPUTS, *given, *sent.names]
        self._pool = np.zeros(len(names))
        self._path.values = self._pool[:n_path]
        self._state = self._pool[n_path : n_path + layout.N]
        first_live = n_path + layout.N + len(given)
        self._pool[n_path + layout.N : first_live] = list(given.values())
        self._sent, self._live = sent, self._pool[first_live:]
        missing = [name for name in bundle.tick_inputs if name not in names]
        if missing:
            raise InputError(
                "the model wants inputs that this machine does not provide",
                code="serve.inputs",
                got=", ".join(missing)[:200],
                hint="a control that sends them: dtwin serve --link axes --states HOST:PORT; "
                "or --covariate NAME=NUMBER",
            )
        self._take = np.array([names.index(n) for n in bundle.tick_inputs], dtype=np.int64)
        n_tick, n_features = len(bundle.tick_inputs), len(bundle.feature_inputs)
        self._inputs = np.zeros(n_tick + n_features)
        self._tick, self._features = self._inputs[:n_tick], self._inputs[n_tick:]
        boxes = {i.name: (i.low, i.high) for i in bundle.inputs}
        order = (*bundle.tick_inputs, *bundle.feature_inputs)
        box = np.array([boxes[name] for name in order]).reshape(-1, 2)
        self.guard = Guard(bundle.safety, box[:, 0], box[:, 1])
        self.direction = Direction(bundle.outputs)
        self._banded = bundle.band is not None
        self.window_age_s = 0.0
        self.hold = self._windowed = False
        self.sensor_trouble = ""
        self._prepare_window(sensors)
        self._warm_up()

    @property
    def band_um(self) -> Floats:
        """Half width (3,) of the newest wanted correction, k = 2, along base x, y, z; NaN where nobody knows it."""
        return self.direction.band_um

    @property
    def trouble(self) -> str:
        """What is impossible in the newest state, or else not finite: a channel, values that are old."""
        if self.guard.reason == IMPOSSIBLE:
            return self._impossible
        return self.sensor_trouble or ", ".join(self._sent.old())

    def _prepare_window(self, sensors: SensorSource | None) -> None:
        bundle = self.compiled.bundle
        self._uses_window = bool(bundle.feature_inputs)
        if not self._uses_window or bundle.window is None:
            return
        contract = bundle.window
        if sensors is None or sensors.contract != contract:
            raise InputError(
                "the model needs sensor windows that are not delivered",
                code="serve.sensors",
                got="no sensors" if sensors is None else str(sensors.contract.to_dict())[:300],
                allowed=str(contract.to_dict())[:300],
                hint="name the channel file of the sensors: dtwin serve --sensors FILE",
            )
        shape = len(contract.channels), len(contract.features)
        self._kernel, self._samples = contract.kernel(), np.zeros((shape[0], contract.n_samples))
        self._values, self._codes = np.zeros(shape), np.zeros(shape[0], dtype=np.int64)
        columns = [feature_column(c, f) for c in contract.channels for f in contract.features]
        self._picked = np.array([columns.index(n) for n in bundle.feature_inputs], dtype=np.int64)
        self._channel, self._names = self._picked // shape[1], contract.channels

    def _warm_up(self) -> None:
        """Have every kernel loaded before the first tick, where loading would cost deadlines."""
        if self._uses_window:
            n = self._kernel.n_samples
            self._kernel.compute(self._samples.reshape(-1), 0, n, self._values, self._codes)
            _saturated_kernel(self._samples[0])
            self.compiled.window(self._features)
        uses, self._uses_window = self._uses_window, False
        stages, state = np.zeros(6, dtype=np.int64), layout.empty_state()
        self.decide(state, age_s=0.0, elapsed_s=0.0, enabled=False, stages=stages)
        self._uses_window = uses
        self.guard.reset()
        self.reset()
        # What it was shown of no machine counts for nothing.
        self.direction = Direction(self.compiled.bundle.outputs)

    def reset(self) -> None:
        """Start a new run: path angle, equation state and newest window are forgotten."""
        self._path.reset()
        self.compiled.reset()
        # An equation that remembers must not remember what it made of no window.
        self._windowed = False
        self.compiled.outputs[:] = 0.0

    def decide(
        self,
        state: Floats,
        *,
        age_s: float,
        elapsed_s: float,
        enabled: bool,
        stages: NDArray[np.int64],
        found: int = OK,
    ) -> Floats:
        """Return the safe correction (3,) in um for the newest state.

        Args:
            state: State of the controller. Shape (N,).
            age_s: Age of the state.
            elapsed_s: Time since the last decision.
            enabled: Whether a correction is wanted; false releases.
            stages: Receives the nanoseconds of window, path, equation and guard in its first four. Shape (6,).
            found: What the caller has found, as for ``safety._guard_kernel``.
        """
        start = perf_counter_ns()
        if not possible(state, self._largest):
            self._impossible = impossible(state, self._largest)
            # What remembers must not remember this.
            self.reset()
            stages[:4] = 0
            return self.guard.step(
                self._nothing, self._inputs, age_s=age_s, elapsed_s=elapsed_s, enabled=enabled, found=IMPOSSIBLE
            )
        if self._uses_window:
            self._take_window()
        windowed = perf_counter_ns()
        self._state[:] = state
        # The feed that the program asks for is not the one that the slider leaves of it.
        self._state[layout.FEED] *= state[layout.SPEED_SCALING]
        self._live[:] = self._sent.values
        self._path.update(self._state)
        np.take(self._pool, self._take, out=self._tick, mode="clip")
        self.compiled.tick_inputs[:] = self._tick
        pathed = perf_counter_ns()
        # What remembers must not remember what a broken sensor reads: no number would stay none, and 850 °C for minutes.
        if (self._windowed or not self._uses_window) and self.guard.trust(self._inputs) > 0.0:
            self.compiled.evaluate()
        evaluated = perf_counter_ns()
        wanted = self.direction.apply(self.compiled.outputs, self._pool[0], state[layout.PLANE_ID])
        if self._banded:
            self.direction.apply_band(self.compiled.band_um, self._pool[0], state[layout.PLANE_ID])
        device_ok = not self.hold and state[layout.RUNTIME_RUNNING] > 0.5 and state[layout.SAFETY_OK] > 0.5
        safe = self.guard.step(
            wanted,
            self._inputs,
            age_s=age_s,
            elapsed_s=elapsed_s,
            window_age_s=self.window_age_s,
            enabled=enabled,
            device_ok=bool(device_ok),
            found=found,
        )
        stages[0], stages[1] = windowed - start, pathed - windowed
        stages[2], stages[3] = evaluated - pathed, perf_counter_ns() - evaluated
        return safe

    def release(self, *, elapsed_s: float, age_s: float = 0.0, enabled: bool = False, found: int = OK) -> Floats:
        """Return the next correction when there is no usable state: towards zero.

        Args:
            age_s: Age of the last state; beyond the limit it counts as a fault.
            enabled: False for a wanted release, true while the source is silent.
            found: As in ``decide``.
        """
        return self.guard.step(
            self.direction.vector_um,
            self._inputs,
            age_s=age_s,
            elapsed_s=elapsed_s,
            window_age_s=self.window_age_s,
            enabled=enabled,
            found=found,
        )

    def _take_window(self) -> None:
        assert self.sensors is not None
        block, self.window_age_s = self.sensors.newest_window()
        if block is None:
            return
        self._samples[:] = block
        n = self._kernel.n_samples
        self._kernel.compute(self._samples.reshape(-1), 0, n, self._values, self._codes)
        np.take(self._values.reshape(-1), self._picked, out=self._features, mode="clip")
        self.sensor_trouble = ""
        for k in range(len(self._picked)):
            # A dead or broken channel must stop the correction, not feed it zeros.
            channel = self._channel[k]
            wrong = _TROUBLE[self._codes[channel]]
            if not wrong and _saturated_kernel(self._samples[channel]) == SATURATED:
                wrong = "saturated"
            if wrong:
                self._features[k] = np.nan
                self.sensor_trouble = f"{self._names[channel]}: {wrong}"
        self.compiled.window(self._features)
        self._windowed = True


@compiled
def _saturated_kernel(samples: Floats) -> int:
    """Return SATURATED when a signal stands at its own highest or lowest value too often.

    Neither noise nor a sine of a hundred steps or more has a twentieth of its samples at exactly
    one extreme; a signal that was cut at the end of a range has. The range need not be known.
    Rare peaks that are cut are not found.

    ``samples``, (n,): newest window of one channel.
    """
    n = samples.shape[0]
    high = low = samples[0]
    tops = bottoms = 0
    for i in range(n):
        x = samples[i]
        if x > high:
            high, tops = x, 0
        if x < low:
            low, bottoms = x, 0
        tops += 1 if x == high else 0
        bottoms += 1 if x == low else 0
    if high == low:
        return SOUND
    return SATURATED if max(tops, bottoms) >= max(_FEWEST, _SHARE * n) else SOUND
