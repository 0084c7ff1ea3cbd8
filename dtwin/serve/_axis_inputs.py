"""What a model needs of a control that sends its inputs: values, sampled channels, a watch over tones."""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import DtwinError
from dtwin.features.tone_window import COMMAND_PHASE, COMMANDED, SENT
from dtwin.features.windows import WindowContract
from dtwin.links.layout import LiveValues
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import STANDARD_INPUTS
from dtwin.serve.divergence import DivergenceWatch


class AxisInputs:
    """Values, windows and watch of one served bundle.

    ``given``: covariates whose values the user gave.
    ``sensors``: whether windows come from elsewhere.
    ``live``: the inputs that the control sends.
    ``windows``: windows of channels that the control samples.
    ``watch``: for a model of tones.
    """

    def __init__(self, bundle: Bundle, given: Collection[str], *, sensors: bool) -> None:
        rates = {i.name: i.rate_hz for i in bundle.inputs}
        asked = [n for n in bundle.tick_inputs if n not in STANDARD_INPUTS and n not in given]
        window = None if sensors else bundle.window
        self.windows = _ChannelWindows(window) if window else None
        self.channels = window.channels if window else ()
        self.channels_hz = window.rate_hz if window else 0.0
        self.watch: _ToneWatch | None = None
        wanted = {name: rates[name] for name in asked}
        if window and COMMAND_PHASE in asked and SENT in self.channels:
            self.watch = _ToneWatch(window.hop)
            wanted[COMMANDED] = window.rate_hz
        self.live = LiveValues(wanted)
        self._of_watch = [self.live.names.index(n) if self.watch else 0 for n in (COMMANDED, COMMAND_PHASE)]
        self._sent = self.channels.index(SENT) if self.watch else 0

    def sample(self, values: Floats) -> None:
        """Take one sample of each channel, shape (channels,)."""
        if self.windows is not None:
            self.windows.push(values)
        if self.watch is not None:
            commanded, phase = self.live.values[self._of_watch].tolist()
            self.watch.sample(commanded, float(values[self._sent]), phase)

    def forget(self) -> None:
        """Begin anew, as when another part of the program begins."""
        if self.windows is not None:
            self.windows.forget()
        if self.watch is not None:
            self.watch.forget()


class _ToneWatch:
    """Feeds a :class:`DivergenceWatch` from the samples of a control.

    ``n``: samples of one hop.
    ``left_um``: error that the newest window foretold; NaN before the first.
    """

    def __init__(self, n: int) -> None:
        self._rows = np.zeros((n, 3))
        self._seen = 0
        self._watch = DivergenceWatch()
        self.left_um = math.nan

    @property
    def alarm(self) -> str:
        """Why the correction must be released; empty while all is well."""
        return self._watch.alarm

    def sample(self, commanded_um: float, sent_um: float, phase_rad: float) -> None:
        """Take what was commanded, what was sent, and the phase of the command."""
        self._rows[self._seen % len(self._rows)] = commanded_um, sent_um, phase_rad
        self._seen += 1

    def window(self, told: Mapping[str, float], *, inside: bool) -> str:
        """Judge a new window; return the alarm, empty while all is well.

        ``told``: what the window told: ``gain_1`` and ``phase_error_rad``.
        ``inside``: whether it lies in the validity box.
        """
        if self._seen < len(self._rows):
            return self.alarm
        phase = self._rows[:, 2]
        design = np.column_stack([np.sin(phase), np.cos(phase), np.ones_like(phase)])
        coefficients = np.linalg.lstsq(design, self._rows[:, :2], rcond=None)[0]
        wanted, given = (complex(coefficients[0, k], coefficients[1, k]) for k in range(2))
        follows = told["gain_1"] * cmath.exp(-1j * told["phase_error_rad"])
        self.left_um = abs(given * follows - wanted)
        return self._watch.window(self.left_um, inside=inside)

    def forget(self) -> None:
        """Begin anew with another tone."""
        self._seen, self._watch = 0, DivergenceWatch()


class _ChannelWindows:
    """The newest window of sampled channels, a hop after the one before.

    ``ready``: whether a whole window has come since the last :meth:`forget`.
    """

    def __init__(self, contract: WindowContract) -> None:
        self._contract = contract
        n = contract.n_samples
        # Twice as long as a window, so that the newest one always lies in one piece.
        self._ring = np.zeros((len(contract.channels), 2 * n))
        self._window = np.zeros((len(contract.channels), n))
        self._seen, self._since, self._fresh = 0, 0, False
        self.ready = False

    @property
    def contract(self) -> WindowContract:
        """What the windows are."""
        return self._contract

    def push(self, sample: Floats) -> None:
        """Take one sample of each channel, shape (channels,)."""
        n = self._contract.n_samples
        place = self._seen % n
        self._ring[:, place] = self._ring[:, place + n] = sample
        self._seen += 1
        self._since += 1
        if self._seen >= n and (self._seen - n) % self._contract.hop == 0:
            first = self._seen % n
            self._window[:] = self._ring[:, first : first + n]
            self.ready, self._fresh, self._since = True, True, 0

    def forget(self) -> None:
        """Begin anew, as when something else is measured from now on."""
        self._seen, self._since, self._fresh, self.ready = 0, 0, False, False

    def newest_window(self) -> tuple[NDArray[np.floating] | None, float]:
        """Return a window (channels, n_samples) that was not given before, or None, and its age in s."""
        if not self.ready:
            return None, math.inf
        fresh, self._fresh = self._fresh, False
        return self._window if fresh else None, self._since / self._contract.rate_hz

    def fault(self) -> DtwinError | None:
        """Return None: a control that samples no more is seen by its silence."""
        return None

    @property
    def over(self) -> bool:
        """Whether no window will come again: that is not known here."""
        return False
