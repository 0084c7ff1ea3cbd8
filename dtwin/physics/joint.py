"""Tests of one machine by several instruments: what they agree on, and which of two names is right.

A cause is what a machine has, whichever instrument sees it: the scale of X is a lead error to a laser, and
with that of Y a scale mismatch to a ball bar. Every test is diagnosed by itself first, so that each keeps its
set-up terms, its noise and its whitening; tests meet in the sizes of causes, each with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.diagnosis import Diagnosis
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.state import AXES_OF
from dtwin.physics.twin import chosen_terms

# A difference counts from this many of its standard uncertainties on; sizes are stated with k = 2.
_APART = 3.0
_COVERAGE_FACTOR = 2.0
# An effect is no cause when what another test sees is so many times likelier without it.
_ODDS = 20.0

_Said = Literal["agrees", "is a part", "refuted"]
_Cause = tuple[str, str]


@dataclass(frozen=True)
class MachineTest:
    """A campaign with what its diagnosis found beside effects that are known; from nothing without any."""

    campaign: str
    started: str
    obs: Observations
    found: Diagnosis
    known: tuple[Term, ...] = ()


@dataclass(frozen=True)
class _Size:
    """Size of a cause in one test.

    ``label``: the effect that stands for it there.
    ``uncertainty``: expanded, k = 2; unit of replication: the run.
    """

    campaign: str
    started: str
    label: str
    value: float
    uncertainty: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


@dataclass(frozen=True)
class Shared:
    """A cause that several tests measured, or that follows from what several measured.

    ``cause``, ``axis``: what it is; ``axis`` is a plane for the difference of its two axes.
    ``sizes``: in the order of the tests; a single one follows from the difference of two axes and the other axis.
    ``value``, ``uncertainty``: all of them together, each by its own uncertainty; k = 2. NaN where they contradict each
    other.
    ``apart``: campaigns that contradict each other, by how much, and the uncertainty of that, k = 2.
    """

    cause: str
    axis: str
    unit: str
    sizes: tuple[_Size, ...]
    value: float
    uncertainty: float
    apart: tuple[tuple[str, str, float, float], ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "sizes": [s.as_dict() for s in self.sizes], "apart": [list(a) for a in self.apart]}


@dataclass(frozen=True)
class _Judged:
    """A name of a group, as other tests see it.

    ``label``: the effect.
    ``said``: ``agrees``: another test finds it of the size that it must have to be the cause. ``is a part``: it is
    there, and too small. ``refuted``: another test would see it and does not.
    ``here``: the size that it must have if it is the cause.
    ``there``: the size that the other test gives.
    """

    label: str
    said: _Said
    here: _Size
    there: _Size

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "here": self.here.as_dict(), "there": self.there.as_dict()}


@dataclass(frozen=True)
class _Settled:
    """A group of one test that another test judges.

    ``group``: what the test alone could not tell apart.
    ``judged``: those of them that another test can see.
    ``left``: those that are possible still; one is the name, none is a contradiction.
    """

    campaign: str
    group: tuple[str, ...]
    judged: tuple[_Judged, ...]
    left: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "campaign": self.campaign,
            "group": list(self.group),
            "judged": [j.as_dict() for j in self.judged],
            "left": list(self.left),
        }


@dataclass(frozen=True)
class Joint:
    """What the tests of a machine say together."""

    shared: tuple[Shared, ...]
    settled: tuple[_Settled, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"shared": [s.as_dict() for s in self.shared], "settled": [s.as_dict() for s in self.settled]}


def joint(
    tests: Sequence[MachineTest], library: Mapping[str, Effect], groups: Sequence[Sequence[tuple[str, ...]]] = ()
) -> Joint:
    """Compare the tests of a machine.

    ``tests``: of one machine, each diagnosed from nothing.
    ``library``: the library that they were diagnosed with.
    ``groups``: of each test the groups of labels to compare, in place of those that its diagnosis found.
    """
    every = groups or [[tuple(s.label for s in group) for group in test.found.found] for test in tests]
    measured = [_Measured(test, own, library) for test, own in zip(tests, every, strict=True)]
    settled = [
        (one, verdict)
        for one in measured
        for group in one.groups
        if len(group) > 1 and (verdict := _settled(one, group, measured)) is not None
    ]
    for one, verdict in settled:
        one.groups = [verdict.left or group if group == verdict.group else group for group in one.groups]
    return Joint((*_shared(measured), *_following(measured)), tuple(verdict for _, verdict in settled))


class _Measured:
    """Sizes of causes in one test, each fitted once."""

    def __init__(self, test: MachineTest, groups: Sequence[tuple[str, ...]], library: Mapping[str, Effect]) -> None:
        self.test, self._library = test, library
        self.groups = list(groups)
        self._unclear = {label for group in self.groups if len(group) > 1 for label in group}
        self._fitted: dict[tuple[str, ...], dict[str, list[Estimate]]] = {}

    def size(self, label: str, group: Sequence[str] = (), mates: Sequence[str] = ()) -> _Size | None:
        """Return the size of an effect beside what was found; None where it cannot be told.

        ``group``: what it stands in place of, together with its ``mates``.
        """
        tops = [g[0] for g in self.groups if label not in g and g[0] not in group]
        fitted = self._estimates((*tops, *mates, label)).get(label, [])
        estimates = [e for e in fitted if not e.is_unseen]
        if not estimates or not all(e.identifiable and np.isfinite(e.uncertainty) for e in estimates):
            return None
        value, uncertainty = _length(estimates)
        return _Size(self.test.campaign, self.test.started, label, value, uncertainty)

    def causes(self) -> list[_Cause]:
        """Return the causes that were found alone."""
        alone = [self.cause_of(group[0]) for group in self.groups if len(group) == 1]
        return [cause for cause in alone if cause is not None]

    def cause_of(self, label: str) -> _Cause | None:
        """Return what an effect is a measure of, None when no other instrument would see it."""
        name, _, axis = label.partition(" ")
        cause = self._library[name].cause
        return (cause, axis) if cause else None

    def seen(self, cause: _Cause) -> _Size | None:
        """Return the size of a cause here, zero within its uncertainty where it was not found; None when it hides."""
        for name, effect in self._library.items():
            if effect.cause != cause[0] or self.test.obs.grid.kind not in effect.kinds:
                continue
            label = f"{name} {cause[1]}".rstrip()
            # What the test could not tell from another name, or found beside what looks alike, it sizes badly.
            if (label in self._unclear and (label,) not in self.groups) or self._beside_alike(effect, cause[1]):
                return None
            return self.size(label)
        return None

    def _beside_alike(self, effect: Effect, axis: str) -> bool:
        """Tell whether an effect that looks alike was found on the same axis, or the same on all axes at once."""
        tops = [group[0].partition(" ") for group in self.groups]
        alike, itself = {*effect.confusables, effect.name}, (effect.name, axis)
        return any(name in alike and (not own or own == axis) and (name, own) != itself for name, _, own in tops)

    def unit(self, cause: _Cause) -> str:
        """Return the unit of the size of a cause."""
        return next(e.parameters[0].unit for e in self._library.values() if e.cause == cause[0])

    def _estimates(self, labels: tuple[str, ...]) -> dict[str, list[Estimate]]:
        if labels not in self._fitted:
            obs, out = self.test.obs, dict[str, list[Estimate]]()
            try:
                terms: list[Term] = chosen_terms([":".join(n.split()) for n in labels], self._library, obs)
            except InputError:  # It cannot act in this test.
                terms = []
            for e in fit(obs, [*self.test.known, *terms]).estimates if terms else ():
                out.setdefault(f"{e.effect} {e.axis}".rstrip(), []).append(e)
            self._fitted[labels] = out
        return self._fitted[labels]


def _length(estimates: Sequence[Estimate]) -> tuple[float, float]:
    """Return a size and its uncertainty: the number itself, or the length of several, as of cosine and sine."""
    values = np.array([e.value for e in estimates])
    widths = np.array([e.uncertainty for e in estimates])
    if len(values) == 1:
        return float(values[0]), float(widths[0])
    length = float(np.hypot.reduce(values))
    return length, float(np.sqrt(((values * widths) ** 2).sum()) / max(length, 1e-12))


def _elsewhere(cause: _Cause, others: Iterable[_Measured]) -> _Size | None:
    """Return the size of a cause in the other tests that is known best; of a plane, from those of its axes."""
    others = list(others)
    seen = [size for one in others if (size := one.seen(cause)) is not None]
    pair = AXES_OF.get(cause[1])
    if pair is not None:
        parts = [_elsewhere((cause[0], axis), others) for axis in pair]
        if parts[0] is not None and parts[1] is not None:
            seen.append(_sum(parts[0], parts[1], -1.0))
    return min(seen, key=lambda size: size.uncertainty, default=None)


def _sum(first: _Size, second: _Size, sign: float = 1.0) -> _Size:
    both = dict.fromkeys((first.campaign, second.campaign))
    return _Size(
        ", ".join(both),
        max(first.started, second.started),
        f"{first.label} {'+' if sign > 0.0 else '-'} {second.label}",
        first.value + sign * second.value,
        float(np.hypot(first.uncertainty, second.uncertainty)),
    )


def _differs(first: _Size, second: _Size) -> bool:
    standard = np.hypot(first.uncertainty, second.uncertainty) / _COVERAGE_FACTOR
    return bool(abs(first.value - second.value) > _APART * standard)


def _is_there(size: _Size) -> bool:
    return abs(size.value) > _APART / _COVERAGE_FACTOR * size.uncertainty


def _settled(one: _Measured, group: tuple[str, ...], measured: Sequence[_Measured]) -> _Settled | None:
    """Judge the names of a group by the other tests; None when none of them sees any."""
    others = [other for other in measured if other is not one]
    judged: list[_Judged] = []
    for label in group:
        cause = one.cause_of(label)
        there = _absent_in(label, group, one, others) if cause is None else _elsewhere(cause, others)
        # A group of few runs has very many names: those that no other test sees are not fitted.
        here = None if there is None else one.size(label, group)
        if there is not None and _is_weak(here, label, group):
            here = here and one.size(label, group, _mates(label, group))
        if here is None or there is None:
            continue
        said = _said(here, there)
        if said is not None:
            judged.append(_Judged(label, said, here, there))
    if not judged:
        return None
    agreed = tuple(j.label for j in judged if j.said == "agrees")
    ruled_out = {j.label for j in judged}
    if not agreed:
        # What is the cause only together with the same on other axes falls with them.
        fallen = [label for label in group if (mates := _mates(label, group)) and ruled_out.issuperset(mates)]
        ruled_out |= {label for label in fallen if _is_weak(one.size(label, group), label, group)}
    left = agreed or tuple(label for label in group if label not in ruled_out)
    return _Settled(one.test.campaign, group, tuple(judged), left)


def _absent_in(label: str, group: tuple[str, ...], one: _Measured, others: Iterable[_Measured]) -> _Size | None:
    """Return the size of an effect, zero within its uncertainty, in a test of the kind that names another one of the group alone.

    None where no such test has other conditions: what one test cannot tell, another one of the same conditions cannot either.
    """
    like = (o for o in others if o.test.obs.grid.kind == one.test.obs.grid.kind)
    wider = [o for o in like if set(o.test.obs.conditions) - set(one.test.obs.conditions)]
    telling = [o for o in wider if any(g[0] in group and g[0] != label for g in o.groups if len(g) == 1)]
    sizes = [size for o in telling if (size := o.size(label)) is not None and not _is_there(size)]
    return min(sizes, key=lambda size: size.uncertainty, default=None)


def _is_weak(here: _Size | None, label: str, group: tuple[str, ...]) -> bool:
    """Tell whether an effect is no cause alone, and may be one with the same on other axes; ``here``: its size alone."""
    return bool(_mates(label, group)) and (here is None or not _is_there(here))


def _mates(label: str, group: tuple[str, ...]) -> list[str]:
    """Return the same effect on the other axes of a group: what is too small on one alone may be the cause on both."""
    name, _, axis = label.partition(" ")
    return [other for other in group if axis and other != label and other.startswith(f"{name} ")]


def _said(here: _Size, there: _Size) -> _Said | None:
    """Return what the size of a cause in other tests says of it; None when it is neither seen there nor ruled out."""
    if not _differs(here, there):
        if _is_there(there):
            return "agrees"
        return "refuted" if _odds_of_absent(here, there) > _ODDS else None
    part = _is_there(there) and 0.0 < there.value / here.value < 1.0
    return "is a part" if part else "refuted"


def _odds_of_absent(here: _Size, there: _Size) -> float:
    """Return how many times likelier what another test sees is without an effect than with the size that it must have."""
    absent = (there.uncertainty / _COVERAGE_FACTOR) ** 2
    present = absent + (here.uncertainty / _COVERAGE_FACTOR) ** 2
    logs = (there.value - here.value) ** 2 / present - there.value**2 / absent + np.log(present / absent)
    return float(np.exp(min(logs / 2.0, 700.0)))


def _shared(measured: Sequence[_Measured]) -> list[Shared]:
    """Return the causes that one test found and others could see, with what they make together."""
    causes = dict.fromkeys(cause for one in measured for cause in one.causes())
    for name, axis in list(causes):
        causes |= {(name, plane): None for plane, pair in AXES_OF.items() if axis in pair}
    out = []
    for cause in causes:
        seen = [(one, one.seen(cause)) for one in measured]
        sizes = [size for _, size in seen if size is not None]
        if cause[1] in AXES_OF:
            parts = _elsewhere(cause, [one for one, size in seen if size is None])
            sizes += [] if parts is None else [parts]
        if len(sizes) > 1:
            out.append(_together(cause, measured[0].unit(cause), sorted(sizes, key=lambda size: size.started)))
    return out


def _following(measured: Sequence[_Measured]) -> list[Shared]:
    """Return the axes that no test tells alone, of whose cause a difference was found and the other axis is known."""
    alone = dict.fromkeys(cause for one in measured for cause in one.causes())
    differences = [cause for cause in alone if cause[1] in AXES_OF]
    known: dict[_Cause, _Size] = {}
    for name, plane in differences:
        for axis in AXES_OF[plane]:
            size = _elsewhere((name, axis), measured)
            if size is not None:
                known[name, axis] = size
    out: dict[_Cause, _Size] = {}
    for name, plane in differences * len(AXES_OF):
        first, second = ((name, axis) for axis in AXES_OF[plane])
        between = _elsewhere((name, plane), measured)
        if between is None or (first in known) == (second in known):
            continue
        one, sign = (second, -1.0) if first in known else (first, 1.0)
        known[one] = out[one] = _sum(known[second if sign > 0.0 else first], between, sign)
    return [_together(cause, measured[0].unit(cause), [out[cause]]) for cause in out if _is_there(out[cause])]


def _together(cause: _Cause, unit: str, sizes: Sequence[_Size]) -> Shared:
    apart = tuple(
        (a.campaign, b.campaign, b.value - a.value, float(np.hypot(a.uncertainty, b.uncertainty)))
        for a, b in combinations(sizes, 2)
        if _differs(a, b)
    )
    weights = np.array([max(s.uncertainty, 1e-12) ** -2.0 for s in sizes])
    value = float((weights * [s.value for s in sizes]).sum() / weights.sum())
    combined = (float("nan"), float("nan")) if apart else (value, float(weights.sum() ** -0.5))
    return Shared(*cause, unit, tuple(sizes), *combined, apart)
