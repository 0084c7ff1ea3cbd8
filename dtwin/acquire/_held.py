"""What a machine says now and then, on a fixed clock: the one sink of MTConnect and MQTT.

Each value holds until the next. Nothing is put where nothing was said: before the first value of a column, while
it is unavailable, and over gaps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.instrument import Description, Event, Reading
from dtwin.units import unit_of

_STAMP = "timestamp_s"
_COVARIATE_UNITS = ("degC", "%")
_MOST_EVENTS = 2000
_MOST_AT_ONCE = 100_000
_FARTHEST_S = 3600.0
_MOST_WAITING = 200_000
# Seconds since 1970 are told to a quarter of a microsecond.
_SAME_S = 1e-5


@dataclass(frozen=True)
class Observed:
    """One value.

    ``name``: column, or what an event is about.
    ``time_s``: seconds since 1970.
    ``value``: a number, NaN when it is unavailable; the text of an event, empty when it ends.
    ``alarm``: whether the event is one.
    """

    name: str
    time_s: float
    value: float | str
    alarm: bool = False


class Held:
    """Turns observations into samples at a rate.

    ``group``: name of the signals.
    ``columns``: numbers that are kept; names end in their unit.
    ``notes``: where they come from, for the recording.
    ``odd``: number of observations whose time lies more than an hour beside the clock, or too many of which wait for it: they are left out.
    """

    def __init__(self, group: str, rate_hz: float, columns: Sequence[str], notes: dict[str, Any]) -> None:
        covariates = [c for c in columns if unit_of(c) in _COVARIATE_UNITS]
        kinds = {name: np.dtype(np.float64) for name in (_STAMP, *columns)}
        self.description = Description(group, rate_hz, kinds, notes | {"covariates": covariates})
        self._columns, self._rate_hz = tuple(columns), rate_hz
        self.restart()

    def restart(self) -> None:
        """Forget everything: the clock begins with the next observation."""
        self._now = dict.fromkeys(self._columns, math.nan)
        self._waiting: list[Observed] = []
        self._events: deque[Event] = deque()
        self._begun_s, self._given = math.nan, 0
        self._lost_until_s, self._why = -math.inf, ""
        self.odd = self._kept_events = 0

    @property
    def next_s(self) -> float:
        """Time of the next sample; NaN before the first observation."""
        return self._begun_s + self._given / self._rate_hz

    def take(self, observed: Iterable[Observed]) -> None:
        """Add observations; those of one column in the order of their time."""
        for one in observed:
            if math.isnan(self._begun_s):
                self._begun_s = one.time_s
            far = abs(one.time_s - self.next_s) > _FARTHEST_S
            if far or len(self._waiting) >= _MOST_WAITING:
                self.odd += 1
                if self.odd == 1:
                    why = "clock is more than an hour off" if far else "time does not come"
                    self.say(f"values of {one.name} and perhaps others, whose {why}, are left out")
            else:
                self._waiting.append(one)

    def begin(self, time_s: float) -> None:
        """Let the clock begin now, unless it has."""
        if math.isnan(self._begun_s):
            self._begun_s = time_s

    def say(self, text: str) -> None:
        """Tell an event of the recording itself, at the next sample."""
        self._events.append(Event(self._given / self._rate_hz, "recording", text))

    def lose(self, until_s: float, why: str) -> None:
        """Say that nothing is known between the samples given so far and a time."""
        self._lost_until_s, self._why = max(until_s, self._lost_until_s), why
        self._now = dict.fromkeys(self._columns, math.nan)
        self._waiting.clear()

    def reading(self, known_until_s: float) -> Reading:
        """Return the samples up to a time until which everything is known."""
        self._waiting.sort(key=lambda one: one.time_s)
        lost = self._lost()
        n = 0
        if not math.isnan(self._begun_s):
            n = max(0, math.floor((known_until_s - self.next_s + _SAME_S) * self._rate_hz) + 1)
        n = min(n, _MOST_AT_ONCE)
        table = np.empty((n, 1 + len(self._columns)))
        place = 0
        for row in range(n):
            at_s = self.next_s + row / self._rate_hz
            while place < len(self._waiting) and self._waiting[place].time_s <= at_s + _SAME_S:
                self._apply(self._waiting[place])
                place += 1
            table[row, 0] = at_s
            table[row, 1:] = list(self._now.values())
        del self._waiting[:place]
        self._given += n
        columns = {name: table[:, k].copy() for k, name in enumerate((_STAMP, *self._columns))}
        # Nobody keeps a reading that is empty.
        events = tuple(self._events) if n or lost else ()
        if events:
            self._events.clear()
        return Reading(columns, lost, self._why if lost else "", events)

    def _lost(self) -> int:
        """Return how many samples of what is next are lost, and count them as given."""
        if math.isnan(self._begun_s) or self._lost_until_s <= self.next_s:
            return 0
        lost = math.ceil((self._lost_until_s - self.next_s - _SAME_S) * self._rate_hz)
        self._given += lost
        self._lost_until_s = -math.inf
        return lost

    def _apply(self, one: Observed) -> None:
        if isinstance(one.value, str):
            at_s = max(0.0, one.time_s - self._begun_s)
            self._kept_events += 1
            if self._kept_events < _MOST_EVENTS:
                self._events.append(Event(at_s, one.name, one.value, one.alarm))
            elif self._kept_events == _MOST_EVENTS:
                self._events.append(Event(at_s, "recording", f"no more than {_MOST_EVENTS} events are kept"))
        elif one.name in self._now:
            self._now[one.name] = one.value
