"""Newest samples of a few channels in memory that two processes may share, without locks."""

from __future__ import annotations

import mmap

import numpy as np

from dtwin.schema import Floats

_CHANGES, _END, _WHOLE_FROM = 0, 1, 2
_COUNTERS_N = 8
_TRIES = 20


class SampleRing:
    """One writer, one reader.

    The writer makes a counter odd, writes, and makes it even again; the reader copies and looks
    whether the counter stayed the same and even.

    ``memory``: at least ``size(n_channels, capacity)`` bytes, zeroed.
    ``n_channels``, ``capacity``: channels, and samples kept of each.
    """

    def __init__(self, memory: mmap.mmap, n_channels: int, capacity: int) -> None:
        self._counters = np.frombuffer(memory, dtype=np.int64, count=_COUNTERS_N)
        words = np.frombuffer(memory, dtype=np.float64, offset=8 * _COUNTERS_N)
        self._read_s = words[:1]
        self._samples = words[1 : 1 + n_channels * capacity].reshape(n_channels, capacity)
        self._capacity = capacity

    @staticmethod
    def size(n_channels: int, capacity: int) -> int:
        """Return the bytes that a ring needs."""
        return 8 * (_COUNTERS_N + 1 + n_channels * capacity)

    @property
    def end(self) -> int:
        """Samples on the device's clock so far, lost ones included."""
        return int(self._counters[_END])

    def write(self, block: Floats, lost: int, read_s: float) -> None:
        """Add a block, shape (channels, n), that ``lost`` samples were lost before."""
        block = block[:, -self._capacity :]
        n = block.shape[1]
        self._counters[_CHANGES] += 1
        if lost:
            self._counters[_END] += lost
            self._counters[_WHOLE_FROM] = self._counters[_END]
        at = int(self._counters[_END]) % self._capacity
        first = min(n, self._capacity - at)
        self._samples[:, at : at + first] = block[:, :first]
        self._samples[:, : n - first] = block[:, first:]
        self._counters[_END] += n
        self._read_s[0] = read_s
        self._counters[_CHANGES] += 1

    def skip(self) -> None:
        """Begin anew after a gap of unknown length: no window spans it."""
        self._counters[_CHANGES] += 1
        self._counters[_END] += self._capacity
        self._counters[_WHOLE_FROM] = self._counters[_END]
        self._counters[_CHANGES] += 1

    def newest(self, into: Floats) -> tuple[int, float]:
        """Copy the newest samples to ``into``, shape (channels, n).

        Returns ``end``: samples on the device's clock up to the newest copied one; 0 when there are not yet n samples
        without a gap, or the writer did not keep still.
        Returns ``read_s``: monotonic time at which the newest sample was read.
        """
        n = into.shape[1]
        for _ in range(_TRIES):
            before = self._counters[_CHANGES]
            end = int(self._counters[_END])
            if end - n < self._counters[_WHOLE_FROM] or n > self._capacity:
                return 0, 0.0
            at = (end - n) % self._capacity
            first = min(n, self._capacity - at)
            into[:, :first] = self._samples[:, at : at + first]
            into[:, first:] = self._samples[:, : n - first]
            read_s = float(self._read_s[0])
            if before % 2 == 0 and before == self._counters[_CHANGES]:
                return end, read_s
        return 0, 0.0
