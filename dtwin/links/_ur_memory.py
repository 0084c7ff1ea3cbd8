"""Memory that the host and its UR driver process share, without locks.

Each direction has one writer and one reader. A writer makes its counter odd, writes, and
makes it even again; a reader copies and looks whether the counter stayed the same and even.
Python keeps the order of these stores, and so do the processors that ``ur_rtde`` is built for
(x86-64; on others a reader may see a torn value at worst once, with a stale counter).
"""

from __future__ import annotations

import mmap
import os

import numpy as np
from numpy.typing import NDArray

from dtwin.links import layout

_Floats = NDArray[np.float64]

_STATE_COUNT, _CORRECTION_COUNT = 0, 1
_COUNTERS_N = 8
_STATE_AT = _COUNTERS_N
_CORRECTION_AT = _STATE_AT + layout.N + 1
_WORDS = _CORRECTION_AT + layout.REGISTERS_N
_SIZE = 8 * _WORDS
_TRIES = 100


class SharedMemory:
    """Newest state (driver to host) and newest correction (host to driver).

    ``descriptor``: anonymous memory file of at least ``_SIZE`` bytes.
    """

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, _SIZE)
        self._counters = np.frombuffer(self._map, dtype=np.int64, count=_COUNTERS_N)
        words = np.frombuffer(self._map, dtype=np.float64, count=_WORDS)
        self._state = words[_STATE_AT:_CORRECTION_AT]
        self._correction = words[_CORRECTION_AT:]

    @staticmethod
    def create() -> int:
        """Return the descriptor of new, zeroed memory."""
        descriptor = os.memfd_create("dtwin-ur")
        os.ftruncate(descriptor, _SIZE)
        return descriptor

    def write_state(self, state: layout.RobotState, received_s: float) -> None:
        """Publish a state and the monotonic time at which the driver saw it."""
        self._counters[_STATE_COUNT] += 1
        self._state[:-1] = state
        self._state[-1] = received_s
        self._counters[_STATE_COUNT] += 1

    def read_state(self, into: _Floats) -> int:
        """Copy the newest state and its time to ``into``, shape (N + 1,); return its number.

        0 when there is none, or the driver did not keep still.
        """
        return self._read(_STATE_COUNT, self._state, into)

    def write_correction(self, sequence: int, offset_um: _Floats) -> None:
        """Publish a correction."""
        self._counters[_CORRECTION_COUNT] += 1
        self._correction[layout.REGISTER_SEQUENCE] = sequence
        self._correction[layout.REGISTER_OFFSET :] = offset_um
        self._counters[_CORRECTION_COUNT] += 1

    def read_correction(self, into: _Floats) -> int:
        """Copy the newest correction to ``into``, shape (4,); return its number, 0 for none."""
        return self._read(_CORRECTION_COUNT, self._correction, into)

    def _read(self, counter: int, source: _Floats, into: _Floats) -> int:
        for _ in range(_TRIES):
            before = self._counters[counter]
            into[:] = source
            if before % 2 == 0 and before == self._counters[counter]:
                return int(before) // 2
        return 0
