"""What a model needs of a control that sends its inputs: values, sampled channels, a watch over tones."""

from __future__ import annotations

from collections.abc import Collection

from dtwin.features.tone_window import COMMAND_PHASE, COMMANDED, SENT
from dtwin.links.live_values import LiveValues
from dtwin.schema import Floats
from dtwin.serve._channel_windows import ChannelWindows
from dtwin.serve._tone_watch import ToneWatch
from dtwin.serve.bundle import Bundle
from dtwin.serve.decision import STANDARD_INPUTS


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
        self.windows = ChannelWindows(window) if window else None
        self.channels = window.channels if window else ()
        self.channels_hz = window.rate_hz if window else 0.0
        self.watch: ToneWatch | None = None
        wanted = {name: rates[name] for name in asked}
        if window and COMMAND_PHASE in asked and SENT in self.channels:
            self.watch = ToneWatch(window.hop)
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
