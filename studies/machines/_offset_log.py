"""What the virtual controller's program commanded, tick by tick, and when it last heard anything."""

from __future__ import annotations

import numpy as np

from dtwin.schema import Floats

_LENGTH = 30_000


class OffsetLog:
    """The newest minute of commanded offsets."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._rows = np.zeros((_LENGTH, 7))
        self._n = self._tick = 0
        self.cut_tick = -1

    def add(self, tick: int, sequence: float, commanded_um: Floats, latched_um: Floats) -> None:
        """Remember one tick."""
        row = self._rows[self._n % _LENGTH]
        row[0] = sequence
        row[1:4] = commanded_um
        row[4:7] = latched_um
        self._n += 1
        self._tick = tick

    def save(self, path: str) -> None:
        """Write ticks, sequence numbers, commanded and received offsets, and the tick of the last cut.

        ``path``: file to write, as ``.npz``.
        """
        kept = min(self._n, _LENGTH)
        order = np.arange(self._n - kept, self._n)
        rows = self._rows[order % _LENGTH]
        np.savez(
            path,
            tick=order + (self._tick + 1 - self._n),
            sequence=rows[:, 0],
            commanded_um=rows[:, 1:4],
            received_um=rows[:, 4:7],
            cut_tick=self.cut_tick,
            period_s=self._period_s,
        )
