"""Timing of the loop in buffers that are allocated once, and whether a controller's stamps go on as the own clock does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STAGES = ("window", "path", "equation", "guard", "send", "total")
_EDGES_US = (0, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)


class LoopTiming:
    """Stage times, period, ages and late ticks of the newest ticks."""

    def __init__(self, period_s: float, capacity: int = 65536) -> None:
        self.period_s = period_s
        self.ticks = 0
        self.late = 0
        self.missed = 0
        self.timeouts = 0
        self._stages: NDArray[np.int64] = np.zeros((capacity, len(_STAGES)), dtype=np.int64)
        self._interval_s = np.zeros(capacity)
        self._age_s = np.zeros(capacity)
        self._window_age_s = np.zeros(capacity)
        self._answer_s = np.full(capacity, np.nan)
        self._stamp_s = np.full(capacity, np.nan)
        self._was_late: NDArray[np.bool_] = np.zeros(capacity, dtype=bool)
        self._sequence: NDArray[np.int64] = np.full(capacity, -1, dtype=np.int64)
        self._place: NDArray[np.int64] = np.zeros(capacity, dtype=np.int64)
        self._applied = 0

    def stages(self) -> NDArray[np.int64]:
        """Return the row (stages,) of nanoseconds that the current tick fills."""
        return self._stages[self.ticks % len(self._stages)]

    def applied(self, sequence: int, stamp_s: float) -> None:
        """Take from a state which correction it was made with.

        A correction that the controller first used more than two of its periods after the state
        that it was computed from is late, whatever held it up on the way.

        ``sequence``: number of the correction in force; 0 when there is none.
        """
        if sequence in (0, self._applied):
            return
        capacity = len(self._sequence)
        news = min(max(sequence - self._applied, 1), self.ticks, capacity)
        for number in range(sequence - news + 1, sequence + 1):
            if self._sequence[number % capacity] == number:
                place = int(self._place[number % capacity])
                self._answer_s[place] = stamp_s - self._stamp_s[place]
                if self._answer_s[place] > 2.5 * self.period_s:
                    self._count_late(place)
        self._applied = sequence

    def tick(
        self,
        interval_s: float,
        state_step_s: float,
        age_s: float,
        window_age_s: float,
        *,
        stamp_s: float = np.nan,
        sequence: int = 0,
    ) -> None:
        """Close a tick; late is a correction that was ready more than a period after its state.

        ``interval_s``: wall time since the tick before; NaN for the first.
        ``state_step_s``: step of the controller's own stamp since the tick before; NaN for the first.
        ``age_s``, ``window_age_s``: age of the state when its correction was ready, and of the newest window.
        ``stamp_s``: the controller's stamp of the state.
        ``sequence``: number of the correction that was sent, for ``applied``; 0 when none was.
        """
        place = self.ticks % len(self._interval_s)
        self._stamp_s[place], self._answer_s[place] = stamp_s, np.nan
        self._was_late[place] = False
        if sequence:
            at = sequence % len(self._sequence)
            self._sequence[at], self._place[at] = sequence, place
        self._interval_s[place] = interval_s
        self._age_s[place] = age_s
        self._window_age_s[place] = window_age_s
        if state_step_s > 1.5 * self.period_s:
            self.missed += round(state_step_s / self.period_s) - 1
        if age_s > self.period_s:
            self._count_late(place)
        self.ticks += 1

    def late_stamps_s(self) -> NDArray[np.float64]:
        """Return the controller's stamps of the late ticks that are remembered."""
        return self._stamp_s[self._was_late]

    def _count_late(self, place: int) -> None:
        if not self._was_late[place]:
            self._was_late[place] = True
            self.late += 1

    @property
    def late_share(self) -> float:
        """Share of the controller's ticks that were answered late or not at all."""
        answered_or_missed = self.ticks + self.missed
        return (self.late + self.missed) / answered_or_missed if answered_or_missed else 0.0

    def summary(self) -> dict[str, Any]:
        """Return counts, percentiles and the jitter histogram, JSON-ready."""
        n = min(self.ticks, len(self._interval_s))
        interval = _finite(self._interval_s[:n])
        jitter_us = np.abs(interval - self.period_s) * 1e6
        counts, _ = np.histogram(jitter_us, np.array([*_EDGES_US, np.inf]))
        labels = [f"<{edge}" for edge in _EDGES_US[1:]] + [f">={_EDGES_US[-1]}"]
        return {
            "ticks": self.ticks,
            "late_ticks": self.late,
            "missed_states": self.missed,
            "timeouts": self.timeouts,
            "late_share": self.late_share,
            "period_ms": _percentiles(interval * 1e3),
            "stage_us": {name: _percentiles(self._stages[:n, i] / 1e3) for i, name in enumerate(_STAGES)},
            "state_age_ms": _percentiles(self._age_s[:n] * 1e3),
            "answer_ms": _percentiles(_finite(self._answer_s) * 1e3),
            "window_age_ms": _percentiles(_finite(self._window_age_s[:n]) * 1e3),
            "jitter_us_histogram": {label: int(count) for label, count in zip(labels, counts, strict=True)},
        }


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values[np.isfinite(values)]


def _percentiles(values: NDArray[np.float64]) -> dict[str, float] | None:
    if not len(values):
        return None
    p50, p99, p999 = np.percentile(values, [50, 99, 99.9]).tolist()
    return {"p50": round(p50, 3), "p99": round(p99, 3), "p99.9": round(p999, 3), "max": round(float(values.max()), 3)}


_JUMP_S = 0.5
"""A stamp that is so much ahead of where it should be, or 1.5 times as much behind, has jumped."""

_SETTLE_S = 1.0
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
        if backwards or not -1.5 * _JUMP_S <= wrong_s <= _JUMP_S:
            self.jump_s = wrong_s
            self._free_at_s = received_s + _SETTLE_S
            if fresh:
                self._ahead_s = ahead_s
            return False
        self._ahead_s = max(ahead_s, self._ahead_s - _DRIFT * since_s)
        return received_s >= self._free_at_s
