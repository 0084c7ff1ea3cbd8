"""A NARX baseline: the tool's error from lagged commands and its own lagged values, run freely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from dtwin.features.sine import fit_tone, lag_deg
from dtwin.features.tone_window import HORIZON_S
from dtwin.kinds.sinusoidal._groups import ToneGroups
from dtwin.schema import Floats

_EVERY = 4
_RIDGE = 1e-9
_EXPLODED_UM = 1e4


@dataclass(frozen=True)
class Narx:
    """Linear in its lags, which is what a linear slide asks for.

    ``own``, ``command``: weights of earlier errors, and of the command now and earlier.
    ``rate_hz``: samples a second of the model.
    """

    LAGS: ClassVar[int] = 6
    own: Floats
    command: Floats
    rate_hz: float

    @classmethod
    def fitted(cls, groups: ToneGroups) -> Narx:
        """Fit one step ahead on every sample of the groups, by ridge regression."""
        n = cls.LAGS
        size = 2 * n + 1
        gram, moment = np.zeros((size, size)), np.zeros(size)
        for trace in groups.traces:
            command, error = trace[0, ::_EVERY], (trace[1] - trace[0])[::_EVERY]
            lagged = [error[n - k : -k] for k in range(1, n + 1)]
            driven = [command[n - k : len(command) - k] for k in range(n + 1)]
            design = np.column_stack([*lagged, *driven])
            gram += design.T @ design
            moment += design.T @ error[n:]
        weights = np.linalg.solve(gram + _RIDGE * np.trace(gram) * np.eye(size), moment)
        return cls(weights[:n], weights[n:], groups.contract.rate_hz / _EVERY)

    def errors(self, trace: Floats, frequency_hz: float) -> tuple[float, float]:
        """Return amplitude error in um and lag in degrees of the last second, from the command alone.

        ``trace``, (2, n): command and tool; only the command is used.
        """
        # As everywhere: importing it takes half a second, which most commands can do without.
        from scipy.signal import lfilter

        command = trace[0, ::_EVERY]
        error = lfilter(self.command, np.concatenate([[1.0], -self.own]), command)
        tool = command + np.clip(np.nan_to_num(error), -_EXPLODED_UM, _EXPLODED_UM)
        t = np.arange(len(command)) / self.rate_hz
        last = t >= t[-1] - HORIZON_S
        sent, followed = (fit_tone(t[last], v[last], frequency_hz) for v in (command, tool))
        return followed.amplitude - sent.amplitude, lag_deg(sent, followed)
