"""What is wrong with a cycle of a ball array, said before anyone identifies with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.acquire.quality import judge_clock, judge_places
from dtwin.kinds.volumetric._identify import Balls
from dtwin.kinds.volumetric._plan import FEWEST_TABLE_BALLS, MOST_DRIFT_UM
from dtwin.kinds.volumetric._session import PLAUSIBLE_C, balls_of, hours_of, hours_told, poses_told
from dtwin.kinds.volumetric._spoilt import spoilt_findings, spoilt_in, stroke_mm
from dtwin.schema import Campaign, Finding, Floats, Run, SignalGroup
from dtwin.units import UM_PER_MM, shown_number

_FIXED_POSE = 0
_MAX_ERROR_UM = 2_000.0
_LEAST_UM = 0.2
_LEAST_APART_MM = 1.0
_STUCK_C = 1e-6
_BEYOND = 0.05
"""Share of a stroke by which a ball may lie beyond it: strokes are told roughly."""


def with_strokes(run: Run, campaign: Campaign) -> Run:
    """Return a cycle with what is wrong with its places beside the strokes that the campaign states, where it does.

    Raises ``InputError`` when a stroke, or what is stated of poses, is none: nothing could be fitted later.
    """
    where = f"campaign {campaign.name}"
    poses_told(campaign.machine_geometry, where)
    strokes = {
        axis: stroke_mm(campaign.machine_geometry, axis, where)
        for axis in "xyz"
        if f"stroke_{axis}_mm" in campaign.machine_geometry
    }
    for axis, (low, high) in strokes.items():
        at = run.samples.get(f"{axis}_mm")
        if at is None:
            continue
        if max(low - at.min(), at.max() - high) > _BEYOND * abs(high - low):
            metres = low <= UM_PER_MM * at.max() <= high and low <= UM_PER_MM * at.min()
            why = "metres under a name of millimetres" if metres else "another axis, or another zero"
            text = f"balls lie at {axis} = {shown_number(at.min(), 4)} to {shown_number(at.max(), 4)} mm, the stroke is {low:g} to {high:g} mm: {why}?"
            return replace(run, findings=(*run.findings, Finding("balls.outside_stroke", "error", text)))
    return run


def judge_volumetric_run(run: Run) -> list[Finding]:
    """Return the findings of one cycle.

    ``run``: with ``x_mm`` ... ``error_z_um``, ``pose_1`` and ``ball_1``; pose 0 are the balls on the table.
    """
    if "pose_1" not in run.samples or "ball_1" not in run.samples:
        return [
            Finding(
                "balls.unnamed",
                "error",
                "the readings do not say which ball in which pose was touched: add pose_1 and ball_1",
            )
        ]
    error = np.stack([run.samples[f"error_{axis}_um"] for axis in "xyz"], axis=1)
    return [
        # Between the poses the array is turned: gaps in time are no lost samples.
        *(finding for finding in judge_clock(run) if finding.code != "clock.dropout"),
        *_places(run),
        *_range(error),
        *_still(error),
        *_positions(run),
        *_fixed(run.samples["pose_1"], run.samples["ball_1"], error),
        *(finding for group in run.signals for finding in _temperatures(group)),
    ]


def judge_volumetric_campaign(runs: Sequence[Run]) -> list[Finding]:
    """Return which readings and cycles stand off those before and after them."""
    sound = [
        run
        for run in runs
        if {"pose_1", "ball_1"} <= set(run.samples) and all(f.severity != "error" for f in run.findings)
    ]
    hour_by_run = hours_of(sound)
    sound.sort(key=lambda run: hour_by_run[run.meta.run_id])
    cycles = [balls_of(run) for run in sound]
    return _hours(sound) + _spoilt(sound, cycles)


def _spoilt(sound: Sequence[Run], cycles: Sequence[Balls]) -> list[Finding]:
    return spoilt_findings([run.meta.run_id for run in sound], cycles, spoilt_in(cycles)) if cycles else []


def _hours(sound: Sequence[Run]) -> list[Finding]:
    """Return what is wrong with the hours of cycles: drift, days left out and jobs are judged by them."""
    said = ""
    told = hours_of(sound)
    if len(sound) > 1 and not hours_told(sound):
        said = "not every cycle states when it began: they are counted as one an hour, in the order of campaign.toml"
    elif twice := [name for name, hour in told.items() if list(told.values()).count(hour) > 1]:
        said = f"{', '.join(twice[:4])}{' …' * (len(twice) > 4)} began at the same hour as another cycle"
    return [Finding("cycle.hours", "warning", f"{said}; state time_h under [run.condition]")] if said else []


def _places(run: Run) -> list[Finding]:
    there = {axis: run.samples[f"{axis}_mm"] for axis in "xyz" if f"{axis}_mm" in run.samples}
    flat = [f"{axis}_mm" for axis, at in there.items() if float(np.ptp(at)) < _LEAST_APART_MM]
    if not flat:
        return []
    text = (
        f"all balls lie within {_LEAST_APART_MM:g} mm in {' and '.join(flat)}: an array in one plane, whose errors across it nobody can tell, or a column that "
        "was filled down"
    )
    return [Finding("balls.one_place", "warning", text)]


def _range(error: Floats) -> list[Finding]:
    largest = float(np.abs(error).max())
    if 0.0 < largest < _LEAST_UM:
        text = f"no ball is farther than {shown_number(largest, 2)} µm from its place: millimetres under heads of micrometres?"
        return [Finding("balls.small", "error", text, {"largest_um": largest})]
    if largest <= _MAX_ERROR_UM:
        return []
    text = f"a ball was found {largest:z.0f} µm beside its place: wrong ball, wrong unit, or a missed touch"
    return [Finding("balls.out_of_range", "error", text, {"largest_um": largest})]


def _still(error: Floats) -> list[Finding]:
    """Return the directions in which no ball has an error at all, beside others that have one."""
    still = [f"error_{axis}_um" for axis, there in zip("xyz", np.ptp(error, axis=0) > 0.0, strict=True) if not there]
    if not 0 < len(still) < error.shape[1]:
        return []
    text = f"{' and '.join(still)} {'is' if len(still) == 1 else 'are'} the same at every ball: this direction was not measured, and errors of it are unknown, not 0"
    return [Finding("balls.axis_still", "error", text)]


def _positions(run: Run) -> list[Finding]:
    told = ((f"error_{axis}_um", f"{axis}_mm") for axis in "xyz" if f"{axis}_mm" in run.samples)
    return [f for e, at in told for f in judge_places(run.samples[e], run.samples[at], e, "balls.positions")]


def _fixed(pose: Floats, ball: Floats, error: Floats) -> list[Finding]:
    """Judge the balls on the table: without three of them the machine's own shift is unknown."""
    there = pose == _FIXED_POSE
    balls = np.unique(ball[there])
    if len(balls) < FEWEST_TABLE_BALLS:
        text = f"{len(balls)} balls on the table were measured: shifts and turns of the whole machine need three"
        return [Finding("balls.fixed_missing", "error", text, {"balls_1": float(len(balls))})]
    moved = 0.0
    for number in balls:
        rows = error[there & (ball == number)]
        if len(rows) > 1:
            moved = max(moved, float(np.abs(rows[-1] - rows[0]).max()))
    if moved <= MOST_DRIFT_UM:
        return []
    text = f"a ball on the table moved by {moved:z.1f} µm within the cycle: it takes longer than the heat allows"
    return [Finding("cycle.drift", "warning", text, {"moved_um": moved})]


def _temperatures(group: SignalGroup) -> list[Finding]:
    findings = []
    for name, values in group.columns.items():
        if not name.endswith("_c"):
            continue
        gaps = float(np.mean(~np.isfinite(values)))
        if gaps > 0.0:
            text = f"{name} has no reading in {shown_number(100.0 * gaps, 2)} % of the cycle"
            findings.append(Finding("sensor.gap", "warning", text, {"share_1": gaps}))
            continue
        if values.min() < PLAUSIBLE_C[0] or values.max() > PLAUSIBLE_C[1]:
            text = f"{name} reads {values.min():z.1f} to {values.max():z.1f} degC: a broken wire"
            findings.append(Finding("sensor.implausible", "warning", text))
        elif len(values) > 10 and np.ptp(values) < _STUCK_C:
            findings.append(Finding("sensor.stuck", "warning", f"{name} does not change at all"))
    return findings
