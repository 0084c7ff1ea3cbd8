"""Which campaign of a machine contradicts the others: what, by how much, and since when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dtwin.physics._pooled import determined, normal_inverse, spread
from dtwin.physics.machine_terms import is_shared, is_wave
from dtwin.physics.several import Pool, SeveralFit, amplitude, regrouped, seen_estimates
from dtwin.physics.state import AXES_OF
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail, holm, t_tail

_ALPHA = 0.01
_MOST = 6

What = Literal["change", "mistake", "change or mistake"]
_Side = frozenset[int]


@dataclass(frozen=True)
class Contradiction:
    """A parameter of which campaigns have another value than the rest.

    Attributes
    ----------
    campaigns, others : tuple of str
        Those that differ, and those that they differ from.
    effect, axis, parameter, unit : str
        What differs; the axis is a plane where only the difference of its two axes is told.
    difference, k2 : float
        By how much, with its expanded uncertainty; unit of replication: the run.
    p_value : float
        After Holm over campaigns and parameters.
    since : str
        First day with the newer value, as the campaign states it; empty when no day is stated.
    what : str
        ``change`` of the machine where later tests agree with it, ``mistake`` where tests before and after agree with each
        other, ``change or mistake`` where the newest test alone differs.
    """

    campaigns: tuple[str, ...]
    others: tuple[str, ...]
    effect: str
    axis: str
    parameter: str
    unit: str
    difference: float
    k2: float
    p_value: float
    since: str
    what: What

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {**vars(self), "campaigns": list(self.campaigns), "others": list(self.others)}


@dataclass(frozen=True)
class _Tested:
    """A shared parameter on one side of the campaigns against the rest."""

    side: _Side
    term: int
    parameter: int
    difference: float
    k2: float
    p_value: float
    beside: tuple[int, ...]


def without_contradictions(fitted: SeveralFit, started: Sequence[str]) -> tuple[SeveralFit, tuple[Contradiction, ...]]:
    """Give campaigns that contradict the others a value of their own, the most certain first, and name them.

    Parameters
    ----------
    started : sequence of str
        When each campaign was begun, ISO 8601; empty where that is not stated.
    """
    found: list[Contradiction] = []
    while len(found) < _MOST:
        worst = _worst(fitted, started)
        if worst is None:
            break
        groups = dict(fitted.pool.groups)
        mine = _with_term(fitted.pool, worst.term)
        new = 1 + max(groups.values(), default=0)
        moved = worst.side if _stays(mine - worst.side, worst.side, started) else mine - worst.side
        groups |= {(c, worst.term): new for c in moved}
        found.append(_told(worst, fitted.pool, mine, started))
        fitted = regrouped(fitted, groups)
    return fitted, (*found, *_of_waves(fitted, started))


def _of_waves(fitted: SeveralFit, started: Sequence[str]) -> list[Contradiction]:
    """Return the waves of which one campaign has another amplitude than the others, each campaign tested against the rest."""
    tests: list[tuple[int, int, float, float]] = []
    for number in (n for n, term in enumerate(fitted.terms) if is_wave(term)):
        seen = seen_estimates(fitted.pool, fitted.fits, number)
        for c in seen if len(seen) > 1 else ():
            own, rest = amplitude([seen[c]]), amplitude([mine for other, mine in seen.items() if other != c])
            k2 = float(np.hypot(own.uncertainty, rest.uncertainty))
            if own.identifiable and rest.identifiable and np.isfinite(k2):
                tests.append((number, c, own.value - rest.value, k2))
    p_values = holm([chi2_tail((2.0 * difference / k2) ** 2, 1.0) for *_, difference, k2 in tests])
    worst: dict[int, int] = {}
    for i, (number, *_) in enumerate(tests):
        if p_values[i] <= min(_ALPHA, p_values[worst[number]] if number in worst else 1.0):
            worst[number] = i
    out = []
    for number, i in worst.items():
        _, c, difference, k2 = tests[i]
        mine = frozenset(seen_estimates(fitted.pool, fitted.fits, number))
        told = _told(
            _Tested(frozenset([c]), number, 0, difference, k2, float(p_values[i]), ()), fitted.pool, mine, started
        )
        out.append(replace(told, parameter="amplitude"))
    return out


def _with_term(pool: Pool, term: int) -> _Side:
    """Return the campaigns that share a term still."""
    return frozenset(
        c for c, part in enumerate(pool.parts) if term in part.number_of and not pool.groups.get((c, term), 0)
    )


def _stays(rest: _Side, side: _Side, started: Sequence[str]) -> bool:
    """Tell whether the rest keeps the common value: the larger side does, and of equal ones the newer."""
    if len(rest) != len(side):
        return len(rest) > len(side)
    return max(started[c] for c in rest) > max(started[c] for c in side)


def _worst(fitted: SeveralFit, started: Sequence[str]) -> _Tested | None:
    tests = [t for side in _sides(len(started), started) for t in _tested(fitted.pool, side)]
    if not tests:
        return None
    p_values = holm([t.p_value for t in tests])
    first = min(
        range(len(tests)), key=lambda i: (p_values[i], tests[i].p_value, -abs(tests[i].difference) / tests[i].k2)
    )
    return replace(tests[first], p_value=float(p_values[first])) if p_values[first] <= _ALPHA else None


def _sides(number: int, started: Sequence[str]) -> list[_Side]:
    """Return each campaign alone, and all from a day on."""
    singles = [frozenset([c]) for c in range(number)]
    if len(set(started)) < number or not all(started):
        return singles
    order = sorted(range(number), key=lambda c: started[c])
    later = [frozenset(order[i:]) for i in range(1, number)]
    return list(dict.fromkeys([*later, *singles]))


def _tested(pool: Pool, side: _Side) -> list[_Tested]:
    """Test all shared parameters of one side against the rest: Wald tests of one common fit in which they may differ."""
    maps, meaning = pool.maps()
    # Without repeats nobody knows whether a campaign differs.
    repeated = frozenset(c for c, part in enumerate(pool.parts) if part.problem.noise is not None)

    def testable(term: int) -> bool:
        mine = _with_term(pool, term)
        own = side & mine
        return is_shared(pool.terms[term]) and bool(own) and own <= repeated and bool((mine - side) & repeated)

    wanted = [n for n, (term, _, where) in enumerate(meaning) if term >= 0 and where == -1 and testable(term)]
    if not wanted:
        return []
    wider = [np.concatenate([m, np.where(c in side, 1.0, 0.0) * m[:, wanted]], axis=1) for c, m in enumerate(maps)]
    told = determined(pool.parts, wider)
    base = len(meaning)
    kept = [n for n in range(base) if told[n]] + [base + i for i in range(len(wanted)) if told[base + i]]
    wider = [m[:, kept] for m in wider]
    inverse = normal_inverse(pool.parts, wider)
    x: Floats = inverse @ np.sum([m.T @ p.side for p, m in zip(pool.parts, wider, strict=True)], axis=0)
    wide = spread(pool.parts, wider, x, inverse)
    k2 = wide.expanded
    dropped = [meaning[wanted[i]][0] for i in range(len(wanted)) if not told[base + i]]
    out = []
    for at, column in enumerate(kept):
        if column < base or not np.isfinite(k2[at]) or k2[at] <= 0.0:
            continue
        term, parameter, _ = meaning[wanted[column - base]]
        if abs(float(x[at])) > pool.terms[term].instance.effect.parameters[parameter].largest:
            continue  # No machine changes by so much: the campaign errs in something else.
        p_value = 2.0 * t_tail(abs(float(x[at])) / float(wide.standard[at]), float(wide.dof[at]))
        beside = tuple(
            t for t in dropped if pool.terms[t].instance.effect.name == pool.terms[term].instance.effect.name
        )
        out.append(
            _Tested(side & _with_term(pool, term), term, parameter, float(x[at]), float(k2[at]), p_value, beside)
        )
    return out


def _told(worst: _Tested, pool: Pool, mine: _Side, started: Sequence[str]) -> Contradiction:
    term = pool.terms[worst.term]
    effect = term.instance.effect
    parameter = effect.parameters[worst.parameter]
    name = [part.obs.campaign.name for part in pool.parts]
    rest = _leaned_on(worst.term, mine, pool) - worst.side
    since, what = _since(worst.side, rest, started)
    pair = {term.instance.axis, *(pool.terms[t].instance.axis for t in worst.beside)}
    plane = next((plane for plane, axes in AXES_OF.items() if set(axes) == pair), None)
    return Contradiction(
        campaigns=tuple(name[c] for c in sorted(worst.side)),
        others=tuple(name[c] for c in sorted(rest)),
        effect=effect.name,
        axis=plane or term.instance.axis,
        parameter=parameter.name,
        unit=parameter.unit,
        difference=worst.difference,
        k2=worst.k2,
        p_value=worst.p_value,
        since=since,
        what=what,
    )


def _leaned_on(term: int, mine: _Side, pool: Pool) -> _Side:
    """Return the campaigns that say how large a term is: where one sees it beside another axis, those that know that one, too."""
    name = pool.terms[term].instance.effect.name
    mates = {
        t
        for c in mine
        for t in pool.parts[c].number_of
        if pool.terms[t].instance.effect.name == name and pool.terms[t].instance.effect.per == "plane_or_axis"
    }
    return mine.union(*(_with_term(pool, mate) for mate in mates))


def _since(side: _Side, rest: _Side, started: Sequence[str]) -> tuple[str, What]:
    """Return the first day with another value, and whether it stayed."""
    mine, theirs = sorted(started[c] for c in side), sorted(started[c] for c in rest)
    if not mine[0] or not theirs[0]:
        return max(mine[0], theirs[0]), "change or mistake"
    if mine[0] > theirs[-1]:
        return mine[0], "change" if len(side) > 1 else "change or mistake"
    if theirs[0] > mine[-1]:
        return theirs[0], "change" if len(rest) > 1 else "change or mistake"
    return mine[0], "mistake" if len(side) == 1 else "change or mistake"
