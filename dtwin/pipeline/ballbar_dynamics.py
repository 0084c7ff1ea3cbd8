"""The dynamic part of every run of a circular campaign, against its slow reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.features.dynamics.figures import (
    ACCEPTED_DIFFERENCE,
    DynamicComponents,
    dynamic_components,
    relative_difference,
)
from dtwin.features.dynamics.filters import (
    MODELS,
    Filter,
    LowPass,
    RandomWalkFilter,
    Smoother,
    UnscentedFilter,
    response,
)
from dtwin.features.dynamics.turns import MOST_READINGS, Turn, one_turn
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.physics.fit import fit
from dtwin.physics.gridding import bin_angle_rad
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms
from dtwin.pipeline.measuring import ingest
from dtwin.schema import Campaign, Finding, Floats, Run, SignalGroup
from dtwin.store import Lake
from dtwin.train.filter_tuning import Tuning, log_tuning, sensitivity, tune
from dtwin.train.particle_swarm import SwarmSettings
from dtwin.train.registry import Registry

FILTERS = ("twin", "low-pass", "rts", "kalman", "ukf", "ukf-circle")
"""Ways to part static from dynamic; the twin first, because it eats no real feature it knows."""
TWIN_EFFECTS = (
    "scale_mismatch", "squareness", "straightness", "servo_mismatch", "backlash", "reversal_spike",
)  # fmt: skip
_MOST_TAKEN = 0.01


@dataclass(frozen=True)
class DynamicsRequest:
    """What to compute.

    Attributes
    ----------
    how : str
        One of ``FILTERS``.
    reference_feed_mm_min : float, optional
        Feed of the slow reference; the slowest of the campaign without.
    readings : int
        Readings per revolution after resampling by angle.
    q_um2, r_um2 : float, optional
        Variances of the Kalman filters; the published ones without.
    cutoff_upr : float
        Of the low-pass.
    alpha : float
        Of the unscented filters.
    tuned, fitness : str
        What the swarm varies (``ratio``, ``alpha``, empty for nothing), and how it judges.
    swarm : SwarmSettings
        Size and seed of the swarm.
    effects : tuple of str
        Of the twin.
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


@dataclass(frozen=True)
class Split:
    """A campaign with its dynamic parts.

    Attributes
    ----------
    result : dict
        JSON-ready: ``rows``, ``filter``, ``bias``, ``findings`` and what they belong to.
    curves : dict of str to tuple of ndarray
        By direction, fastest run: angle in degrees, radial error before and after, um.
    tuning : Tuning or None
        What the swarm found.
    """

    result: dict[str, Any]
    curves: Mapping[str, tuple[Floats, Floats, Floats]]
    tuning: Tuning | None = None


@dataclass(frozen=True)
class _Turned:
    """One run on its grid."""

    run: Run
    turn: Turn
    measured: int
    key: tuple[Any, ...]


def filter_of(request: DynamicsRequest, radius_mm: float) -> Filter | None:
    """Return the filter that is asked for, None for the twin.

    Parameters
    ----------
    request : DynamicsRequest
        What is wanted.
    radius_mm : float
        Nominal radius.

    Raises
    ------
    InputError
        When there is no such filter.
    """
    given = {"q_um2": request.q_um2, "r_um2": request.r_um2}
    variances = {k: v for k, v in given.items() if v is not None}
    if request.how == "twin":
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
    raise InputError(
        "no such filter", code="dynamics.filter", got=request.how[:40], allowed=", ".join(FILTERS)
    )


def split_campaign(home: Home, campaign: str, request: DynamicsRequest) -> Split:
    """Part static from dynamic in every usable run of a campaign.

    Parameters
    ----------
    home : Home
        Lake and registry.
    campaign : str
        Name in the lake, or a folder, which is ingested first.
    request : DynamicsRequest
        What to compute.

    Raises
    ------
    InputError
        When the campaign is not circular, has no reference, or something cannot be chosen.
    """
    filter_of(request, 1.0)
    lake = Lake(home.lake)
    if campaign not in lake.campaigns() and Path(campaign).exists():
        campaign = ingest(Path(campaign), home).campaign
    known = lake.campaign(campaign)
    if known.kind != "circular":
        raise InputError(
            "dynamic parts are those of circular tests", code="dynamics.kind", where=campaign,
            got=known.kind, allowed="circular",
        )  # fmt: skip
    runs = list(lake.iterate(campaign))
    usable = [run for run in runs if not any(f.severity == "error" for f in run.findings)]
    if not usable:
        raise InputError(
            "the campaign has no usable run", code="dynamics.no_runs", where=campaign,
            got=f"{len(runs)} runs, all with errors", hint=f"dtwin check {campaign}",
        )  # fmt: skip
    found = split_runs(known, usable, request)
    if found.tuning is not None:
        run_id = log_tuning(Registry(home), found.tuning, request.swarm, campaign)
        found.result["tuning"]["mlflow_run"] = run_id
    found.result["left_out"] = sorted(
        {r.meta.run_id for r in runs} - {r.meta.run_id for r in usable}
    )
    return found


def split_runs(campaign: Campaign, runs: Sequence[Run], request: DynamicsRequest) -> Split:
    """Part static from dynamic in runs; see :func:`split_campaign`."""
    turned = [_turned(run, request.readings) for run in runs]
    feed = _reference_feed(turned, request)
    references = _references(turned, feed)
    radius = float(turned[0].run.meta.radius_mm or 0.0)
    chosen, tuning = filter_of(request, radius), None
    if request.tuned:
        chosen, tuning = _tuned(turned, references, chosen, request)
    statics = (
        _twin_static(campaign, turned, request)
        if chosen is None
        else [chosen.static_um(t.turn.deviation_um) for t in turned]
    )
    rows, curves = [], {}
    order = sorted(range(len(turned)), key=lambda i: _sorting(turned[i].run))
    for i in order:
        one = turned[i]
        before, after = (
            radial_error_um(one.turn, radius),
            radial_error_um(Turn(one.turn.angle_deg, statics[i]), radius),
        )
        reference = references[one.key]
        rows.append(_row(one, dynamic_components(before, after), reference, radius))
        curves[str(one.run.meta.direction)] = (one.turn.angle_deg, before, after)
    bias = _bias(rows, feed)
    for row in rows:
        row["vibration_um"] = max(0.0, row["dc2_um"] - bias["dc2_um"])
    result: dict[str, Any] = {
        "campaign": campaign.name,
        "radius_mm": radius,
        "filter": chosen.name if chosen else "twin: " + ", ".join(request.effects),
        "reference_feed_mm_min": feed,
        "readings": turned[0].turn.readings,
        "two_lobes": None if chosen is None else vars(response(chosen, turned[0].turn.readings)),
        "bias": bias,
        "rows": rows,
        "tuning": None if tuning is None else tuning.as_dict(),
        "alpha": alpha_sensitivity(turned[order[-1]].turn, chosen),
    }
    result["findings"] = [f.as_dict() for f in findings_of(result, turned[0].measured)]
    return Split(result, curves, tuning)


def radial_error_um(turn: Turn, radius_mm: float) -> Floats:
    """Return the radial error about the least-squares circle, shape (n,).

    Parameters
    ----------
    turn : Turn
        One revolution.
    radius_mm : float
        Nominal radius.
    """
    circle = fit_circle(turn.angle_deg, turn.deviation_um, radius_mm)
    return residual_um(turn.angle_deg, turn.deviation_um, radius_mm, circle)


def twin_static_um(
    obs: Observations, effects: Sequence[str], library: Library | None = None
) -> Floats:
    """Return what a fitted twin with its set-ups says of every row, shape (rows, 360).

    Parameters
    ----------
    obs : Observations
        Runs.
    effects : sequence of str
        Names.
    library : Library, optional
        Effects; the built-in ones without.
    """
    found = fit(obs, chosen_terms(list(effects), library or Library(), obs))
    return np.asarray(obs.y_um - found.residual_um)


def on_turn(static_um: Floats, turn: Turn) -> Floats:
    """Return a row of :func:`twin_static_um` at the angles of a turn, shape (n,)."""
    bins = np.degrees(bin_angle_rad())
    return np.interp(turn.angle_deg, bins, static_um, period=360.0)


def alpha_sensitivity(turn: Turn, chosen: Filter | None) -> dict[str, list[float]] | None:
    """Return the circular deviation that an unscented filter leaves for alphas from 1e-5 to 1.

    Parameters
    ----------
    turn : Turn
        One revolution.
    chosen : Filter or None
        Anything but an unscented filter gives None.

    Returns
    -------
    dict of str to list of float
        ``alpha``, and um under the name of each model.
    """
    if not isinstance(chosen, UnscentedFilter):
        return None
    alphas = np.geomspace(1e-5, 1.0, 21)
    out = {"alpha": alphas.tolist()}
    for model in MODELS:
        tried = [replace(chosen, model=model, alpha=float(a)) for a in alphas]
        out[model] = sensitivity(turn.deviation_um, tried)
    return out


def findings_of(result: Mapping[str, Any], measured: int) -> list[Finding]:
    """Return what a reader must know before believing the figures.

    Parameters
    ----------
    result : mapping
        As :class:`Split` holds it.
    measured : int
        Fewest readings per revolution of a run, before resampling.
    """
    rows = result["rows"]
    found: list[Finding] = []

    def say(code: str, message: str, **numbers: float) -> None:
        found.append(Finding(f"dynamics.{code}", "warning", message, numbers))

    lobes = result["two_lobes"]
    if lobes and lobes["taken"] > _MOST_TAKEN:
        say(
            "eats_features",
            f"the filter takes {100 * lobes['taken']:.0f} % of a real two-lobe error for dynamics "
            f"(leaves {100 * lobes['gain']:.0f} %, {lobes['lag_deg']:.1f} deg late): raise Q or the "
            "cutoff, or use the twin",
            taken=lobes["taken"],
        )
    if len({row["direction"] for row in rows}) < 2:
        say(
            "one_direction",
            "one direction only: servo mismatch and squareness, lateral play and backlash look the "
            "same, and a lag of the filter looks like an error of the machine",
        )
    if measured < MOST_READINGS:
        say(
            "few_readings",
            f"{measured} readings per revolution; {MOST_READINGS} or more are needed to tell "
            "vibration from a real short feature",
            readings=float(measured),
        )
    shaken = [r for r in rows if r["vibration_um"] > r["after_um"]]
    if shaken:
        say(
            "vibration_exceeds",
            f"in {len(shaken)} of {len(rows)} runs vibration exceeds the circular deviation that is "
            "left: their static figures are not reliable",
            runs=float(len(shaken)),
        )
    apart = [r for r in rows if r["difference"] > ACCEPTED_DIFFERENCE]
    if apart:
        worst = max(apart, key=lambda r: r["difference"])
        say(
            "differs_from_reference",
            f"in {len(apart)} of {len(rows)} runs the circular deviation differs from the slow "
            f"reference by more than {100 * ACCEPTED_DIFFERENCE:.0f} %, most in {worst['run']} "
            f"({100 * worst['difference']:.0f} %): what changes with the feed was not all taken out",
            worst=worst["difference"],
        )
    grown = [r for r in rows if r["dc1_um"] < 0.0]
    if grown:
        say(
            "deviation_grew",
            f"in {len(grown)} of {len(rows)} runs the circular deviation is larger after than before",
            runs=float(len(grown)),
        )
    return found


def _turned(run: Run, readings: int) -> _Turned:
    meta = run.meta
    part = slice(*run.window) if run.window is not None else slice(None)
    angle, deviation = run.samples["angle_deg"][part], run.samples["deviation_um"][part]
    try:
        turn = one_turn(angle, deviation, readings)
    except InputError as error:
        raise InputError(
            error.message, code=error.code, where=meta.run_id, got=error.got,
            allowed=error.allowed, hint=error.hint,
        ) from error  # fmt: skip
    steps = np.abs(np.diff(angle))
    key = (meta.plane, meta.radius_mm, meta.direction, meta.setup)
    return _Turned(run, turn, round(360.0 / float(np.median(steps))), key)


def _sorting(run: Run) -> tuple[float, str, int]:
    return float(run.meta.feed_mm_min or 0.0), str(run.meta.direction), run.meta.repeat


def _reference_feed(turned: Sequence[_Turned], request: DynamicsRequest) -> float:
    feeds = sorted({float(t.run.meta.feed_mm_min or 0.0) for t in turned})
    wanted = request.reference_feed_mm_min
    if wanted is not None and wanted not in feeds:
        raise InputError(
            "no run has the feed of the reference", code="dynamics.reference_feed",
            got=f"{wanted:g} mm/min", allowed=", ".join(f"{f:g}" for f in feeds),
        )  # fmt: skip
    radii = {t.run.meta.radius_mm for t in turned}
    if len(radii) > 1:
        raise InputError(
            "runs of several radii do not share a reference", code="dynamics.radii",
            got=", ".join(f"{r:g}" for r in sorted(r or 0.0 for r in radii)),
            hint="one campaign for each radius",
        )  # fmt: skip
    return feeds[0] if wanted is None else wanted


def _references(turned: Sequence[_Turned], feed: float) -> dict[tuple[Any, ...], Turn]:
    """Mean of the slow repeats of each plane, direction and set-up."""
    out: dict[tuple[Any, ...], Turn] = {}
    for key in dict.fromkeys(t.key for t in turned):
        slow = [t.turn for t in turned if t.key == key and t.run.meta.feed_mm_min == feed]
        if not slow:
            raise InputError(
                "a direction or set-up has no slow reference", code="dynamics.reference",
                where=" ".join(str(part) for part in key), allowed=f"a run at {feed:g} mm/min",
            )  # fmt: skip
        angle = slow[0].angle_deg
        same = [np.interp(angle, t.angle_deg, t.deviation_um, period=360.0) for t in slow]
        out[key] = Turn(angle, np.mean(same, axis=0))
    return out


def _tuned(
    turned: Sequence[_Turned],
    references: Mapping[tuple[Any, ...], Turn],
    start: Filter | None,
    request: DynamicsRequest,
) -> tuple[Filter, Tuning]:
    if not isinstance(start, UnscentedFilter):
        raise InputError(
            "only the unscented filters are tuned", code="dynamics.tune", got=request.how,
            allowed="ukf, ukf-circle",
        )  # fmt: skip
    fast = max(turned, key=lambda t: _sorting(t.run))
    slow = references[fast.key]
    again = np.interp(fast.turn.angle_deg, slow.angle_deg, slow.deviation_um, period=360.0)
    found = tune(
        fast.turn.deviation_um, again, start, tuned=request.tuned, fitness=request.fitness,
        settings=request.swarm,
    )  # fmt: skip
    return found.chosen, found


def _twin_static(
    campaign: Campaign, turned: Sequence[_Turned], request: DynamicsRequest
) -> list[Floats]:
    obs = observe(campaign, [t.run for t in turned])
    static = twin_static_um(obs, request.effects)
    first = {int(run): row for row, run in reversed(list(enumerate(obs.run_of)))}
    return [on_turn(static[first[i]], t.turn) for i, t in enumerate(turned)]


def _bias(rows: Sequence[Mapping[str, Any]], feed: float) -> dict[str, float]:
    """What the same way takes out of the slow runs, where there is next to no vibration."""
    slow = [row for row in rows if row["feed_mm_min"] == feed]
    return {n: float(np.mean([r[n] for r in slow])) for n in ("dc1_um", "dc2_um", "dc3_um")}


def _row(
    one: _Turned, parts: DynamicComponents, reference: Turn, radius_mm: float
) -> dict[str, Any]:
    meta = one.run.meta
    slow_um = float(np.ptp(radial_error_um(reference, radius_mm)))
    return {
        "run": meta.run_id,
        "feed_mm_min": meta.feed_mm_min,
        "direction": meta.direction,
        "repeat": meta.repeat,
        **parts.as_dict(),
        "difference": relative_difference(parts.after_um, slow_um),
        "accelerometer_rms_g": _shaking_g(one.run.signals),
    }


def _shaking_g(groups: Sequence[SignalGroup]) -> dict[str, float]:
    """RMS of every accelerometer channel without its mean."""
    return {
        name: float(np.std(values))
        for group in groups
        for name, values in group.columns.items()
        if name.endswith("_g")
    }
