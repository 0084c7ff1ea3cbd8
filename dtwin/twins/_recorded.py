"""Contradictions of a twin beside what the record of the machine says of their days."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dtwin.config import Home
from dtwin.machine_record import Event, events_between, events_of
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin


@dataclass(frozen=True)
class _RecordedContradiction(Contradiction):
    """A contradiction, and what was recorded of the machine meanwhile.

    ``between``: start of the last test with the older value, and of the first with the newer one, ISO 8601; of a single
    test that differs from those before and after it, also of the next one. Empty where days do not part the tests.
    ``events``: what was recorded from each of these days to the next, JSON-ready.
    """

    between: tuple[str, ...] = ()
    events: tuple[tuple[Mapping[str, str], ...], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**super().as_dict(), "between": list(self.between), "events": [list(told) for told in self.events]}


def with_record(home: Home, twin: Twin) -> Twin:
    """Return a twin whose contradictions say what the record of its machine, as it is now, holds of their days."""
    if not isinstance(twin, SeveralTwin) or not twin.contradictions:
        return twin
    started = {part.campaign: str(about["started"]) for part, about in zip(twin.parts, twin.about, strict=True)}
    return replace(twin, contradictions=recorded(home, twin.machine, started, twin.contradictions))


def recorded(
    home: Home, machine: str, started: Mapping[str, str], contradictions: Sequence[Contradiction]
) -> tuple[Contradiction, ...]:
    """Return contradictions with what the record of their machine holds of their days; ``started``: of each campaign."""
    events = events_of(home, machine) if contradictions else ()
    return tuple(_recorded(one, started, events) for one in contradictions)


def _recorded(one: Contradiction, started: Mapping[str, str], events: Sequence[Event]) -> _RecordedContradiction:
    between = _between(*([started[name] for name in names] for names in (one.campaigns, one.others)))
    pairs = itertools.pairwise(between)
    told = tuple(tuple(e.as_dict() for e in events_between(events, *days)) for days in pairs)
    return _RecordedContradiction(**{**vars(one), "between": between, "events": told})


def _between(mine: Sequence[str], theirs: Sequence[str]) -> tuple[str, ...]:
    if not all((*mine, *theirs)):
        return ()
    for older, newer in ((mine, theirs), (theirs, mine)):
        if max(older) < min(newer):
            return max(older), min(newer)
    if len(mine) > 1:
        return ()
    (day,) = mine
    before, after = [other for other in theirs if other <= day], [other for other in theirs if other > day]
    return (max(before), day, min(after)) if before and after else ()
