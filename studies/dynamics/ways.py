"""Ways to part the static from the dynamic error of a turn: filters, slow runs, a fitted twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.physics.fit import fit
from dtwin.physics.gridding import bin_angle_rad
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations
from dtwin.physics.twin import chosen_terms
from dtwin.schema import Floats
from studies.dynamics.filters import MODELS, Filter, LowPass, RandomWalkFilter, Smoother, UnscentedFilter
from studies.dynamics.swarm import SwarmSettings
from studies.dynamics.tuning import sensitivity
from studies.dynamics.turns import MOST_READINGS, Turn

_FILTERS = ("twin", "reference", "low-pass", "rts", "kalman", "ukf", "ukf-circle")
"""Ways to part static from dynamic: what a fitted twin says, the slow runs themselves, filters."""
TWIN_EFFECTS = ("scale_mismatch", "squareness", "straightness", "servo_mismatch", "backlash", "reversal_spike")


@dataclass(frozen=True)
class DynamicsRequest:
    """What to compute.

    ``how``: one of ``_FILTERS``.
    ``reference_feed_mm_min``: feed of the slow reference; the slowest of the campaign without.
    ``readings``: readings per revolution after resampling by angle.
    ``q_um2``, ``r_um2``: variances of the Kalman filters; the published ones without.
    ``alpha``: of the unscented filters.
    ``tuned``, ``fitness``: what the swarm varies (``ratio``, ``alpha``, empty for nothing), and how it judges.
    """

    how: str = "twin"
    reference_feed_mm_min: float | None = None
    readings: int = MOST_READINGS
    q_um2: float | None = None
    r_um2: float | None = None
    cutoff_upr: float = 15.0
    alpha: float = 0.1
    tuned: str = ""
    fitness: str = "weighted_sum"
    swarm: SwarmSettings = field(default_factory=SwarmSettings)
    effects: tuple[str, ...] = TWIN_EFFECTS


def filter_of(request: DynamicsRequest, radius_mm: float) -> Filter | None:
    """Return the filter that is asked for, None for the twin and for the slow reference."""
    given = {"q_um2": request.q_um2, "r_um2": request.r_um2}
    variances = {k: v for k, v in given.items() if v is not None}
    if request.how in ("twin", "reference"):
        return None
    if request.how == "low-pass":
        return LowPass(request.cutoff_upr)
    if request.how == "rts":
        return Smoother(**variances)
    if request.how == "kalman":
        return RandomWalkFilter(**variances)
    if request.how in ("ukf", "ukf-circle"):
        model = "circle" if request.how == "ukf-circle" else "random-walk"
        return UnscentedFilter(model, request.alpha, radius_mm=radius_mm, **variances)
    raise InputError("no such filter", code="dynamics.filter", got=request.how[:40], allowed=", ".join(_FILTERS))


def radial_error_um(turn: Turn, radius_mm: float) -> Floats:
    """Return the radial error about the least-squares circle, shape (n,)."""
    circle = fit_circle(turn.angle_deg, turn.deviation_um, radius_mm)
    return residual_um(turn.angle_deg, turn.deviation_um, radius_mm, circle)


def twin_static_um(obs: Observations, effects: Sequence[str]) -> Floats:
    """Return what a fitted twin with its set-ups says of every row, shape (rows, 360)."""
    fitted = fit(obs, chosen_terms(list(effects), Library(), obs))
    return np.asarray(obs.y_um - fitted.residual_um)


def on_turn(static_um: Floats, turn: Turn) -> Floats:
    """Return a row of :func:`twin_static_um` at the angles of a turn, shape (n,)."""
    bins = np.degrees(bin_angle_rad())
    return np.interp(turn.angle_deg, bins, static_um, period=360.0)


def alpha_sensitivity(turn: Turn, chosen: Filter | None) -> dict[str, list[float]] | None:
    """Return the circular deviation that an unscented filter leaves for alphas from 1e-5 to 1.

    ``chosen``: anything but an unscented filter gives None.
    Returns ``alpha``, and um under the name of each model.
    """
    if not isinstance(chosen, UnscentedFilter):
        return None
    alphas = np.geomspace(1e-5, 1.0, 21)
    out = {"alpha": alphas.tolist()}
    for model in MODELS:
        tried = [replace(chosen, model=model, alpha=float(a)) for a in alphas]
        out[model] = sensitivity(turn.deviation_um, tried)
    return out
