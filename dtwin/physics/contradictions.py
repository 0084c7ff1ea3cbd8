"""Which campaign of a machine contradicts the others: what, by how much, and since when."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dtwin.physics._pooled import Part, determined, normal_inverse, spread
from dtwin.physics.machine_terms import is_shared, is_wave
from dtwin.physics.observations import Observations
from dtwin.physics.several import Pool, SeveralFit, amplitude, by_floors, regrouped, seen_estimates
from dtwin.physics.state import AXES_OF
from dtwin.physics.whitening import condition_sums, within_condition
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail, holm, t_tail

_ALPHA = 0.01
_MOST = 6
# What is alike in the repeats of a test is seen where its variance is a larger share than this of that of the noise.
_UNSEEN = 0.05
# Of the largest difference in standard uncertainties, what all campaigns together must show to be asked before equal tests are.
_HIDDEN = 0.5
# No law says what an effect does better than to this share of it.
_INEXACT = 0.02

_What = Literal["change", "mistake", "change or mistake"]
_Side = frozenset[int]


@dataclass(frozen=True)
class Contradiction:
    """A parameter of which campaigns have another value than the rest.

    ``campaigns``, ``others``: those that differ, and those that they differ from.
    ``effect``, ``axis``, ``parameter``, ``unit``: what differs; the axis is a plane where only the difference of its
    two axes is told.
    ``difference``, ``k2``: by how much, with its expanded uncertainty; unit of replication: the run.
    ``missed``: part of ``k2``: how far laws that are not exact may move it.
    ``p_value``: of what the difference is beyond that, after Holm over campaigns and parameters.
    ``since``: first day with the newer value, as the campaign states it; empty when no day is stated.
    ``what``: ``change`` of the machine where later tests agree with it, ``mistake`` where tests before and after agree
    with each other, ``change or mistake`` where the newest test alone differs.
    ``rivals``: effects of which these tests might as well have another size instead.
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
    what: _What
    rivals: tuple[str, ...] = ()
    missed: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        lists = {name: list(getattr(self, name)) for name in ("campaigns", "others", "rivals")}
        return {**vars(self), **lists}


@dataclass(frozen=True)
class _Tested:
    """A shared parameter on one side of the campaigns against the rest; ``times``: the difference beyond what laws miss, in standard uncertainties."""

    side: _Side
    term: int
    parameter: int
    difference: float
    k2: float
    times: float
    p_value: float
    beside: tuple[int, ...]
    beyond: _Side = frozenset()
    missed: float = 0.0


def without_contradictions(fitted: SeveralFit, started: Sequence[str]) -> tuple[SeveralFit, tuple[Contradiction, ...]]:
    """Give campaigns that contradict the others a value of their own, the most certain first, and name them.

    ``started``: when each campaign was begun, ISO 8601; empty where that is not stated.
    """
    contradictions: list[Contradiction] = []
    while len(contradictions) < _MOST:
        pool = by_floors(fitted.pool)
        worst = _worst(pool, started)
        if worst is None:
            break
        groups = dict(pool.groups)
        mine = _with_term(pool, worst.term)
        new = 1 + max(groups.values(), default=0)
        moved = worst.side if stays(mine - worst.side, worst.side, started) else mine - worst.side
        groups |= {(c, worst.term): new for c in moved}
        contradictions.append(replace(_told(worst, pool, mine, started), rivals=_rivals(pool, worst)))
        fitted = regrouped(fitted, groups)
    return fitted, (*contradictions, *_of_waves(fitted, started))


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
            _Tested(frozenset([c]), number, 0, difference, k2, 2.0 * abs(difference) / k2, float(p_values[i]), ()),
            fitted.pool,
            mine,
            started,
        )
        out.append(replace(told, parameter="amplitude"))
    return out


def _with_term(pool: Pool, term: int) -> _Side:
    """Return the campaigns that share a term still."""
    return frozenset(
        c for c, part in enumerate(pool.parts) if term in part.number_of and not pool.groups.get((c, term), 0)
    )


def stays(rest: _Side, side: _Side, started: Sequence[str]) -> bool:
    """Tell whether the rest keeps the common value: the larger side does, and of equal ones the newer."""
    if len(rest) != len(side):
        return len(rest) > len(side)
    return max(started[c] for c in rest) > max(started[c] for c in side)


def _worst(pool: Pool, started: Sequence[str]) -> _Tested | None:
    tests = [t for side, beyond in _comparisons(pool, started) for t in _tested(pool, side, beyond)]
    if not tests:
        return None
    p_values = holm([t.p_value for t in tests])
    surely = [replace(t, p_value=float(p)) for p, t in zip(p_values, tests, strict=True) if p <= _ALPHA]
    # Where the largest has a value of its own, the least is left that does not agree; a p-value says how often tests were repeated.
    # Equal tests alone are believed where laws that are not exact hide most of a difference from all of them together.
    least = _HIDDEN * max((test.times for test in surely), default=0.0)
    every = [test for test in surely if not test.beyond and test.times >= least]
    return max(every or surely, key=lambda test: test.times, default=None)


def _comparisons(pool: Pool, started: Sequence[str]) -> list[tuple[_Side, _Side]]:
    """Return what is tested against the rest, and which campaigns belong to neither: among all of them, and among equal tests.

    Equal tests miss the same by the same law, so that they tell a change that laws which are not exact hide from others.
    """
    every = frozenset(range(len(pool.parts)))
    made: dict[frozenset[Hashable], list[int]] = {}
    for c, part in enumerate(pool.parts):
        made.setdefault(frozenset(_measured(part)), []).append(c)
    equal = [frozenset(alike) for alike in made.values() if 1 < len(alike) < len(every)]
    return [(side, every - among) for among in (every, *equal) for side in _sides(sorted(among), started)]


def _sides(among: Sequence[int], started: Sequence[str]) -> list[_Side]:
    """Return each campaign alone, and all from a day on."""
    singles = [frozenset([c]) for c in among[: 1 if len(among) == 2 else None]]
    days = [started[c] for c in among]
    if len(set(days)) < len(days) or not all(days):
        return singles
    order = sorted(among, key=lambda c: started[c])
    later = [frozenset(order[i:]) for i in range(1, len(order))]
    return later if len(among) == 2 else list(dict.fromkeys([*later, *singles]))


def _measured(part: Part) -> list[Hashable]:
    """Return what says which conditions of different campaigns are the same."""
    return [(part.obs.grid.kind, part.obs.n_bins, condition) for condition in part.obs.conditions]


def _bound(parts: Sequence[Part], maps: Sequence[Floats], x: Floats, inverse: Floats) -> Floats:
    """Return by how much laws that are not exact can move the common parameters, shape (total,).

    A law misses what repeats agree on and the fit leaves, and a share of what it explains: alike in equal conditions. What is too
    small to be seen beside the noise is of each campaign. All of it may lie where a parameter takes it up.
    """
    moved: dict[Hashable, Floats] = {}
    missed: dict[Hashable, list[float]] = {}
    unseen = np.zeros(len(x))
    for part, to_own in zip(parts, maps, strict=True):
        obs, own = part.obs, to_own @ x
        count = np.bincount(obs.condition_of)

        def by_condition(values: Floats, obs: Observations = obs) -> Floats:
            return condition_sums(values.reshape(obs.n_rows, obs.n_bins, -1), obs.condition_of)

        influence = by_condition((part.columns * part.root**2) @ to_own @ inverse)
        left = part.problem.y - part.columns @ own
        deviation, of = within_condition(left.reshape(obs.n_rows, obs.n_bins), obs.condition_of)
        noise = float((deviation[of > 1] ** 2).sum(axis=1).mean()) if (of > 1).any() else 0.0
        unseen += _UNSEEN * noise * len(count) * (influence**2).sum(axis=(0, 1))
        left_over = np.maximum((by_condition(left)[..., 0] ** 2).sum(axis=1) / count**2 - noise / count, 0.0)
        explained = np.zeros(len(count))
        for _, span in part.spans():
            explained += (by_condition(part.columns[:, span] @ own[span])[..., 0] ** 2).sum(axis=1) / count**2
        for i, key in enumerate(_measured(part)):
            moved[key] = moved.get(key, 0.0) + influence[i]
            missed.setdefault(key, []).append(float(left_over[i] + _INEXACT**2 * explained[i]))
    together = sum(float(np.mean(each)) for each in missed.values())
    return np.asarray(np.sqrt(together * sum((one**2).sum(axis=0) for one in moved.values()) + unseen))


def _tested(pool: Pool, side: _Side, beyond: _Side) -> list[_Tested]:
    """Test all shared parameters of one side against the rest: Wald tests of one common fit in which they may differ.

    Those ``beyond`` have values of their own; equal tests, which are compared without them, tell one parameter after the other.
    """
    _maps, meaning = pool.maps()
    # Without repeats nobody knows whether a campaign differs.
    repeated = frozenset(c for c, part in enumerate(pool.parts) if part.problem.noise is not None)

    def testable(term: int) -> bool:
        mine = _with_term(pool, term)
        own = side & mine
        return (
            is_shared(pool.terms[term], pool.terms)
            and bool(own)
            and own <= repeated
            and bool((mine - side - beyond) & repeated)
        )

    wanted = [n for n, (term, _, where) in enumerate(meaning) if term >= 0 and where == -1 and testable(term)]
    base = _base(pool, beyond, wanted)
    if not beyond:
        return _wald(pool, side, beyond, base, wanted, ()) if wanted else []
    return [t for n in wanted for t in _wald(pool, side, beyond, base, [n], [m for m in wanted if m != n])]


def _base(pool: Pool, beyond: _Side, wanted: Sequence[int]) -> list[Floats]:
    """Return the maps of a fit in which those beyond have values of their own."""
    maps, _ = pool.maps()
    if not beyond:
        return maps
    return [np.concatenate([m, float(c in beyond) * m[:, wanted]], axis=1) for c, m in enumerate(maps)]


def _rivals(pool: Pool, tested: _Tested) -> tuple[str, ...]:
    """Return the effects beside which, were they to differ, what was found among equal tests is none."""
    if not tested.beyond:
        return ()
    _, meaning = pool.maps()
    among = frozenset(range(len(pool.parts))) - tested.beyond
    shared = [n for n, (t, _, w) in enumerate(meaning) if t >= 0 and w == -1 and is_shared(pool.terms[t], pool.terms)]
    seen = [n for n in shared if among <= _with_term(pool, meaning[n][0])]
    mine = next(n for n in shared if meaning[n][:2] == (tested.term, tested.parameter))
    base = _base(pool, tested.beyond, seen)
    out = []
    for n in seen:
        term = meaning[n][0]
        if term == tested.term or term in tested.beside:
            continue
        told = _wald(pool, tested.side, tested.beyond, base, [n, mine], ())
        if all(t.p_value > _ALPHA for t in told if (t.term, t.parameter) == (tested.term, tested.parameter)):
            out.append(pool.terms[term].label)
    return tuple(dict.fromkeys(out))


def _wald(
    pool: Pool, side: _Side, beyond: _Side, base: Sequence[Floats], wanted: Sequence[int], others: Sequence[int]
) -> list[_Tested]:
    """Test those common parameters that are wanted beside each other; only what exceeds what laws miss is a difference.

    ``others`` have the same value on both sides, and are said to be beside what cannot be told from them.
    """
    _, meaning = pool.maps()
    first, split = base[0].shape[1], [*wanted, *others]
    wider = [np.concatenate([m, float(c in side) * m[:, split]], axis=1) for c, m in enumerate(base)]
    told = determined(pool.parts, wider)
    last = first + len(wanted)
    kept = np.flatnonzero(told[:last])
    dropped = [meaning[n][0] for i, n in enumerate(split) if not told[first + i]]
    wider = [m[:, kept] for m in wider]
    inverse = normal_inverse(pool.parts, wider)
    x: Floats = inverse @ np.sum([m.T @ p.side for p, m in zip(pool.parts, wider, strict=True)], axis=0)
    wide, missed = spread(pool.parts, wider, x, inverse), _bound(pool.parts, wider, x, inverse)
    k2 = wide.expanded + missed
    out = []
    for at, column in enumerate(kept):
        if column < first or not np.isfinite(k2[at]) or k2[at] <= 0.0:
            continue
        term, parameter, _ = meaning[wanted[column - first]]
        if abs(float(x[at])) > pool.terms[term].instance.effect.parameters[parameter].largest:
            continue  # No machine changes by so much: the campaign errs in something else.
        excess = max(0.0, abs(float(x[at])) - float(missed[at]))
        times = excess / float(wide.standard[at])
        p_value = 2.0 * t_tail(times, float(wide.dof[at]))
        name = pool.terms[term].instance.effect.name
        beside = tuple(t for t in dropped if pool.terms[t].instance.effect.name == name)
        own = side & _with_term(pool, term)
        out.append(
            _Tested(
                own, term, parameter, float(x[at]), float(k2[at]), times, p_value, beside, beyond, float(missed[at])
            )
        )
    return out


def _told(worst: _Tested, pool: Pool, mine: _Side, started: Sequence[str]) -> Contradiction:
    term = pool.terms[worst.term]
    effect = term.instance.effect
    parameter = effect.parameters[worst.parameter]
    name = [part.obs.campaign.name for part in pool.parts]
    rest = _leaned_on(worst.term, mine, pool) - worst.side - worst.beyond
    since, what = since_when(worst.side, rest, started)
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
        missed=worst.missed,
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


def since_when(side: _Side, rest: _Side, started: Sequence[str]) -> tuple[str, _What]:
    """Return the first day with another value, and whether it stayed."""
    mine, theirs = sorted(started[c] for c in side), sorted(started[c] for c in rest)
    if not mine[0] or not theirs[0]:
        return max(mine[0], theirs[0]), "change or mistake"
    if mine[0] > theirs[-1]:
        return mine[0], "change" if len(side) > 1 else "change or mistake"
    if theirs[0] > mine[-1]:
        return theirs[0], "change" if len(rest) > 1 else "change or mistake"
    return mine[0], "mistake" if len(side) == 1 else "change or mistake"
