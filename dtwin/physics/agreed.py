"""Sizes that fits of several campaigns share: generalised least squares over their estimates, and who contradicts whom.

Each fit gives estimates with their covariance. For laws that are linear this is the same as one fit of all readings. It serves
where campaigns have no common grid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from dtwin.physics.contradictions import Contradiction, since_when, stays
from dtwin.schema import Floats
from dtwin.statistics import holm, k2_factor, t_tail

_ALPHA = 0.01
_MOST = 6
# Laws are not exact: standard uncertainty of a size that comes of it, as a share.
_INEXACT = 0.01

Groups = Mapping[tuple[int, "Quantity"], int]
"""Which value of a quantity a fit has, by number of fit; 0 where nothing is said."""


@dataclass(frozen=True)
class Quantity:
    """A number that a machine has, whoever measures it.

    ``effect``: by which name it is told; ``largest``: beyond which no machine is.
    """

    cause: str
    axis: str
    parameter: str
    unit: str = field(compare=False)
    effect: str = field(compare=False)
    largest: float = field(compare=False, default=float("inf"))


@dataclass(frozen=True)
class Sizes:
    """What a fit says of its parameters.

    ``of``: what of the machine each is, of what is told; None for what belongs to the campaign.
    ``value``, ``dof``, (k,): in the units of the quantities; degrees of freedom of the uncertainty.
    ``covariance``, (k, k): of standard uncertainties.
    """

    of: tuple[Quantity | None, ...]
    value: Floats
    covariance: Floats
    dof: Floats

    @property
    def standard(self) -> Floats:
        """Standard uncertainties, shape (k,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    def at(self, quantity: Quantity) -> int | None:
        """Return the number of a quantity among the parameters, None where it is not told."""
        return self.of.index(quantity) if quantity in self.of else None

    def shared(self) -> Sizes:
        """Return what is said of the machine alone."""
        kept = [i for i, quantity in enumerate(self.of) if quantity is not None]
        return Sizes(
            tuple(self.of[i] for i in kept), self.value[kept], self.covariance[np.ix_(kept, kept)], self.dof[kept]
        )


@dataclass(frozen=True)
class _Solved:
    """All parameters of all fits, one behind the other: ``taken`` (total, total) makes agreed values of those that were fitted."""

    parts: tuple[Sizes, ...]
    value: Floats
    taken: Floats

    def variance(self, weights: Floats) -> tuple[float, float]:
        """Return the variance of a sum of parameters, and its degrees of freedom after Welch and Satterthwaite."""
        influence = self.taken.T @ weights
        total, least, begin = 0.0, 0.0, 0
        for part in self.parts:
            own = influence[begin : begin + len(part.of)]
            begin += len(part.of)
            # Of each parameter its share, for they may have degrees of freedom of their own.
            shares = own * (part.covariance @ own)
            variance = max(float(shares.sum()), 0.0)
            total += variance
            sure = float((np.abs(shares) / part.dof).sum() / max(float(np.abs(shares).sum()), 1e-300))
            least += variance**2 * sure
        return total, total**2 / least if least > 0.0 else float("inf")


def agreed(parts: Sequence[Sizes], groups: Groups | None = None) -> list[Sizes]:
    """Return what each fit says beside all others: shared quantities have one value, and the rest is what fits beside them."""
    solved = _solved(parts, groups or {})
    out, begin = [], 0
    for part in parts:
        own = slice(begin, begin + len(part.of))
        begin += len(part.of)
        covariance = np.zeros_like(part.covariance)
        first = 0
        for other in parts:
            taken = solved.taken[own, first : first + len(other.of)]
            first += len(other.of)
            covariance += taken @ other.covariance @ taken.T
        moved = np.abs(solved.taken[own] - np.eye(len(solved.value))[own]).max(axis=1, initial=0.0) > 0.0
        dof = part.dof.copy()
        for i in np.flatnonzero(moved):
            dof[i] = min(solved.variance(np.eye(len(solved.value))[own][i])[1], 1e6)
        out.append(replace(part, value=solved.value[own], covariance=covariance, dof=dof))
    return out


def _solved(parts: Sequence[Sizes], groups: Groups) -> _Solved:
    """Move all estimates until those of one quantity are equal, each as far as it is uncertain."""
    total = sum(len(part.of) for part in parts)
    where: dict[tuple[Quantity, int], list[int]] = {}
    begin = 0
    for p, part in enumerate(parts):
        for i, quantity in enumerate(part.of):
            if quantity is not None:
                where.setdefault((quantity, groups.get((p, quantity), 0)), []).append(begin + i)
        begin += len(part.of)
    value = np.concatenate([part.value for part in parts])
    pairs = [pair for columns in where.values() for pair in pairwise(columns)]
    if not pairs:
        return _Solved(tuple(parts), value, np.eye(total))
    apart = np.zeros((len(pairs), total))
    for row, (a, b) in enumerate(pairs):
        apart[row, a], apart[row, b] = 1.0, -1.0
    spread = np.concatenate([part.covariance @ rows for part, rows in _by_part(parts, apart.T)])
    joint = apart @ spread
    size = np.sqrt(np.maximum(np.diag(joint), 1e-300))
    inverse = np.linalg.pinv(joint / np.outer(size, size), rcond=1e-12, hermitian=True) / np.outer(size, size)
    taken = np.eye(total) - spread @ inverse @ apart
    return _Solved(tuple(parts), taken @ value, taken)


def _by_part(parts: Sequence[Sizes], rows: Floats) -> list[tuple[Sizes, Floats]]:
    ends = np.cumsum([len(part.of) for part in parts])[:-1]
    return list(zip(parts, np.split(rows, ends), strict=True))


@dataclass(frozen=True)
class _Split:
    """A quantity on one side of the fits against the others; ``times``: the difference in standard uncertainties."""

    quantity: Quantity
    side: frozenset[int]
    difference: float
    k2: float
    times: float
    p_value: float


def contradicting(
    parts: Sequence[Sizes], begun: Sequence[Sequence[tuple[str, str]]]
) -> tuple[Groups, tuple[Contradiction, ...]]:
    """Return which fits have a value of their own, because they contradict the others, and what that is; the surest first.

    Each quantity is tested for each fit, and for all from a day on, while all others are shared; with Holm's correction.

    ``begun``: of each fit its campaigns, name and day.
    """
    parts = [_inexact(part.shared()) for part in parts]
    groups: dict[tuple[int, Quantity], int] = {}
    contradictions: list[Contradiction] = []
    while len(contradictions) < _MOST:
        tests = [
            test
            for quantity in dict.fromkeys(q for part in parts for q in part.of if q is not None)
            for side in _sides(_among(parts, groups, quantity), begun)
            if (test := _tested(parts, groups, quantity, side)) is not None
        ]
        p_values = holm([test.p_value for test in tests]) if tests else np.ones(0)
        surely = [replace(t, p_value=float(p)) for p, t in zip(p_values, tests, strict=True) if p <= _ALPHA]
        if not surely:
            break
        # Where that one has a value of its own, the least is left that does not agree.
        worst = max(surely, key=lambda test: test.times)
        mine = _among(parts, groups, worst.quantity)
        rivals = _rivals(parts, groups, worst, tests)
        contradictions.append(_told(worst, mine, begun, rivals))
        names = [c for one in begun for c in one]
        days = [day for _, day in names]
        ours, theirs = (
            frozenset(names.index(c) for p in side for c in begun[p]) for side in (worst.side, mine - worst.side)
        )
        moved = worst.side if stays(theirs, ours, days) else mine - worst.side
        new = 1 + max(groups.values(), default=0)
        groups |= {(p, worst.quantity): new for p in moved}
    return groups, tuple(contradictions)


def _inexact(sizes: Sizes) -> Sizes:
    """Return sizes that are as uncertain as laws are inexact, too."""
    return replace(sizes, covariance=sizes.covariance + np.diag((_INEXACT * sizes.value) ** 2))


def _among(parts: Sequence[Sizes], groups: Groups, quantity: Quantity) -> frozenset[int]:
    return frozenset(p for p, part in enumerate(parts) if quantity in part.of and not groups.get((p, quantity), 0))


def _sides(among: frozenset[int], begun: Sequence[Sequence[tuple[str, str]]]) -> list[frozenset[int]]:
    """Return each fit alone, and all from a day on where days part them."""
    if len(among) < 2:
        return []
    order = sorted(among, key=lambda p: (min(day for _, day in begun[p]), p))
    singles = [frozenset([p]) for p in (order[-1:] if len(order) == 2 else order)]
    days = [[day for _, day in begun[p]] for p in order]
    if any(not day for one in days for day in one) or any(max(a) >= min(b) for a, b in pairwise(days)):
        return singles
    return list(dict.fromkeys([*(frozenset(order[i:]) for i in range(1, len(order))), *singles]))


def _tested(parts: Sequence[Sizes], groups: Groups, quantity: Quantity, side: frozenset[int]) -> _Split | None:
    """Test whether a quantity has another value on a side."""
    new = 1 + max(groups.values(), default=0)
    solved = _solved(parts, {**groups, **{(p, quantity): new for p in side}})
    first, second = (_column(parts, quantity, p) for p in (min(side), min(_among(parts, groups, quantity) - side)))
    weights = np.zeros(len(solved.value))
    weights[first], weights[second] = 1.0, -1.0
    variance, dof = solved.variance(weights)
    difference = float(solved.value[first] - solved.value[second])
    if variance <= 0.0 or abs(difference) > quantity.largest:
        return None
    standard = float(np.sqrt(variance))
    times = abs(difference) / standard
    return _Split(quantity, side, difference, k2_factor(dof) * standard, times, 2.0 * t_tail(times, dof))


def _column(parts: Sequence[Sizes], quantity: Quantity, number: int) -> int:
    return sum(len(part.of) for part in parts[:number]) + parts[number].of.index(quantity)


def _rivals(parts: Sequence[Sizes], groups: Groups, worst: _Split, tests: Sequence[_Split]) -> tuple[str, ...]:
    """Return the quantities of which the same side might as well have another size instead."""
    new = 1 + max(groups.values(), default=0)
    out = []
    for other in tests:
        if other.side != worst.side or other.quantity == worst.quantity or other.p_value > _ALPHA:
            continue
        beside = {**groups, **{(p, other.quantity): new for p in other.side}}
        again = _tested(parts, beside, worst.quantity, worst.side)
        if again is not None and again.p_value > _ALPHA:
            out.append(f"{other.quantity.effect} {other.quantity.axis}".rstrip())
    return tuple(dict.fromkeys(out))


def _told(
    worst: _Split, mine: frozenset[int], begun: Sequence[Sequence[tuple[str, str]]], rivals: tuple[str, ...]
) -> Contradiction:
    every = [c for one in begun for c in one]
    sides = [[c for p in sorted(side) for c in begun[p]] for side in (worst.side, mine - worst.side)]
    ours, theirs = (frozenset(every.index(c) for c in side) for side in sides)
    since, what = since_when(ours, theirs, [day for _, day in every])
    quantity = worst.quantity
    return Contradiction(
        campaigns=tuple(name for name, _ in sides[0]),
        others=tuple(name for name, _ in sides[1]),
        effect=quantity.effect,
        axis=quantity.axis,
        parameter=quantity.parameter,
        unit=quantity.unit,
        difference=worst.difference,
        k2=worst.k2,
        p_value=worst.p_value,
        since=since,
        what=what,
        rivals=rivals,
    )
