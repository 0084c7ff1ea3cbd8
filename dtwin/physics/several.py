"""One fit of several campaigns of a machine: common effects, set-ups and noise of each by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.physics import localise
from dtwin.physics._pooled import Part, normal_inverse, own_columns, solve_pooled, spread, wider
from dtwin.physics._reference_lines import with_reference_lines
from dtwin.physics.effect import Effect
from dtwin.physics.fit import Alias, Estimate, Fit, estimates, find_aliases, residual_um, run_weights, setups, shaped
from dtwin.physics.machine_terms import is_shared, is_wave, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term, unweighted_with_noise
from dtwin.schema import Floats

_ALIAS = 0.95
_HIDDEN = 1e-6
_ROBUST_ROUNDS = 5
_WEIGHT_ROUNDS = 3
_SHAPE_ROUNDS = 3
# A round of shapes that lowers the sum of squares by less is the last one.
_SETTLED = 1e-3

_Groups = Mapping[tuple[int, int], int]
"""Which value of a shared term a campaign has, by number of campaign and of term; 0 where nothing is said."""


@dataclass(frozen=True)
class Pool:
    """Campaigns ready to be solved together.

    ``terms``: effects of the machine.
    ``groups``: campaigns that contradict others have a value of their own.
    """

    parts: tuple[Part, ...]
    terms: tuple[Term, ...]
    groups: _Groups = field(default_factory=dict)

    def maps(self) -> tuple[list[Floats], list[tuple[int, int, int]]]:
        """Return which common parameters make those of each campaign, and what they are.

        Returns ``maps``, (k_i, total) each.
        Returns ``meaning``: term, parameter and campaign of each common one; campaign -1 - group where it is shared,
        term -1 of set-ups.
        """
        meaning: dict[tuple[int, int, int], int] = {}
        rows: list[list[int]] = []
        for c, part in enumerate(self.parts):
            own = [meaning.setdefault((-1, i, c), len(meaning)) for i in range(part.obs.n_setup)]
            for i, span in part.spans():
                t = part.number_of[i]
                where = -1 - self.groups.get((c, t), 0) if is_shared(self.terms[t], self.terms) else c
                own += [meaning.setdefault((t, j, where), len(meaning)) for j in range(span.stop - span.start)]
            rows.append(own)
        return [np.eye(len(meaning))[own] for own in rows], list(meaning)


@dataclass(frozen=True)
class SeveralFit:
    """Result of a common fit.

    ``pool``: what was fitted.
    ``fits``: the same as each campaign sees it, with its set-ups, residual and noise floor.
    ``terms``: effects of the machine, with the shapes that were found.
    ``estimates``: their parameters; of waves the amplitude, of what belongs to one campaign its values there.
    ``weights``: of each campaign, 1/um.
    ``rank``, ``n_columns``, ``condition``, ``aliases``: of all of them together, as in :class:`dtwin.physics.fit.Fit`.
    """

    pool: Pool
    fits: tuple[Fit, ...]
    terms: tuple[Term, ...]
    estimates: tuple[Estimate, ...]
    weights: tuple[float, ...]
    rank: int
    n_columns: int
    condition: float
    aliases: tuple[Alias, ...]


def fit_several(
    campaigns: Sequence[Observations],
    terms: Sequence[Term],
    library: Mapping[str, Effect],
    *,
    robust: bool = False,
    refine: bool = True,
) -> SeveralFit:
    """Fit effects of a machine to several of its campaigns: one least squares over all of them.

    Within a campaign all harmonics weigh alike, as where it is fitted alone; a campaign weighs by the uncertainty that it leaves,
    fitted alone, of what campaigns share (unit of replication: the run; the condition where the laws miss more than the noise).

    ``terms``: effects of the machine; shape parameters are refined from where they are.
    ``robust``: give runs that are far off less weight (Huber, by run).
    ``refine``: search the shapes of effects from where they are; otherwise they stay.
    Raises ``InputError`` when no campaign sees an effect.
    """
    terms = with_reference_lines(terms, campaigns)
    pool = _pooled(campaigns, terms, library)
    if refine and any(t.instance.effect.refined_shapes(True) for t in terms):
        pool = _pooled(campaigns, _refined(pool, library).terms, library)
    for _ in range(_ROBUST_ROUNDS if robust else 0):
        pool = replace(pool, parts=tuple(_by_runs(pool)))
    return _solved(_by_certainty(pool))


def _pooled(campaigns: Sequence[Observations], terms: Sequence[Term], library: Mapping[str, Effect]) -> Pool:
    """Return campaigns with their columns and the weights that their floors give."""
    seen = [[seen_by(term, obs, library) for term in terms] for obs in campaigns]
    for number, term in enumerate(terms):
        if all(mine[number] is None for mine in seen):
            raise InputError(
                "an effect has nothing to act on in these campaigns",
                code="fit.nothing_to_act_on",
                where=", ".join(obs.campaign.name for obs in campaigns),
                got=term.label,
            )
    parts = []
    for obs, mine in zip(campaigns, seen, strict=True):
        here = tuple(t for t in mine if t is not None)
        numbers = tuple(i for i, t in enumerate(mine) if t is not None)
        problem = unweighted_with_noise(obs, here)
        parts.append(Part(problem, here, numbers, own_columns(problem, here), np.ones(obs.n_rows), 1.0))
    return by_floors(Pool(tuple(parts), tuple(terms)))


def by_floors(pool: Pool) -> Pool:
    """Return campaigns with the weights that what is left within their runs gives."""
    for _ in range(_WEIGHT_ROUNDS):
        weights = [1.0 / max(um, 1e-9) for um in _within_runs_um(pool)]
        parts = tuple(replace(p, weight=weight) for p, weight in zip(pool.parts, weights, strict=True))
        pool = replace(pool, parts=parts)
    return pool


def _by_certainty(pool: Pool) -> Pool:
    """Return campaigns with the weights that the uncertainty of what they share gives, each fitted alone."""
    times = [wider(part, x, _shared_columns(pool, part)) for part, x in zip(pool.parts, _own_values(pool), strict=True)]
    parts = tuple(replace(p, weight=p.weight / t) for p, t in zip(pool.parts, times, strict=True))
    return replace(pool, parts=parts)


def _shared_columns(pool: Pool, part: Part) -> NDArray[np.bool_]:
    """Tell which columns of a campaign belong to effects that campaigns share, shape (k,)."""
    out = np.zeros(part.columns.shape[1], dtype=bool)
    for i, span in part.spans():
        out[span] = is_shared(pool.terms[part.number_of[i]], pool.terms)
    return out


def _within_runs_um(pool: Pool) -> list[float]:
    """Return the RMS of what is left in each campaign, the mean of every run taken out."""
    out = []
    for part, x in zip(pool.parts, _own_values(pool), strict=True):
        obs, left = part.obs, residual_um(part.obs, part.columns, x)
        of_run = [obs.run_of == run for run in range(int(obs.run_of.max()) + 1)]
        means = np.array([left[rows][obs.mask[rows]].mean() if rows.any() else 0.0 for rows in of_run])
        out.append(obs.rms(left - means[obs.run_of][:, None]))
    return out


def _own_values(pool: Pool) -> list[Floats]:
    maps, _ = pool.maps()
    x = solve_pooled(pool.parts, maps).x
    return [to_own @ x for to_own in maps]


def _by_runs(pool: Pool) -> list[Part]:
    values = _own_values(pool)
    return [
        replace(p, row_weight=run_weights(p.problem, p.columns, x)) for p, x in zip(pool.parts, values, strict=True)
    ]


def _refined(pool: Pool, library: Mapping[str, Effect]) -> Pool:
    """Refine shapes: each campaign proposes what suits it beside all the others, and the best for all is taken."""
    best, cost = pool, _cost(pool)
    for _ in range(_SHAPE_ROUNDS):
        before = cost
        for number, term in enumerate(pool.terms):
            if not term.instance.effect.refined_shapes(True):
                continue
            for shape in _proposed(best, number):
                terms = [replace(t, shape=shape) if i == number else t for i, t in enumerate(best.terms)]
                tried = _reshaped(best, terms, library)
                if (tried_cost := _cost(tried)) < cost:
                    best, cost = tried, tried_cost
        if before - cost <= _SETTLED * before:
            break
    return best


def _proposed(pool: Pool, number: int) -> list[Mapping[str, float]]:
    """Return the shapes that campaigns give a term: with all that the others say of the rest, and by themselves."""
    out: list[Mapping[str, float]] = []
    for part, x in zip(pool.parts, _own_values(pool), strict=True):
        if number not in part.number_of:
            continue
        i = part.number_of.index(number)
        here, mine = part.terms[i], dict(part.spans())[i]
        if set(here.shape) != set(pool.terms[number].shape):
            continue
        rest = x.copy()
        rest[mine] = 0.0
        rest[: part.obs.n_setup] = 0.0
        without = part.obs.with_y(residual_um(part.obs, part.columns, rest))
        out += [shaped(without, [here])[0].shape, part.shaped_alone[i].shape]
    return out


def _reshaped(pool: Pool, terms: Sequence[Term], library: Mapping[str, Effect]) -> Pool:
    parts = []
    for part in pool.parts:
        here = tuple(
            seen if (seen := seen_by(terms[t], part.obs, library)) is not None else old
            for t, old in zip(part.number_of, part.terms, strict=True)
        )
        changed = any(a.shape != b.shape for a, b in zip(here, part.terms, strict=True))
        new = Part(part.problem, here, part.number_of, own_columns(part.problem, here), part.row_weight, part.weight)
        parts.append(new if changed else part)
    return replace(pool, parts=tuple(parts), terms=tuple(terms))


def _cost(pool: Pool) -> float:
    out = 0.0
    for part, x in zip(pool.parts, _own_values(pool), strict=True):
        out += float((part.root[:, 0] ** 2 * (part.problem.y - part.columns @ x) ** 2).sum())
    return out


def regrouped(fitted: SeveralFit, groups: _Groups) -> SeveralFit:
    """Return the fit, its shapes as they are, in which campaigns have values of their own of shared terms."""
    return _solved(_by_certainty(by_floors(replace(fitted.pool, groups=groups))))


def _solved(pool: Pool) -> SeveralFit:
    maps, meaning = pool.maps()
    solution = solve_pooled(pool.parts, maps)
    inverse = normal_inverse(pool.parts, maps)
    wide = spread(pool.parts, maps, solution.x, inverse).expanded
    hidden = (solution.null_space**2).sum(axis=1) > _HIDDEN
    fits = tuple(
        as_seen(part, solution.x[own], wide[own], hidden[own])
        for part, own in zip(pool.parts, (to_own.argmax(axis=1) for to_own in maps), strict=True)
    )
    return SeveralFit(
        pool=pool,
        fits=fits,
        terms=pool.terms,
        estimates=tuple(of_machine(pool, fits)),
        weights=tuple(part.weight for part in pool.parts),
        rank=solution.rank,
        n_columns=len(meaning),
        condition=solution.condition,
        aliases=tuple(_aliases(pool)),
    )


def as_seen(part: Part, x: Floats, wide: Floats, hidden: NDArray[np.bool_]) -> Fit:
    """Return a common fit as one campaign sees it; ``x``, ``wide``, ``hidden``, shape (k,): of its own parameters, set-ups first."""
    obs, noise, n = part.obs, part.problem.noise, part.obs.n_setup
    left = residual_um(obs, part.columns, x)
    return Fit(
        terms=part.terms,
        estimates=estimates(part.terms, x[n:], wide[n:], hidden[n:], on_circles=obs.grid.in_plane),
        setups=setups(obs, x[:n], wide[:n]),
        residual_um=left,
        rms_before_um=obs.rms(localise.residual_um(obs, [])),
        rms_after_um=obs.rms(left),
        systematic_rms_um=localise.systematic_rms_um(obs, left),
        noise_floor_um=noise.floor_um if noise else float("nan"),
        noise_floor_dof=noise.dof if noise else 0,
        rank=int((~hidden).sum()),
        n_columns=len(x),
        condition=float("nan"),
        aliases=tuple(find_aliases(obs, part.terms)),
    )


def _estimates_in(fitted: Fit, term: Term) -> list[Estimate]:
    """Return the parameters of a term in a campaign."""
    where = term.instance.effect.name, term.instance.axis
    return [e for e in fitted.estimates if (e.effect, e.axis) == where]


def of_machine(pool: Pool, fits: Sequence[Fit]) -> list[Estimate]:
    """Return the parameters of the machine: shared ones once, from the campaigns that most agree on."""
    out: list[Estimate] = []
    for number, term in enumerate(pool.terms):
        name, axis = term.instance.effect.name, term.instance.axis
        seen = list(seen_estimates(pool, fits, number).items())
        if is_shared(term, pool.terms):
            agreed = [mine for c, mine in seen if not pool.groups.get((c, number), 0)] or [mine for _, mine in seen]
            out += [replace(e, effect=name, axis=axis) for e in agreed[0]]
        elif len(seen) == 1:
            out += seen[0][1]
        elif is_wave(term):
            out.append(replace(amplitude([mine for _, mine in seen]), effect=name, axis=axis))
        else:
            out += [
                replace(e, effect=name, axis=axis, name=f"{e.name}, {pool.parts[c].obs.campaign.name}")
                for c, mine in seen
                for e in mine
            ]
    return out


def seen_estimates(pool: Pool, fits: Sequence[Fit], number: int) -> dict[int, list[Estimate]]:
    """Return the parameters of a term of the machine in each campaign that sees it, by number of campaign."""
    return {
        c: _estimates_in(fitted, part.terms[part.number_of.index(number)])
        for c, (part, fitted) in enumerate(zip(pool.parts, fits, strict=True))
        if number in part.number_of
    }


def amplitude(seen: Sequence[Sequence[Estimate]]) -> Estimate:
    """Return the amplitude of the first order of a wave, each campaign by its own uncertainty."""
    values, widths = zip(*(_length(mine) for mine in seen), strict=True)
    weights = np.array([max(w, 1e-12) ** -2.0 if np.isfinite(w) else 0.0 for w in widths])
    known = bool(weights.sum() > 0.0)
    value = float(weights @ values / weights.sum()) if known else float(np.mean(values))
    wide = float(weights.sum() ** -0.5) if known else float("nan")
    first = seen[0][0]
    told = all(e.identifiable for mine in seen for e in mine[:2])
    return Estimate(first.effect, first.axis, "amplitude", first.unit, value, wide, told)


def _length(mine: Sequence[Estimate]) -> tuple[float, float]:
    cosine, sine = mine[:2]
    length = float(np.hypot(cosine.value, sine.value))
    wide = np.hypot(cosine.value * cosine.uncertainty, sine.value * sine.uncertainty)
    return length, float(wide) / max(length, 1e-12)


def _aliases(pool: Pool) -> list[Alias]:
    """Return the pairs of shared effects that all campaigns together cannot tell apart."""
    maps, meaning = pool.maps()
    gram = np.asarray(sum(m.T @ p.gram @ m for p, m in zip(pool.parts, maps, strict=True)))
    known = np.array([t < 0 for t, _, _ in meaning])
    inner = np.linalg.pinv(gram[np.ix_(known, known)], rcond=1e-10, hermitian=True)
    left = gram - gram[:, known] @ inner @ gram[known]
    roots = {}
    for number in range(len(pool.terms)):
        own = np.array([t == number for t, _, _ in meaning])
        values, vectors = np.linalg.eigh(left[np.ix_(own, own)])
        keep = values > _HIDDEN * max(float(np.diag(gram)[own].max()), 1e-300)
        roots[number] = own, vectors[:, keep] / np.sqrt(values[keep])
    aliases = []
    for i, first in enumerate(pool.terms):
        for j in range(i + 1, len(pool.terms)):
            (mine, half), (other, other_half) = roots[i], roots[j]
            if half.size and other_half.size:
                across = half.T @ left[np.ix_(mine, other)] @ other_half
                largest = min(1.0, float(np.linalg.svd(across, compute_uv=False)[0]))
                if largest > _ALIAS:
                    aliases.append(Alias(first.label, pool.terms[j].label, largest, first.instance.effect.separate_by))
    return aliases
