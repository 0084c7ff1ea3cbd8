"""Settings of a filter, found by comparing what it leaves of a fast turn with a slow one."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.train.registry import Registry
from dtwin.train.results import environment
from studies.dynamics.distances import distances_um
from studies.dynamics.figures import FITNESSES, eq15, relative_difference, weighted_sum
from studies.dynamics.filters import Filter, UnscentedFilter
from studies.dynamics.swarm import SwarmSettings, minimise

_TUNED = ("ratio", "alpha")
_ALPHA = (1e-5, 1.0)
# Q over R: from a filter that forgets nothing to one that believes every reading.
_LOG10_RATIO = (-6.0, 2.0)


@dataclass(frozen=True)
class Judged:
    """How near a filtered turn comes to the slow reference.

    ``dtw_um``, ``frechet_um``: distances of the radial errors.
    ``difference``: relative difference of the circular deviations.
    """

    dtw_um: float
    frechet_um: float
    difference: float
    fitness: float


@dataclass(frozen=True)
class Tuning:
    """A tuned filter.

    ``tuned``, ``fitness``: what was varied, and by which fitness it was judged.
    ``judged``: at the place that was found.
    ``unfiltered``: what no filter at all would be given.
    ``history``: best fitness after each iteration.
    ``inert``: whether the fitness is the same wherever the swarm began: nothing was found.
    """

    chosen: UnscentedFilter
    tuned: str
    fitness: str
    judged: Judged
    unfiltered: Judged
    history: tuple[float, ...]
    evaluations: int
    seconds: float
    inert: bool

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return asdict(self) | {"filter": self.chosen.name}


def _centred_um(deviation_um: Floats) -> Floats:
    """Return a closed turn without mean and centre offset, to first order of the offset.

    ``deviation_um``, (n,): readings at equal steps of the angle.
    """
    waves = np.fft.rfft(deviation_um)
    waves[:2] = 0.0
    return np.fft.irfft(waves, len(deviation_um))


def judge(static_um: Floats, reference_um: Floats, fitness: str) -> Judged:
    """Compare a filtered turn with the slow reference.

    ``static_um``, ``reference_um``, (n,): turns at the same angles.
    ``fitness``: one of ``FITNESSES``.
    """
    first, second = _centred_um(static_um), _centred_um(reference_um)
    dtw, frechet = distances_um(first, second)
    difference = relative_difference(float(np.ptp(first)), float(np.ptp(second)))
    if fitness == "eq15":
        return Judged(dtw, frechet, difference, eq15(dtw, frechet, difference))
    return Judged(dtw, frechet, difference, weighted_sum(dtw, frechet, difference, len(first)))


def tune(
    turn_um: Floats,
    reference_um: Floats,
    start: UnscentedFilter,
    *,
    tuned: str = "ratio",
    fitness: str = "weighted_sum",
    settings: SwarmSettings | None = None,
) -> Tuning:
    """Find the settings by which a filter makes a fast turn most like the slow reference.

    ``turn_um``, ``reference_um`` (n,): a fast and a slow turn at the same angles, in the order of travel.
    ``tuned``, one of "ratio", "alpha": ``ratio``: process over measurement noise, which sets how much is smoothed.
    ``alpha``: the scaling of the sigma points, as published.
    ``settings``: by default the published 50 particles and 150 iterations.
    Raises ``InputError`` when there is no such choice.
    """
    for got, allowed, what in ((tuned, _TUNED, "tuned"), (fitness, FITNESSES, "fitness")):
        if got not in allowed:
            raise InputError("no such choice", code=f"dynamics.{what}", got=got[:40], allowed=", ".join(allowed))
    bounds = _ALPHA if tuned == "alpha" else _LOG10_RATIO

    def set_as(place: Floats) -> UnscentedFilter:
        if tuned == "alpha":
            return replace(start, alpha=float(place[0]))
        return replace(start, q_um2=start.r_um2 * 10.0 ** float(place[0]))

    def value(place: Floats) -> float:
        return judge(set_as(place).static_um(turn_um), reference_um, fitness).fitness

    begun = time.perf_counter()
    best = minimise(value, [bounds], settings or SwarmSettings())
    chosen = set_as(best.place)
    ends = [value(np.array([end])) for end in bounds]
    return Tuning(
        chosen=chosen,
        tuned=tuned,
        fitness=fitness,
        judged=judge(chosen.static_um(turn_um), reference_um, fitness),
        unfiltered=judge(turn_um, reference_um, fitness),
        history=best.history,
        evaluations=best.evaluations,
        seconds=time.perf_counter() - begun,
        inert=max(abs(end - best.value) for end in ends) <= 1e-6 * abs(best.value),
    )


def sensitivity(turn_um: Floats, filters: Sequence[Filter]) -> list[float]:
    """Return the circular deviation that each filter leaves of a turn, um.

    ``turn_um``, (n,): readings at equal steps of the angle.
    ``filters``: for example one filter with many alphas.
    """
    return [float(np.ptp(_centred_um(chosen.static_um(turn_um)))) for chosen in filters]


def log_tuning(registry: Registry, tuning: Tuning, settings: SwarmSettings, source: str) -> str:
    """Log a tuning as an MLflow run and return its id. ``source``: campaign or table that the turns come from."""
    tags = {"dtwin.campaign": source, "dtwin.kind": "filter tuning"}
    name = f"filter tuning {source}"
    params = {
        "filter": tuning.chosen.name,
        "tuned": tuning.tuned,
        "fitness": tuning.fitness,
        **asdict(settings),
        **{f"version.{k}": v for k, v in environment().items()},
    }
    metrics = {**asdict(tuning.judged), "evaluations": float(tuning.evaluations)}
    metrics |= {"alpha": tuning.chosen.alpha, "q_um2": tuning.chosen.q_um2}
    with registry.open_run(name, tags) as run_id:
        registry.log(run_id, params, metrics | {"seconds": tuning.seconds}, {})
        registry.log_files(run_id, {"tuning.json": json.dumps(tuning.as_dict(), indent=1)})
    return run_id
