"""Windows of signals that a control samples itself and sends with its states."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import DtwinError
from dtwin.features.windows import WindowContract
from dtwin.schema import Floats


class ChannelWindows:
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
