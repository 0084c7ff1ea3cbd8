"""How sure the figures of an error budget are, beside the RMS of each cause, which has its own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.physics import localise
from dtwin.physics.budget import Budget, budget
from dtwin.physics.machine_terms import own_term
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin
from dtwin.schema import Floats


@dataclass(frozen=True)
class BudgetSpread:
    """Expanded uncertainties of RMS values, k = 2, um; NaN without repeats.

    ``parts``: of what each cause makes, by its label, then by plane or axis: of its parameters, taken as uncorrelated.
    ``left``: of what is left without it: of its parameters, and of what repeats differ by; ``left_of_all``: without all causes.
    ``error``: of the error as measured: of what repeats differ by.
    """

    parts: Mapping[str, Mapping[str, float]]
    left: Mapping[str, float]
    error: float
    left_of_all: float


def spread_budget(twin: Twin, obs: Observations, terms: Sequence[Term] = ()) -> tuple[Budget, BudgetSpread]:
    """Return how much each effect of a twin makes of the error of a campaign, and how sure that is.

    ``obs``: runs, not necessarily those of the fit; the unit of replication is the run.
    ``terms``: of the twin of several campaigns that it is a part of, which name the causes.
    """
    parts: dict[str, dict[str, float]] = {}
    left: dict[str, float] = {}
    every, every_moved = np.zeros(obs.y_um.shape), list[Floats]()
    planes = np.array([obs.conditions[c].plane for c in obs.condition_of])
    for term in twin.terms:
        label = own_term(term, terms).label
        columns = obs.regressors(term.instance, term.shape)
        does = columns @ twin.values(term)
        every += does
        kept, rest = _without_setup(obs, does), _without_setup(obs, obs.y_um - does)
        widths = [e.uncertainty_at_shape for e in twin.estimates_of(term)]
        moved = [_without_setup(obs, columns[:, :, k] * width) for k, width in enumerate(widths)]
        rows = {p: planes == p for p in obs.planes}
        parts[label] = {p: _moves_um(obs, kept, moved, mine) for p, mine in rows.items()}
        whole = np.ones(len(planes), bool)
        sizes = [_moves_um(obs, rest, moved, whole), _beside_um(obs, rest, moved), _repeats_um(obs, rest)]
        left[label] = float(np.hypot.reduce(sizes))
        every_moved += moved
    error_budget = budget(twin, obs, terms)
    error, rest = (_without_setup(obs, y) for y in (obs.y_um, obs.y_um - every))
    sure = float(np.hypot(_beside_um(obs, rest, every_moved), _repeats_um(obs, rest)))
    return error_budget, BudgetSpread(parts, left, _repeats_um(obs, error), sure)


def spread_as_dict(error_budget: Budget, spread: BudgetSpread) -> dict[str, Any]:
    """Return both, JSON-ready; what is not known is None."""
    known = {name: None if np.isnan(value) else value for name, value in spread.left.items()}
    made = error_budget.as_dict()
    for share in made["shares"]:
        mine = spread.parts[share["label"]]
        share["k2_um"] = {p: None if np.isnan(v) else v for p, v in mine.items()} | {"left": known[share["label"]]}
    whole = {"error": spread.error, "left": spread.left_of_all}
    return made | {"k2_um": {name: None if np.isnan(value) else value for name, value in whole.items()}}


def _without_setup(obs: Observations, values_um: Floats) -> Floats:
    return localise.residual_um(obs.with_y(values_um), [])


def _moves_um(obs: Observations, values_um: Floats, moved_um: list[Floats], rows: Any) -> float:
    """Return by how much the RMS of some rows changes with the uncertainty of each parameter, together."""
    mask = obs.mask & rows[:, None]
    total = float(np.sqrt((values_um[mask] ** 2).mean())) * mask.sum() if mask.any() else 0.0
    if total <= 0.0:
        return float("nan")
    return float(np.hypot.reduce([0.0, *((one * values_um)[mask].sum() / total for one in moved_um)]))


def _beside_um(obs: Observations, left_um: Floats, moved_um: list[Floats]) -> float:
    """Return by how much more is left where what is taken away is off by the uncertainty of each parameter.

    A fit leaves nothing that its causes make, so that what is left moves with them in second order only.
    """
    rms = obs.rms(left_um)
    return float(np.hypot.reduce([rms, *map(obs.rms, moved_um)])) - rms


def _repeats_um(obs: Observations, values_um: Floats) -> float:
    """Return by how much the RMS may be off as runs of one condition differ in their mean square."""
    squares: dict[tuple[int, int], list[float]] = defaultdict(list)
    for row, (condition, run) in enumerate(zip(obs.condition_of, obs.run_of, strict=True)):
        squares[int(condition), int(run)].append(float((values_um[row][obs.mask[row]] ** 2).mean()))
    of_condition: dict[int, list[float]] = defaultdict(list)
    for (condition, _), some in squares.items():
        of_condition[condition].append(float(np.mean(some)))
    dof = sum(len(some) - 1 for some in of_condition.values())
    rms = obs.rms(values_um)
    if dof < 1 or rms <= 0.0:
        return float("nan")
    variance = sum(float(((np.array(some) - np.mean(some)) ** 2).sum()) for some in of_condition.values()) / dof
    return float(2.0 * np.sqrt(variance / len(squares)) / (2.0 * rms))
