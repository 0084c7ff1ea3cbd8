"""Which bodies drive an error motion: what cannot be told from time alone, or from other bodies, is not told as a cause.

In a campaign of some days a motion that wanders is followed by much that wanders or rises, the room among it. So a body
counts only when hours that were left out are foretold worse without it, whatever else is chosen in its place, and a
course of time beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    ``expected`` (n,): what temperatures of these bodies, chosen without them, say of hours left out.
    ``alike``: for each body that counts what tells as much in its place: () for a body that is surely a cause.
    ``as_time``: bodies beside them that tell no more than time alone does.
    ``by_any`` (n,): as ``expected``, of all bodies: nothing was chosen by these hours.
    """

    model: ThermalModel
    expected: Floats
    alike: Mapping[str, tuple[str, ...]]
    as_time: tuple[str, ...]
    by_any: Floats


@dataclass(frozen=True)
class _HeldOut:
    """A model of some bodies: of all hours, and what it says of each span and leaves (squares) without that span."""

    model: ThermalModel
    expected: Floats
    squares: Floats
    used: tuple[str, ...]


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
    every = search.held_out(frozenset(bodies))
    if named:
        return Drivers(every.model, every.expected, dict.fromkeys(every.used, ()), (), every.expected)
    kept, alike = search.found()
    counts = search.held_out(frozenset(alike))
    return Drivers(counts.model, counts.expected, alike, tuple(sorted(kept - set(alike))), every.expected)


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
        self._name, self._motion, self._bodies, self._spans = name, motion, bodies, spans
        self._courses = {f"{TIME_ALONE} {n}": course for n, course in enumerate(courses(hour))}
        self._known: dict[tuple[frozenset[str], bool], _HeldOut] = {}

    def found(self) -> tuple[frozenset[str], dict[str, tuple[str, ...]]]:
        """Return the bodies that pay, and those of them that count with what is alike."""
        every = frozenset(self._bodies)
        kept = frozenset(self.held_out(every).used)
        now = self._least((every, False), (kept, False))
        while True:
            without = {body: self.held_out(kept - {body}).squares for body in sorted(kept)}
            idle = {body: left for body, left in without.items() if not needed(left, now, MUCH)}
            if not idle:
                break
            kept -= {_first(idle)}
            now = min(now, self.held_out(kept).squares, key=np.sum)
        # One after the other: of two that go together each could be told by time beside the other.
        counts = kept
        while as_time := self._as_time(counts):
            counts -= {_first(as_time)}
        told = self.held_out(counts).squares
        alike: dict[str, tuple[str, ...]] = {}
        for body in sorted(counts):
            others = self.held_out(every - {body})
            instead = [one for one in others.used if one not in counts] or others.used
            alike[body] = () if needed(others.squares, told, MUCH) else (" and ".join(instead),)
        return kept, alike

    def _as_time(self, counts: frozenset[str]) -> dict[str, Floats]:
        """Return the bodies that a course of time stands in for, beside the others or what is chosen anew, with what it leaves (squares)."""
        told = self._least((counts, False), (counts, True))
        out: dict[str, Floats] = {}
        for body in sorted(counts):
            others = frozenset(self._bodies) - {body}
            anew = [(others, True)] if needed(self.held_out(others).squares, told, MUCH) else []
            for some in [(counts - {body}, True), *anew]:
                left = self.held_out(*some).squares
                if body not in out and not needed(left, told, MUCH):
                    out[body] = left
        return out

    def _least(self, *some: tuple[frozenset[str], bool]) -> Floats:
        return min((self.held_out(*one).squares for one in some), key=np.sum)

    def held_out(self, bodies: frozenset[str], timed: bool = False) -> _HeldOut:
        """Return what temperatures of these bodies say, with courses of time or without; the choice of them is made anew in each span."""
        if (bodies, timed) not in self._known:
            columns = {
                name: rise for body in self._bodies if body in bodies for name, rise in self._bodies[body].items()
            }
            self._known[bodies, timed] = self._fitted({**columns, **(self._courses if timed else {})})
        return self._known[bodies, timed]

    def _fitted(self, columns: Mapping[str, Floats]) -> _HeldOut:
        rise = np.column_stack([np.zeros((len(self._motion), 0)), *columns.values()])
        expected = np.zeros(len(self._motion))
        for span in self._spans:
            kept = np.delete(np.arange(len(self._motion)), span)
            model = self._chosen(kept, rise, list(columns))
            expected[span] = model.run(rise[span][:, [list(columns).index(sensor) for sensor in model.sensors]])
        model = self._chosen(np.arange(len(self._motion)), rise, list(columns))
        squares = np.array([float(((self._motion - expected)[span] ** 2).sum()) for span in self._spans])
        used = tuple(body for body, own in self._bodies.items() if set(own) & set(model.sensors))
        return _HeldOut(model, expected, squares, used)

    def _chosen(self, cycles: NDArray[np.int64], rise: Floats, names: Sequence[str]) -> ThermalModel:
        if not names:
            return ThermalModel(self._name, (), np.zeros(0), 0.0, float("nan"))
        return fit_thermal(self._name, self._motion[cycles], rise[cycles], names, static=True)


def _first(left: Mapping[str, Floats]) -> str:
    """Return the body without which least is left."""
    return min(left, key=lambda body: float(left[body].sum()))
