"""What a common fit of tests of a path says of the machine, for fits of other kinds to agree with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dtwin.physics._pooled import Part, missed, normal_inverse, scatter, spread
from dtwin.physics.agreed import Quantity, Sizes
from dtwin.physics.machine_terms import key_of
from dtwin.physics.problem import Term
from dtwin.physics.several import SeveralFit, as_seen, of_machine
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail, k2_factor

# As in the inverse of the normal equations: smaller eigenvalues tell nothing.
_UNSEEN = 1e-10
_ROUNDING_UM = 1e-6
# Of the largest possible size: what is known no better is not told.
_TOLD = 0.1
# Beyond three standard uncertainties on either side.
_THERE = 0.0027


def sizes_of(fitted: SeveralFit) -> Sizes:
    """Return all parameters of a common fit. What the runs do not tell is as uncertain as no machine is."""
    pool = fitted.pool
    maps, meaning = pool.maps()
    inverse = normal_inverse(pool.parts, maps)
    value: Floats = inverse @ np.sum([m.T @ p.side for p, m in zip(pool.parts, maps, strict=True)], axis=0)
    every = [_of_part(p, m, value, inverse) for p, m in zip(pool.parts, maps, strict=True)]
    covariance = np.asarray(np.sum(every, axis=0))
    largest = _largest(fitted)
    unseen = _unseen(pool.parts, maps, largest)
    nothing = _nothing(pool.parts, maps, largest)
    value[nothing] = 0.0
    covariance[nothing], covariance[:, nothing] = 0.0, 0.0
    covariance[nothing, nothing] = largest[nothing] ** 2
    unseen[nothing] = 0.0
    dof = spread(pool.parts, maps, value, inverse).dof
    of: list[Quantity | None] = []
    for number, j, where in meaning:
        of.append(_quantity(fitted.terms[number], j) if number >= 0 and where == -1 else None)
    return Sizes(tuple(of), value, covariance + unseen @ unseen.T, np.where(dof > 0.0, dof, 1.0))


def nothing_of(fitted: SeveralFit) -> set[tuple[str, str]]:
    """Return cause and axis of the terms whose parameters, taken together, are nothing to three standard uncertainties, in every campaign.

    Sizes that only have a meaning together, such as cosine and sine, or lags that look alike, are uncertain one by one.
    """
    sizes = sizes_of(fitted)
    wide = np.array([k2_factor(float(dof)) for dof in sizes.dof]) / 2.0
    covariance = sizes.covariance * np.outer(wide, wide)
    _, meaning = fitted.pool.maps()
    there = set()
    for number, where in {(number, where) for number, _, where in meaning if number >= 0}:
        own = [n for n, (t, _, w) in enumerate(meaning) if (t, w) == (number, where) and sizes.value[n] != 0.0]
        chi2 = float(sizes.value[own] @ np.linalg.pinv(covariance[np.ix_(own, own)], hermitian=True) @ sizes.value[own])
        if own and chi2_tail(chi2, float(len(own))) < _THERE:
            there.add(key_of(fitted.terms[number]))
    return {key_of(term) for term in fitted.terms} - there


def with_sizes(fitted: SeveralFit, sizes: Sizes) -> SeveralFit:
    """Return a common fit with the values that others agree on; ``sizes``: in the order of :func:`sizes_of`."""
    maps, _ = fitted.pool.maps()
    wide = sizes.standard * np.array([k2_factor(float(dof)) for dof in sizes.dof])
    hidden = sizes.standard > _TOLD * _largest(fitted)
    fits = tuple(
        as_seen(part, sizes.value[own], wide[own], hidden[own])
        for part, own in zip(fitted.pool.parts, (to_own.argmax(axis=1) for to_own in maps), strict=True)
    )
    return replace(fitted, fits=fits, estimates=tuple(of_machine(fitted.pool, fits)))


def covariance_in(fitted: SeveralFit, sizes: Sizes, campaign: int) -> Floats:
    """Return the covariance of the effects' parameters as a campaign sees them, by its number, shape (parameters, parameters)."""
    maps, _ = fitted.pool.maps()
    own = maps[campaign].argmax(axis=1)[fitted.pool.parts[campaign].obs.n_setup :]
    return np.asarray(sizes.covariance[np.ix_(own, own)])


def _quantity(term: Term, number: int) -> Quantity:
    parameter = term.instance.effect.parameters[number]
    return Quantity(*key_of(term), parameter.name, parameter.unit, term.instance.effect.name, parameter.largest)


def _largest(fitted: SeveralFit) -> Floats:
    """Return the size beyond which no machine is, of each common parameter; of set-ups there is none."""
    _, meaning = fitted.pool.maps()
    parameters = [None if t < 0 else fitted.terms[t].instance.effect.parameters[j] for t, j, _ in meaning]
    return np.array([np.inf if one is None else one.largest for one in parameters])


def _nothing(parts: Sequence[Part], maps: Sequence[Floats], largest: Floats) -> NDArray[np.bool_]:
    """Tell which parameters do nothing but rounding, at the largest size that a machine may have, shape (total,)."""
    power = np.sum([m.T @ (p.columns**2).mean(axis=0) for p, m in zip(parts, maps, strict=True)], axis=0)
    return np.asarray(
        np.isfinite(largest) & (np.sqrt(power) * np.where(np.isfinite(largest), largest, 0.0) < _ROUNDING_UM)
    )


def _unseen(parts: Sequence[Part], maps: Sequence[Floats], largest: Floats) -> Floats:
    """Return combinations of parameters that change no reading, as large as a machine may be, shape (total, combinations)."""
    normal = np.asarray(sum(m.T @ p.gram @ m for p, m in zip(parts, maps, strict=True)))
    size = np.sqrt(np.diag(normal))
    scale = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    vanishing = vectors[:, values <= _UNSEEN * values[-1]] / scale[:, None]
    share = np.abs(vanishing / largest[:, None]).max(axis=0, initial=0.0)
    return np.asarray(vanishing[:, share > 0.0] / share[share > 0.0])


def _of_part(part: Part, to_own: Floats, x: Floats, inverse: Floats) -> Floats:
    """Return the covariance that a campaign adds; what laws miss is added to the noise, with the condition as the unit."""
    seen = scatter(part, to_own, x, inverse)
    return np.asarray(seen.covariance + missed(part, seen)) if seen.misses else seen.covariance
