"""Which bodies drive an error motion: what cannot be told from time alone, or from other bodies, is not told as a cause.

In a campaign of some days a motion that wanders is followed by much that wanders or rises, the room among it. So a body
counts only when hours that were left out are foretold worse without it, whatever else is chosen in its place, and a
course of time beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dtwin.features.time_alone import TIME_ALONE, courses, needed
from dtwin.kinds.volumetric._thermal_model import ThermalModel, fit_thermal
from dtwin.schema import Floats

MUCH = 0.3
"""Share of the squares that a body takes even where the spans do not agree: they are few."""


@dataclass(frozen=True)
class Drivers:
    """What drives a motion.

    ``model``: with the temperatures of the bodies that count; nought where none does.
    ``alike``: for each body that counts what tells as much in its place: () for a body that is surely a cause.
    ``as_time``: bodies beside them that tell no more than time alone does.
    ``by_any`` (n,): what temperatures of all bodies, chosen without them, say of hours left out.
    """

    model: ThermalModel
    alike: Mapping[str, tuple[str, ...]]
    as_time: tuple[str, ...]
    by_any: Floats
    _left_out: Callable[[], Floats] = field(repr=False, compare=False)

    @cached_property
    def expected(self) -> Floats:
        """What the temperatures say of hours left out, (n,): bodies and temperatures were chosen without these hours."""
        return self._left_out()


def drivers_of(
    name: str,
    motion: Floats,
    bodies: Mapping[str, Mapping[str, Floats]],
    hour: Floats,
    spans: Sequence[NDArray[np.int64]],
    *,
    named: bool,
) -> Drivers:
    """Return what drives a motion.

    ``motion``, ``hour``, (n,): its values, and when.
    ``bodies``: the temperatures (n,) of each body by name.
    ``named``: whether a user says that they do: then all of them may.
    """
    search = _Search(name, motion, bodies, hour, spans)
    every = frozenset(bodies)
    by_any = search.expected(every)
    if named:
        return Drivers(search.model(every), dict.fromkeys(search.used(every), ()), (), by_any, lambda: by_any)
    kept, alike = search.found()
    return Drivers(search.model(frozenset(alike)), alike, tuple(sorted(kept - alike.keys())), by_any, search.left_out)


class _Search:
    """The bodies of one motion; what was once fitted is kept."""

    def __init__(
        self,
        name: str,
        motion: Floats,
        bodies: Mapping[str, Mapping[str, Floats]],
        hour: Floats,
        spans: Sequence[NDArray[np.int64]],
    ) -> None:
        self._name, self._motion, self._bodies, self._hour, self._spans = name, motion, bodies, hour, spans
        self._kept = [np.delete(np.arange(len(motion)), span) for span in spans]
        self._courses = {f"{TIME_ALONE} {n}": course for n, course in enumerate(courses(hour))}
        self._expected: dict[tuple[frozenset[str], bool], Floats] = {}
        self._models: dict[frozenset[str], ThermalModel] = {}

    def found(self) -> tuple[frozenset[str], dict[str, tuple[str, ...]]]:
        """Return the bodies that pay, and those of them that count with what is alike."""
        every = frozenset(self._bodies)
        kept = frozenset(self.used(every))
        now = self._least((every, False), (kept, False))
        while True:
            without = {body: self._squares(kept - {body}) for body in sorted(kept)}
            idle = {body: left for body, left in without.items() if not needed(left, now, MUCH)}
            if not idle:
                break
            kept -= {_first(idle)}
            now = min(now, self._squares(kept), key=np.sum)
        # One after the other: of two that go together each could be told by time beside the other.
        counts = kept
        while as_time := self._as_time(counts):
            counts -= {_first(as_time)}
        told = self._squares(counts)
        alike: dict[str, tuple[str, ...]] = {}
        for body in sorted(counts):
            alike[body] = ()
            if not needed(self._squares(every - {body}), told, MUCH):
                used = self.used(every - {body})
                alike[body] = (" and ".join([one for one in used if one not in counts] or used),)
        return kept, alike

    def _as_time(self, counts: frozenset[str]) -> dict[str, Floats]:
        """Return the bodies that a course of time stands in for, beside the others or what is chosen anew, with what it leaves (squares)."""
        told = self._least((counts, False), (counts, True))
        out: dict[str, Floats] = {}
        for body in sorted(counts):
            others = frozenset(self._bodies) - {body}
            anew = [(others, True)] if needed(self._squares(others), told, MUCH) else []
            for some in [(counts - {body}, True), *anew]:
                left = self._squares(*some)
                if body not in out and not needed(left, told, MUCH):
                    out[body] = left
        return out

    def _least(self, *some: tuple[frozenset[str], bool]) -> Floats:
        return min((self._squares(*one) for one in some), key=np.sum)

    def _squares(self, bodies: frozenset[str], timed: bool = False) -> Floats:
        """Return the squares that these bodies leave in each span without it."""
        left = self._motion - self.expected(bodies, timed)
        return np.array([float((left[span] ** 2).sum()) for span in self._spans])

    def expected(self, bodies: frozenset[str], timed: bool = False) -> Floats:
        """Return what temperatures of these bodies, with courses of time or without, say of each span, (n,); they are chosen without it."""
        if (bodies, timed) not in self._expected:
            columns = {**self._columns(bodies), **(self._courses if timed else {})}
            names, rise, out = list(columns), _beside(columns, len(self._motion)), np.zeros(len(self._motion))
            for span, kept in zip(self._spans, self._kept, strict=True):
                model = self._chosen(kept, names, rise)
                out[span] = model.run(rise[span][:, [names.index(sensor) for sensor in model.sensors]])
            self._expected[bodies, timed] = out
        return self._expected[bodies, timed]

    def left_out(self) -> Floats:
        """Return what is said of each span when it had no part in the choice of bodies either, (n,)."""
        out = np.zeros(len(self._motion))
        for span, kept in zip(self._spans, self._kept, strict=True):
            bodies = {body: {name: rise[kept] for name, rise in own.items()} for body, own in self._bodies.items()}
            spans = np.array_split(np.arange(len(kept)), len(self._spans))
            search = _Search(self._name, self._motion[kept], bodies, self._hour[kept], spans)
            model = search.model(frozenset(search.found()[1]))
            columns = self._columns(frozenset(self._bodies))
            out[span] = model.run(_beside({sensor: columns[sensor] for sensor in model.sensors}, len(out))[span])
        return out

    def model(self, bodies: frozenset[str]) -> ThermalModel:
        """Return the model of all hours."""
        if bodies not in self._models:
            columns, n = self._columns(bodies), len(self._motion)
            self._models[bodies] = self._chosen(np.arange(n), list(columns), _beside(columns, n))
        return self._models[bodies]

    def used(self, bodies: frozenset[str]) -> tuple[str, ...]:
        """Return the bodies whose temperatures that model takes."""
        sensors = set(self.model(bodies).sensors)
        return tuple(body for body, own in self._bodies.items() if sensors & set(own))

    def _columns(self, bodies: frozenset[str]) -> dict[str, Floats]:
        return {name: rise for body, own in self._bodies.items() if body in bodies for name, rise in own.items()}

    def _chosen(self, cycles: NDArray[np.int64], names: Sequence[str], rise: Floats) -> ThermalModel:
        if not names:
            return ThermalModel(self._name, (), np.zeros(0))
        return fit_thermal(self._name, self._motion[cycles], rise[cycles], names)


def _beside(columns: Mapping[str, Floats], n: int) -> Floats:
    """Return columns (n,) beside each other, shape (n, columns), also none of them."""
    return np.array([*columns.values()], dtype=np.float64).reshape(-1, n).T


def _first(left: Mapping[str, Floats]) -> str:
    """Return the body without which least is left."""
    return min(left, key=lambda body: float(left[body].sum()))
