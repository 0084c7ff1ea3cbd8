"""A program of straight moves that stop at every target, as ``movel`` without blending does."""

from __future__ import annotations

import numpy as np

from dtwin.errors import InputError
from dtwin.machines import mechanism as m_
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.motion import (
    COLUMNS,
    DURATION_S,
    KIND,
    LINE,
    LINE_FROM,
    LINE_TOWARDS,
    RADIUS0,
    START_S,
    MotionPlan,
    line_segment,
)
from dtwin.schema import Floats

_SHORTEST_MM = 0.1


def visit(cobot: VirtualCobot, sent_mm: Floats, *, centre_mm: Floats, feed_mm_min: float, repeat: int) -> Floats:
    """Return where the tool really stood at each target, shape (n, 3) in mm.

    A touch probe reads every stop, with the noise of the ball bar's sensor. The frame is set at
    the centre, so the error there is zero by definition.

    Args:
        cobot: The machine.
        sent_mm: Targets as the robot receives them, in the base frame; the tool starts at the first one. Shape (n, 3).
        centre_mm: Where the frame was set. Shape (3,).
        feed_mm_min: Speed between targets.
        repeat: Seeds the probe's noise.

    Raises:
        InputError: When two successive targets are the same, or fewer than two are given.
    """
    plan = _plan(cobot, np.asarray(sent_mm, dtype=float), centre_mm, feed_mm_min)
    truths = cobot.run(plan).truths
    rate_hz = cobot.parameters.controller.rate_hz
    starts = plan.segments[:, START_S]
    ends_s = np.append(starts[1:], plan.duration_s)
    # The last tick of the dwell at the end of each move, and the one before the first move.
    ticks = np.round(np.append(starts[0], ends_s) * rate_hz).astype(int) - 1
    rng = np.random.default_rng([cobot.seed, 7, repeat])
    noise_mm = 1e-3 * cobot.parameters.ballbar.noise_um * rng.standard_normal((len(ticks), 3))
    return truths[ticks, m_.TCP : m_.TCP + 3] + noise_mm


def _plan(cobot: VirtualCobot, sent_mm: Floats, centre_mm: Floats, feed_mm_min: float) -> MotionPlan:
    ways = np.diff(sent_mm, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    if len(sent_mm) < 2 or lengths.min() < _SHORTEST_MM:
        raise InputError(
            "a program needs two targets or more, each somewhere else than the one before",
            code="points.targets",
            got=f"{len(sent_mm)} targets",
        )
    motion, tick_s = cobot.parameters.motion, 1.0 / cobot.parameters.controller.rate_hz
    rows = np.zeros((len(ways), COLUMNS))
    clock_s = motion.rest_s
    for row, start, way, length in zip(rows, sent_mm[:-1], ways, lengths, strict=True):
        row[:] = line_segment(float(length), feed_mm_min / 60.0, motion)
        row[KIND] = LINE
        row[LINE_FROM : LINE_FROM + 3] = start
        row[LINE_TOWARDS : LINE_TOWARDS + 3] = way / length
        row[START_S] = tick_s * round(clock_s / tick_s)
        clock_s = tick_s * np.ceil((row[START_S] + row[DURATION_S] + motion.rest_s) / tick_s)
    outward = sent_mm[0] - centre_mm
    rows[0, RADIUS0] = np.linalg.norm(outward)
    frame = np.vstack([outward / np.linalg.norm(outward), np.eye(3)[2], centre_mm])
    return MotionPlan(rows, frame, float(clock_s), (0.0, 0.0))
