"""The dynamic part of every run of a circular campaign, against its slow reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.observations import observe
from dtwin.schema import Campaign, Finding, Floats, Run, SignalGroup, of_one_way
from dtwin.train.registry import Registry
from studies.dynamics.figures import ACCEPTED_DIFFERENCE, DynamicComponents, dynamic_components, relative_difference
from studies.dynamics.filters import Filter, UnscentedFilter, response
from studies.dynamics.tuning import Tuning, log_tuning, tune
from studies.dynamics.turns import MOST_READINGS, Turn, one_turn
from studies.dynamics.ways import (
    DynamicsRequest,
    alpha_sensitivity,
    filter_of,
    on_turn,
    radial_error_um,
    twin_static_um,
)

_MOST_TAKEN, _MOST_BIAS = 0.01, 0.5


@dataclass(frozen=True)
class Split:
    """A campaign with its dynamic parts.

    ``result``: JSON-ready: ``rows``, ``filter``, ``bias``, ``findings`` and what they belong to.
    ``curves``: by direction, fastest run: angle in degrees, radial error before and after, um.
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


def split_campaign(home: Home, campaign: str, request: DynamicsRequest) -> Split:
    """Part static from dynamic in every usable run of a campaign.

    ``campaign``: name in the lake, or a folder, which is ingested first.
    Raises ``InputError`` when the campaign is not circular, has no reference, or something cannot be chosen.
    """
    filter_of(request, 1.0)
    lake = Lake(home.lake)
    campaign = in_lake(home, campaign)
    known = lake.campaign(campaign).of_kind("circular")
    runs = of_one_way(list(lake.iterate(campaign)))
    usable = [run for run in runs if not any(f.severity == "error" for f in run.findings)]
    if not usable:
        raise InputError(
            "the campaign has no usable run",
            code="dynamics.no_runs",
            where=campaign,
            got=f"{len(runs)} runs, all with errors",
            hint=f"dtwin check {campaign}",
        )
    split = split_runs(known, usable, request)
    if split.tuning is not None:
        run_id = log_tuning(Registry(home), split.tuning, request.swarm, campaign)
        split.result["tuning"]["mlflow_run"] = run_id
    split.result["left_out"] = sorted({r.meta.run_id for r in runs} - {r.meta.run_id for r in usable})
    return split


def split_runs(campaign: Campaign, runs: Sequence[Run], request: DynamicsRequest) -> Split:
    """Part static from dynamic in runs; see :func:`split_campaign`."""
    turned = [_turned(run, request.readings) for run in runs]
    _require_different(turned)
    feed = _reference_feed(turned, request)
    references = _references(turned, feed)
    radius = float(turned[0].run.meta.radius_mm or 0.0)
    chosen, tuning = filter_of(request, radius), None
    if request.tuned:
        chosen, tuning = _tuned(turned, references, chosen, request)
    statics = _statics(campaign, turned, references, chosen, request)
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
    no_vibration_um = bias["dc2_um"] if len({r["feed_mm_min"] for r in rows}) > 1 else 0.0
    for row in rows:
        row["vibration_um"] = max(0.0, row["dc2_um"] - no_vibration_um)
    result: dict[str, Any] = {
        "campaign": campaign.name,
        "radius_mm": radius,
        "filter": _name(chosen, request),
        "reference_feed_mm_min": feed,
        "readings": turned[0].turn.readings,
        "two_lobes": None if chosen is None else vars(response(chosen, turned[0].turn.readings)),
        "bias": bias,
        "rows": rows,
        "tuning": None if tuning is None else tuning.as_dict(),
        "alpha": alpha_sensitivity(turned[order[-1]].turn, chosen),
    }
    result["findings"] = [f.as_dict() for f in findings_of(result, min(t.measured for t in turned))]
    return Split(result, curves, tuning)


def _turned(run: Run, readings: int) -> _Turned:
    meta = run.meta
    if not meta.radius_mm or not meta.feed_mm_min:
        raise InputError(
            "a run does not say its radius or its feed",
            code="dynamics.condition",
            where=meta.run_id,
            hint="add radius_mm and feed_mm_min to campaign.toml",
        )
    angle, deviation = run.arc
    try:
        turn = one_turn(angle, deviation, readings)
    except InputError as error:
        raise InputError(
            error.message, code=error.code, where=meta.run_id, got=error.got, allowed=error.allowed, hint=error.hint
        ) from error
    steps = np.abs(np.diff(angle))
    key = (meta.plane, meta.radius_mm, meta.direction, meta.setup)
    return _Turned(run, turn, round(360.0 / float(np.median(steps))), key)


def _require_different(turned: Sequence[_Turned]) -> None:
    seen: dict[bytes, str] = {}
    for one in turned:
        name = one.run.meta.run_id
        other = seen.setdefault(one.turn.deviation_um.tobytes(), name)
        if other != name:
            raise InputError(
                "two runs hold the same readings",
                code="dynamics.same_readings",
                where=f"{other} and {name}",
                allowed="repeats that were measured",
                hint="drop the copy: a repeat that agrees to the last digit hides the noise",
            )


def _sorting(run: Run) -> tuple[float, str, int]:
    return float(run.meta.feed_mm_min or 0.0), str(run.meta.direction), run.meta.repeat


def _reference_feed(turned: Sequence[_Turned], request: DynamicsRequest) -> float:
    feeds = sorted({float(t.run.meta.feed_mm_min or 0.0) for t in turned})
    wanted = request.reference_feed_mm_min
    if wanted is not None and wanted not in feeds:
        raise InputError(
            "no run has the feed of the reference",
            code="dynamics.reference_feed",
            got=f"{wanted:g} mm/min",
            allowed=", ".join(f"{f:g}" for f in feeds),
        )
    radii = {t.run.meta.radius_mm for t in turned}
    if len(radii) > 1:
        raise InputError(
            "runs of several radii do not share a reference",
            code="dynamics.radii",
            got=", ".join(f"{r:g}" for r in sorted(r or 0.0 for r in radii)),
            hint="one campaign for each radius",
        )
    return feeds[0] if wanted is None else wanted


def _references(turned: Sequence[_Turned], feed: float) -> dict[tuple[Any, ...], Turn]:
    """Mean of the slow repeats of each plane, direction and set-up."""
    out: dict[tuple[Any, ...], Turn] = {}
    for key in dict.fromkeys(t.key for t in turned):
        slow = [t.turn for t in turned if t.key == key and t.run.meta.feed_mm_min == feed]
        if not slow:
            raise InputError(
                "a direction or set-up has no slow reference",
                code="dynamics.reference",
                where=" ".join(str(part) for part in key),
                allowed=f"a run at {feed:g} mm/min",
            )
        angle = slow[0].angle_deg
        same = [_at_angles_of(slow[0], turn) for turn in slow]
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
            "only the unscented filters are tuned", code="dynamics.tune", got=request.how, allowed="ukf, ukf-circle"
        )
    fast = max(turned, key=lambda t: _sorting(t.run))
    slow_um = _at_angles_of(fast.turn, references[fast.key])
    found = tune(
        fast.turn.deviation_um, slow_um, start, tuned=request.tuned, fitness=request.fitness, settings=request.swarm
    )
    return found.chosen, found


def _name(chosen: Filter | None, request: DynamicsRequest) -> str:
    if chosen is not None:
        return chosen.name
    if request.how == "reference":
        return "slow runs of the same direction"
    return "twin: " + ", ".join(request.effects)


def _statics(
    campaign: Campaign,
    turned: Sequence[_Turned],
    references: Mapping[tuple[Any, ...], Turn],
    chosen: Filter | None,
    request: DynamicsRequest,
) -> list[Floats]:
    if chosen is not None:
        return [chosen.static_um(t.turn.deviation_um) for t in turned]
    if request.how == "reference":
        return [_at_angles_of(t.turn, references[t.key]) for t in turned]
    return _twin_static(campaign, turned, request)


def _at_angles_of(turn: Turn, other: Turn) -> Floats:
    return np.interp(turn.angle_deg, other.angle_deg, other.deviation_um, period=360.0)


def _twin_static(campaign: Campaign, turned: Sequence[_Turned], request: DynamicsRequest) -> list[Floats]:
    obs = observe(campaign, [t.run for t in turned])
    static = twin_static_um(obs, request.effects)
    first = {int(run): row for row, run in reversed(list(enumerate(obs.run_of)))}
    return [on_turn(static[first[i]], t.turn) for i, t in enumerate(turned)]


def _bias(rows: Sequence[Mapping[str, Any]], feed: float) -> dict[str, float]:
    """What the same way takes out of the slow runs, where there is next to no vibration."""
    slow = [row for row in rows if row["feed_mm_min"] == feed]
    return {n: float(np.mean([r[n] for r in slow])) for n in ("dc1_um", "dc2_um", "dc3_um")}


def _row(one: _Turned, parts: DynamicComponents, reference: Turn, radius_mm: float) -> dict[str, Any]:
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
        name: float(np.std(values)) for group in groups for name, values in group.columns.items() if name.endswith("_g")
    }


def findings_of(result: Mapping[str, Any], measured: int) -> list[Finding]:
    """Return what a reader must know before believing the figures.

    ``result``: as :class:`Split` holds it.
    ``measured``: fewest readings per revolution of a run, before resampling.
    """
    rows = result["rows"]
    findings: list[Finding] = []

    def say(code: str, message: str, **numbers: float) -> None:
        findings.append(Finding(f"dynamics.{code}", "warning", message, numbers))

    lobes = result["two_lobes"]
    if lobes and lobes["taken"] > _MOST_TAKEN:
        say(
            "eats_features",
            f"the filter takes {100 * lobes['taken']:z.0f} % of a real two-lobe error for dynamics "
            f"(leaves {100 * lobes['gain']:z.0f} %, {lobes['lag_deg']:z.1f} deg late): raise Q or the "
            "cutoff, or use the twin",
            taken=lobes["taken"],
        )
    fastest = max(r["feed_mm_min"] for r in rows)
    taken = float(np.mean([r["dc3_um"] for r in rows if r["feed_mm_min"] == fastest]))
    one_feed = fastest == min(r["feed_mm_min"] for r in rows)
    if one_feed:
        say("one_feed", "one feed only: nothing slower to compare with, the reference is these runs")
    elif result["bias"]["dc3_um"] > _MOST_BIAS * taken:
        say(
            "static_taken",
            f"{result['bias']['dc3_um']:z.2f} µm RMS are taken out of the slow runs, {taken:z.2f} µm out "
            "of the fastest: the twin lacks an effect (dtwin twin diagnose), the filter smooths too "
            "much, or the reference is not slow enough",
            slow_um=result["bias"]["dc3_um"],
            fast_um=taken,
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
    if apart and not one_feed:
        worst = max(apart, key=lambda r: r["difference"])
        say(
            "differs_from_reference",
            f"in {len(apart)} of {len(rows)} runs the circular deviation differs from the slow "
            f"reference by more than {100 * ACCEPTED_DIFFERENCE:z.0f} %, most in {worst['run']} "
            f"({100 * worst['difference']:z.0f} %): what changes with the feed was not all taken out",
            worst=worst["difference"],
        )
    grown = [r for r in rows if r["dc1_um"] < 0.0]
    if grown:
        say(
            "deviation_grew",
            f"in {len(grown)} of {len(rows)} runs the circular deviation is larger after than before",
            runs=float(len(grown)),
        )
    return findings
