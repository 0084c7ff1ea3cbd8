"""The source thesis's tracking chain, recomputed on a machine whose truth is known.

The chain adds to the robot's own position a displacement that is integrated twice from an
accelerometer, and reports how much nearer the mean radius comes to the ball bar's. Here every
step runs on the virtual cobot: the same loop rate, blocks, spectral threshold, restart of the
integration, mean over the middle half of the circle, and the same figure in per cent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.acquire.b5r import read_b5r
from dtwin.config import sample_recording
from dtwin.machines.cobot import CircleCondition, CobotRecording, VirtualCobot
from dtwin.machines.parameters import load_parameters
from dtwin.physics.circular import fit_circle
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run
from dtwin.units import UM_PER_MM
from studies.tracking_figures import (
    BLOCK_RATE_HZ,
    BLOCK_SAMPLES,
    DIRECTIONS,
    TUNED_AT_MM_MIN,
    Chain,
    Pass,
    reduce_passes,
)

RADIUS_MM = 100.0
FEEDS_MM_MIN = (2000.0, 3000.0, 4000.0, 5000.0, 6000.0)
REPEATS = 3
LOOP_HZ = 4.6


def tracking_chain(seed: int = 0, progress: Progress = silent, *, repeats: int = REPEATS) -> Chain:
    """Run the thesis's tracking test on the virtual cobot and reduce it as the thesis does.

    ``seed``: of the machine, its set-ups and its noise.
    ``progress``: called with (done, total, what).
    ``repeats``: Runs of each feed and direction; the thesis has three.
    """
    passes, recordings = _measured(seed, repeats, progress)
    return reduce_passes(passes, (*_circles(recordings), *_real_circles()))


def _measured(seed: int, repeats: int, progress: Progress) -> tuple[list[Pass], list[CobotRecording]]:
    plain = load_parameters()
    digitiser = replace(plain.accelerometers, rate_hz=BLOCK_RATE_HZ)
    cobot = VirtualCobot(replace(plain, accelerometers=digitiser), seed=seed)
    jobs = [(f, d, r) for f in FEEDS_MM_MIN for r in range(1, repeats + 1) for d in DIRECTIONS]
    passes, recordings = [], []
    for done, (feed, direction, repeat) in enumerate(jobs, start=1):
        condition = CircleCondition("XY", RADIUS_MM, feed, direction)
        # Recalibrating the bar between feeds, as the thesis does, does not mount it anew; means of
        # 66 to 74 um at five feeds come from one mounting.
        made = cobot.measure(condition, setup="tracking", repeat=repeat)
        passes.append(_pass(made, cobot.centre_mm(RADIUS_MM)))
        recordings.append(made)
        progress(done, len(jobs), f"F{feed:g} {direction}")
    return passes, recordings


def _pass(made: CobotRecording, centre_mm: Floats) -> Pass:
    """Read pose and acceleration at the rate of the thesis's loop, the bar beside them."""
    start, end = made.window
    bar_s = made.truth.bar_start_s + np.arange(len(made.deviation_mm)) / made.sample_rate_hz
    sensors, controller = made.groups
    sensor_s = made.truth.accelerometer_start_s
    last_s = sensor_s + (sensors.n_samples - BLOCK_SAMPLES) / BLOCK_RATE_HZ
    loop_s = np.arange(bar_s[start], min(bar_s[end - 1], last_s), 1.0 / LOOP_HZ)
    first = np.round((loop_s - sensor_s) * BLOCK_RATE_HZ).astype(int)
    wrist = np.stack([sensors.columns[f"wrist_{a}_g"] for a in "xyz"])
    # The thesis subtracts an offset that it reads at rest before the run.
    wrist = wrist - wrist[:, :BLOCK_SAMPLES].mean(axis=1, keepdims=True)
    tcp = [np.interp(loop_s, controller.t_s, controller.columns[f"actual_tcp_{a}_mm"]) for a in "xy"]
    x, y = tcp[0] - centre_mm[0], tcp[1] - centre_mm[1]
    n = len(loop_s)
    return Pass(
        made.condition.feed_mm_min,
        made.condition.direction,
        made.repeat,
        np.arctan2(y, x),
        UM_PER_MM * np.interp(loop_s, bar_s, made.deviation_mm),
        UM_PER_MM * (np.hypot(x, y) - RADIUS_MM),
        np.stack([wrist[:, i : i + BLOCK_SAMPLES] for i in first]),
        slice(n // 4, 3 * n // 4),
    )


def _circles(recordings: Sequence[CobotRecording]) -> list[dict[str, Any]]:
    """Return middle half and full circle of the first repeat at the tuned feed."""
    out = []
    for made in recordings:
        if made.condition.feed_mm_min != TUNED_AT_MM_MIN or made.repeat != 1:
            continue
        start, end = made.window
        deviation = UM_PER_MM * made.deviation_mm[start:end]
        sign = 1.0 if made.condition.direction == "CCW" else -1.0
        angle = sign * np.arange(end - start) * 360.0 / (end - start) - 90.0
        out.append(_circle(f"virtual {made.condition.direction}", angle, deviation))
    return out


def _real_circles() -> list[dict[str, Any]]:
    return [_real_circle(run) for run in read_b5r(sample_recording()).runs]


def _real_circle(run: Run) -> dict[str, Any]:
    return _circle(f"real {run.meta.direction}", *run.arc)


def _circle(name: str, angle_deg: Floats, deviation_um: Floats) -> dict[str, Any]:
    n = len(deviation_um)
    fitted = fit_circle(angle_deg, deviation_um, RADIUS_MM)
    return {
        "circle": name,
        "middle_half_um": float(deviation_um[n // 4 : 3 * n // 4].mean()),
        "full_circle_um": float(deviation_um.mean()),
        "centre_offset_um": math.hypot(fitted.centre_a_um, fitted.centre_b_um),
    }
