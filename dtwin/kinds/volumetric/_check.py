"""What is wrong with a cycle of a ball array, said before anyone identifies with it."""

from __future__ import annotations

import numpy as np

from dtwin.kinds.volumetric._plan import FEWEST_TABLE_BALLS, MOST_DRIFT_UM
from dtwin.schema import Finding, Floats, Run, SignalGroup

_FIXED_POSE = 0
_MAX_ERROR_UM = 2_000.0
_STUCK_C = 1e-6
_PLAUSIBLE_C = (-20.0, 90.0)


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
        *_range(error),
        *_fixed(run.samples["pose_1"], run.samples["ball_1"], error),
        *(finding for group in run.signals for finding in _temperatures(group)),
    ]


def _range(error: Floats) -> list[Finding]:
    largest = float(np.abs(error).max())
    if largest <= _MAX_ERROR_UM:
        return []
    text = f"a ball was found {largest:z.0f} µm beside its place: wrong ball, wrong unit, or a missed touch"
    return [Finding("balls.out_of_range", "error", text, {"largest_um": largest})]


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
            text = f"{name} has no reading in {gaps:.0%} of the cycle"
            findings.append(Finding("sensor.gap", "warning", text, {"share_1": gaps}))
            continue
        if values.min() < _PLAUSIBLE_C[0] or values.max() > _PLAUSIBLE_C[1]:
            text = f"{name} reads {values.min():z.1f} to {values.max():z.1f} degC: a broken wire"
            findings.append(Finding("sensor.implausible", "warning", text))
        elif len(values) > 10 and np.ptp(values) < _STUCK_C:
            findings.append(Finding("sensor.stuck", "warning", f"{name} does not change at all"))
    return findings
