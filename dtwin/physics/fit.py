"""One global least squares over a campaign: parameters, uncertainty, and what cannot be told."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.physics import localise
from dtwin.physics._condensed import Condensed, condensed
from dtwin.physics._plausible import implausible
from dtwin.physics._reference_lines import with_reference_lines
from dtwin.physics._shapes import is_too_long, refined
from dtwin.physics._solve import in_blocks, solve_blocks
from dtwin.physics._uncertainty import expanded
from dtwin.physics.candidates import Candidates, likely_pitches
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term, least_visible, set_up, setup_columns, unweighted, unweighted_with_noise
from dtwin.physics.whitening import from_harmonics
from dtwin.schema import Floats

_ALIAS = 0.95
_HIDDEN = 1e-6
_HUBER = 2.0
_ROBUST_ROUNDS = 5
# Of the sum of squares: one shape alone need not be better before all are refined together.
_ROUGHLY = 1e-3


@dataclass(frozen=True)
class Estimate:
    """A fitted parameter.

    Attributes:
        uncertainty: Expanded, k = 2 (95 %); unit of replication: the run, and the condition where laws miss more than the
            noise. It holds what the runs leave open of the shape of its effect. NaN without repeats.
        identifiable: False when these runs do not determine it (the value is then the smallest that fits), or when it or
            a shape of its effect is not plausible.
        at_shape: Uncertainty at the shape that was found: what an effect does in the runs of the fit is as sure, for what
            its shape leaves open of its size takes itself back there. None where it is the same.
    """

    effect: str
    axis: str
    name: str
    unit: str
    value: float
    uncertainty: float
    identifiable: bool
    at_shape: float | None = None

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> Estimate:
        """Return an estimate from what ``as_dict`` returned, perhaps with None for what is not finite."""
        known: dict[str, Any] = {name: math.nan if value is None else value for name, value in stored.items()}
        return cls(**known)

    @property
    def uncertainty_at_shape(self) -> float:
        """Expanded uncertainty at the shape that was found."""
        return self.uncertainty if self.at_shape is None else self.at_shape

    @property
    def is_unseen(self) -> bool:
        """Whether it does nothing in these runs, as a bend towards an axis that stood still."""
        return not self.identifiable and self.value == 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Alias:
    """Two effects that these runs cannot tell apart.

    Attributes:
        correlation: Largest correlation between what they would do, set-up taken out.
        separate_by: The run that would tell them apart.
    """

    first: str
    second: str
    correlation: float
    separate_by: str

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))

    def __str__(self) -> str:
        """Return it as a sentence."""
        return (
            f"{self.first} and {self.second} cannot be told apart by these runs "
            f"(correlation {self.correlation:z.3f}). {self.separate_by}"
        )


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes:
        terms: Effects, with the shape parameters that were found.
        estimates: Their parameters, in the order of the terms.
        setups: Centre and radius of every set-up.
        residual_um: What is left. Shape (rows, n).
        rms_before_um, rms_after_um: RMS with set-up terms only, and with the effects.
        systematic_rms_um: RMS of what repeats agree on; NaN without repeats.
        noise_floor_um: RMS of one run about the mean of its condition; NaN without repeats.
        noise_floor_dof: Degrees of freedom of the floor, each run counted once; 0 without repeats.
        rank, n_columns: Independent columns, of how many.
        condition: Condition number of the scaled columns.
        aliases: Pairs that cannot be told apart.
    """

    terms: tuple[Term, ...]
    estimates: tuple[Estimate, ...]
    setups: tuple[Mapping[str, Any], ...]
    residual_um: Floats
    rms_before_um: float
    rms_after_um: float
    systematic_rms_um: float
    noise_floor_um: float
    noise_floor_dof: int
    rank: int
    n_columns: int
    condition: float
    aliases: tuple[Alias, ...]


def fit(obs: Observations, terms: Sequence[Term], *, robust: bool = False, refine: bool = True) -> Fit:
    """Fit effects to a campaign.

    Args:
        terms: Effects; shape parameters are refined from where they are.
        robust: Give runs that are far off less weight (Huber, by run).
        refine: Search the shapes of effects from where they are; otherwise they stay.

    Returns:
        Fit

    Raises:
        InputError: When an effect has nothing to act on in this campaign.
    """
    terms = shaped(obs, terms) if refine else with_reference_lines(terms, [obs])
    _require_visible(obs, terms)
    # Unweighted: weights by the noise would let the edges of steps decide, where shapes are
    # never quite those of the library.
    problem = unweighted_with_noise(obs, terms)
    columns = _columns(problem, terms)
    weight = np.ones(obs.n_rows)
    solution = solve_blocks(_weighted(columns, problem.y, weight))
    for _ in range(_ROBUST_ROUNDS if robust else 0):
        weight = run_weights(problem, columns, solution.x)
        solution = solve_blocks(_weighted(columns, problem.y, weight))
    uncertain, at_shape = expanded(problem, terms, columns, solution.x)
    n_setup = obs.n_setup
    hidden = (solution.null_space**2).sum(axis=1) > _HIDDEN
    residual = residual_um(obs, columns, solution.x)
    before = localise.residual_um(obs, [])
    return Fit(
        terms=tuple(terms),
        estimates=estimates(
            terms,
            solution.x[n_setup:],
            uncertain[n_setup:],
            hidden[n_setup:],
            on_circles=obs.grid.in_plane,
            at_shape=at_shape[n_setup:],
        ),
        setups=setups(obs, solution.x[:n_setup], uncertain[:n_setup]),
        residual_um=residual,
        rms_before_um=obs.rms(before),
        rms_after_um=obs.rms(residual),
        systematic_rms_um=localise.systematic_rms_um(obs, residual),
        noise_floor_um=problem.noise.floor_um if problem.noise else float("nan"),
        noise_floor_dof=problem.noise.dof if problem.noise else 0,
        rank=solution.rank,
        n_columns=columns.shape[1],
        condition=solution.condition,
        aliases=tuple(find_aliases(obs, terms)),
    )


def find_aliases(obs: Observations, terms: Sequence[Term]) -> list[Alias]:
    """Return the pairs of effects that the runs of a campaign cannot tell apart.

    Args:
        obs: The runs; what was measured does not matter.
    """
    problem = unweighted(obs, [])
    seen = [
        problem.visible(problem.whitened(obs.regressors(t.instance, t.shape)), least=least_visible(t))[0] for t in terms
    ]
    aliases = []
    for i, first in enumerate(terms):
        for j in range(i + 1, len(terms)):
            if not seen[i].shape[1] or not seen[j].shape[1]:
                continue
            largest = float(np.linalg.svd(seen[i].T @ seen[j], compute_uv=False)[0])
            if largest > _ALIAS:
                advice = first.instance.effect.separate_by
                aliases.append(Alias(first.label, terms[j].label, largest, advice))
    return aliases


def _columns(problem: Problem, terms: Sequence[Term]) -> Floats:
    """Return set-up columns and effects, in their units, shape (rows * n, k)."""
    parts = [setup_columns(problem.obs)]
    parts += [problem.obs.regressors(t.instance, t.shape) for t in terms]
    return problem.whitened(np.concatenate(parts, axis=2))


def _weighted(columns: Floats, y: Floats, weight: Floats) -> Iterable[tuple[Floats, Floats]]:
    if (weight == 1.0).all():
        return in_blocks(columns, y)
    root = np.repeat(np.sqrt(weight), len(y) // len(weight))
    return in_blocks(columns * root[:, None], y * root)


def run_weights(problem: Problem, columns: Floats, x: Floats) -> Floats:
    """Return the weight of each row, less for runs that are far off, shape (rows,)."""
    left = (problem.y - columns @ x).reshape(problem.obs.n_rows, problem.obs.n_bins)
    size = np.sqrt((left**2).mean(axis=1))
    limit = _HUBER * float(np.median(size))
    return np.minimum(1.0, limit / np.maximum(size, 1e-300))


def estimates(
    terms: Sequence[Term],
    values: Floats,
    expanded: Floats,
    hidden: NDArray[np.bool_],
    *,
    on_circles: bool,
    at_shape: Floats | None = None,
) -> tuple[Estimate, ...]:
    """Return the parameters of terms; ``hidden``: those that the runs do not determine; ``on_circles``: as ``implausible``.

    ``expanded``, ``at_shape``: uncertainties, also where shapes are as they were found.
    """
    other = expanded if at_shape is None else at_shape
    out = []
    number = 0
    doubted = implausible(terms, values, on_circles=on_circles)
    for term in terms:
        for parameter in term.instance.effect.parameters:
            shown = bool(np.isfinite(expanded[number])) or not np.isfinite(expanded).any()
            shown = shown and term.label not in doubted
            out.append(
                Estimate(
                    effect=term.instance.effect.name,
                    axis=term.instance.axis,
                    name=parameter.name,
                    unit=parameter.unit,
                    value=float(values[number]),
                    uncertainty=float(expanded[number]),
                    identifiable=shown and not bool(hidden[number]),
                    at_shape=float(other[number]) if other[number] < expanded[number] else None,
                )
            )
            number += 1
    return tuple(out)


def setups(obs: Observations, values: Floats, expanded: Floats) -> tuple[Mapping[str, Any], ...]:
    """Return what was fitted of every set-up; ``expanded``: uncertainties, k = 2, in the order of the values."""
    names = obs.grid.setup_names
    k = len(names)
    return tuple(
        {
            "setup": name,
            **{n: float(values[k * i + j]) for j, n in enumerate(names)},
            "uncertainty_um": [float(u) for u in expanded[k * i : k * i + k]],
        }
        for i, name in enumerate(obs.setups)
    )


def residual_um(obs: Observations, columns: Floats, x: Floats) -> Floats:
    """Return what is left, shape (rows, n); ``columns``: whitened without weights, ``x``: what was fitted."""
    fitted = from_harmonics((columns @ x).reshape(obs.n_rows, obs.n_bins))
    return np.where(obs.mask, obs.y_um - fitted, 0.0)


def _require_visible(obs: Observations, terms: Sequence[Term]) -> None:
    for term in terms:
        if not obs.regressors(term.instance, term.shape).any():
            raise InputError(
                "an effect has nothing to act on in this campaign",
                code="fit.nothing_to_act_on",
                got=term.label,
                allowed=f"axes {', '.join(obs.axes)}, planes {', '.join(obs.planes)}",
            )


def shaped(obs: Observations, terms: Sequence[Term]) -> list[Term]:
    """Return the effects of a fit with refined shapes: variable projection, the linear part solved for each try.

    First one after the other, each without those whose shape is still a guess; once more with
    all the others in place; then all together.
    """
    terms = with_reference_lines(terms, [obs])
    refinable = [i for i, term in enumerate(terms) if term.instance.effect.refined_shapes(obs.several_speeds)]
    out = list(terms)
    if not refinable:
        return out
    candidates = Candidates(obs, [term.instance for term in terms])
    within = [term for term in terms if term.instance.effect.within_condition]
    campaign = condensed(set_up(obs, [], within), candidates)
    guessed = set(refinable)
    for index in refinable * min(2, len(refinable)):
        guessed.discard(index)
        beside = campaign.given(t for i, t in enumerate(out) if i != index and i not in guessed)
        enough = _ROUGHLY * float(beside.residual @ beside.residual)
        (out[index],) = refined(beside, [_start(beside, candidates, out[index])], enough)
    return list(refined(campaign, out))


def _start(campaign: Condensed, candidates: Candidates, term: Term) -> Term:
    """Return a term in the best of its shape, the grid, and the pitches that the residual shows, by Schwarz's criterion."""
    effect, obs = term.instance.effect, campaign.problem.obs
    residual = campaign.residual
    tries: list[Mapping[str, float]] = [term.shape or effect.start_shape]
    if not all(shape.grid for shape in effect.shapes):
        rows = campaign.expanded(residual[:, None]).reshape(obs.n_rows, obs.n_bins)
        tries += [effect.start_shape | {effect.shapes[0].name: p} for p in likely_pitches(obs, rows, term.instance)]
    else:
        tries += list(candidates.grid(term.instance))
    tries = [shape for shape in tries if not is_too_long(campaign, replace(term, shape=shape))]
    n, total = int(obs.mask.sum()), float(residual @ residual)
    costs = []
    for shape in tries:
        visible, _ = campaign.visible(replace(term, shape=shape))
        left = max(total - float(((visible.T @ residual) ** 2).sum()), 1e-12 * total, 1e-300)
        costs.append(n * np.log(left) + visible.shape[1] * np.log(n))
    return replace(term, shape=tries[int(np.argmin(costs))])
