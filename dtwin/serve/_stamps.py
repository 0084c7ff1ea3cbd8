"""Whether a controller's stamps go on as the own clock does."""

from __future__ import annotations

import math

JUMP_S = 0.5
"""A stamp that is so much ahead of where it should be, or 1.5 times as much behind, has jumped."""

SETTLE_S = 1.0
"""How long stamps must have gone on steadily, after a jump, before states count again."""

# A clock that goes so much slower is still a clock: 1 ms in a second.
_DRIFT = 1e-3


class StampWatch:
    """Compares each stamp with the time at which its state was received.

    ``jump_s``: how far the newest stamp was from where it should have been; 0 while all is well.
    """

    def __init__(self) -> None:
        self._ahead_s = self._last_s = self._received_s = math.nan
        self._free_at_s = -math.inf
        self.jump_s = 0.0

    def repeats(self, stamp_s: float) -> bool:
        """Tell whether a stamp is the one of the state before: nothing new has come."""
        return stamp_s == self._last_s

    def steady(self, stamp_s: float, received_s: float, *, fresh: bool) -> bool:
        """Tell whether a state counts by its stamp.

        ``received_s``: monotonic time at which the state was received.
        ``fresh``: whether it is known otherwise that the state is new, so that after a jump another reckoning can
        begin. Without, states that lag stay old.
        """
        self.jump_s = 0.0
        ahead_s = stamp_s - received_s
        if not math.isfinite(ahead_s):
            return False
        if math.isnan(self._ahead_s):
            self._ahead_s, self._last_s, self._received_s = ahead_s, stamp_s, received_s
            return True
        since_s = max(received_s - self._received_s, 0.0)
        wrong_s = ahead_s - self._ahead_s
        backwards = stamp_s < self._last_s
        self._last_s, self._received_s = stamp_s, received_s
        if backwards or not -1.5 * JUMP_S <= wrong_s <= JUMP_S:
            self.jump_s = wrong_s
            self._free_at_s = received_s + SETTLE_S
            if fresh:
                self._ahead_s = ahead_s
            return False
        self._ahead_s = max(ahead_s, self._ahead_s - _DRIFT * since_s)
        return received_s >= self._free_at_s
