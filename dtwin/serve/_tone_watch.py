"""Whether the correction of a tone settles: what each window foretells of the corrected motion."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping

import numpy as np

from dtwin.serve.divergence import DivergenceWatch


class ToneWatch:
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
