"""Three circles at three heights on one sphere, so that a ball bar follows them all.

The robot stops after every quarter and after each of the two half turns that lead from one height
to the next, as programs do that are started one after the other.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from dtwin.links import layout
from dtwin.machines import mechanism as m_
from dtwin.machines._instrument_record import RunTicks
from dtwin.machines._sensors import drift_kernel, read_ballbar
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.controller import CobotController
from dtwin.machines.motion import (
    ANGLE0,
    COLUMNS,
    DURATION_S,
    ELEVATION0,
    KIND,
    LINE,
    LINE_FROM,
    LINE_TOWARDS,
    RADIUS0,
    RISE,
    SIGN,
    SPHERE,
    START_S,
    TURN,
    CircleCondition,
    MotionPlan,
    line_segment,
)
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

RADIUS_MM = 150.0
HEIGHT_MM = 38.823
START_DEG = -90.0
CLOCKWISE = -1.0
_QUARTER, _HALF = 0.5 * np.pi, np.pi
# The bar's clock is set by the in-feed, to half of its sampling period.
_CLOCK_S = 0.0025


@dataclass(frozen=True)
class SphereRun:
    """What the ball bar recorded on the way, with the commanded place of every reading.

    ``feed_mm_min``: programmed feed.
    ``section``, (n,): which move it belongs to, from 1; 0 and the last are in-feed and out-feed.
    ``section_s``, (n,): time since that move began.
    ``azimuth_rad``, ``elevation_rad``, (n,): commanded direction of the bar; the azimuth is unwrapped.
    ``deviation_um``, (n,): measured length minus the nominal one.
    """

    feed_mm_min: float
    section: Floats
    section_s: Floats
    azimuth_rad: Floats
    elevation_rad: Floats
    deviation_um: Floats


def sphere_plan(cobot: VirtualCobot, feed_mm_min: float) -> MotionPlan:
    """Return the program: low circle, half turn up, middle circle, half turn up, top circle.

    ``cobot``: gives the place of the bar, acceleration and dwell.
    ``feed_mm_min``: programmed feed.
    """
    motion = cobot.parameters.motion
    tick_s, centre = 1.0 / cobot.parameters.controller.rate_hz, cobot.centre_mm(RADIUS_MM)
    tilt = float(np.arcsin(HEIGHT_MM / RADIUS_MM))
    moves = [(_QUARTER, -tilt, 0.0)] * 4 + [(_HALF, -tilt, tilt)]
    moves += [(_QUARTER, 0.0, 0.0)] * 4 + [(_HALF, 0.0, tilt)] + [(_QUARTER, tilt, 0.0)] * 4
    azimuth = np.radians(START_DEG)
    rows = [_along_bar(cobot, azimuth, -tilt, 1.0)]
    for turn, elevation, rise in moves:
        length = RADIUS_MM * np.hypot(turn * np.cos(elevation + 0.5 * rise), rise)
        row = line_segment(float(length), feed_mm_min / 60.0, motion)
        row[[KIND, RADIUS0, ANGLE0, SIGN]] = SPHERE, RADIUS_MM, azimuth, CLOCKWISE
        row[[TURN, ELEVATION0, RISE]] = turn, elevation, rise
        rows.append(row)
        azimuth += CLOCKWISE * turn
    rows.append(_along_bar(cobot, azimuth, tilt, -1.0))
    clock_s = motion.rest_s
    for row in rows:
        row[START_S] = tick_s * round(clock_s / tick_s)
        clock_s = tick_s * np.ceil((row[START_S] + row[DURATION_S] + motion.dwell_s) / tick_s)
    frame = np.vstack([np.eye(3)[:2], centre])
    return MotionPlan(np.array(rows), frame, float(clock_s + motion.rest_s), (0.0, 0.0))


def sphere_controller(cobot: VirtualCobot, plan: MotionPlan, feed_mm_min: float) -> CobotController:
    """Return the controller about to run the program, for a closed loop.

    ``cobot``, ``plan``, ``feed_mm_min``: machine, its program, and the feed that it reports.
    """
    condition = CircleCondition("XY", RADIUS_MM, feed_mm_min, "CW")
    return CobotController(condition, plan, *cobot.at_rest(plan))


def sphere_run(cobot: VirtualCobot, feed_mm_min: float, ticks: RunTicks, *, setup: str, repeat: int) -> SphereRun:
    """Return what the ball bar makes of a finished run.

    ``cobot``: the machine, its mountings and what does not repeat.
    ``feed_mm_min``: programmed feed.
    ``ticks``: every tick of the run.
    ``setup``: mounting of the bar.
    ``repeat``: repeat, which seeds what does not repeat.
    """
    parameters, mounting = cobot.parameters, cobot.setup(setup, "XY")
    bar, rate_hz = parameters.ballbar, parameters.controller.rate_hz
    key = zlib.crc32(f"sphere {feed_mm_min} {setup}".encode())
    rng = np.random.default_rng([cobot.seed, 5, key, repeat])
    drift_um = rng.standard_normal((len(ticks.truths), 3))
    loose = parameters.disturbance
    drift_kernel(drift_um, loose.drift_rms_um, loose.drift_time_s, 1.0 / rate_hz)
    tool_mm = ticks.truths[:, m_.TCP : m_.TCP + 3] + drift_um / UM_PER_MM
    first, last = _measured(ticks.states)
    ppm = bar.clock_error_ppm * rng.uniform(-1, 1)
    start_s = first / rate_hz + _CLOCK_S * rng.uniform(-1, 1)
    n = int((last - first) / rate_hz * bar.rate_hz)
    noise_um = mounting.length_error_um + bar.noise_um * rng.standard_normal(n)
    centre = cobot.centre_mm(RADIUS_MM) + mounting.eccentricity_um / UM_PER_MM
    deviation_mm = read_ballbar(bar, tool_mm, rate_hz, centre, RADIUS_MM, (start_s, ppm, n), noise_um)
    at = np.minimum(first + np.round(np.arange(n) * rate_hz / bar.rate_hz).astype(int), last)
    azimuth, elevation = directions(ticks.truths[:, :3] - cobot.centre_mm(RADIUS_MM))
    return SphereRun(
        feed_mm_min,
        ticks.states[at, layout.SEGMENT_ID],
        ticks.states[at, layout.SEGMENT_TIME],
        azimuth[at],
        elevation[at],
        UM_PER_MM * deviation_mm,
    )


def directions(spoke_mm: Floats) -> tuple[Floats, Floats]:
    """Return azimuth, unwrapped, and elevation of successive directions (n, 3), in rad."""
    flat = np.hypot(spoke_mm[:, 0], spoke_mm[:, 1])
    return np.unwrap(np.arctan2(spoke_mm[:, 1], spoke_mm[:, 0])), np.arctan2(spoke_mm[:, 2], flat)


def _measured(states: Floats) -> tuple[int, int]:
    """Return first and last tick between in-feed and out-feed."""
    section = states[:, layout.SEGMENT_ID]
    on_sphere = np.flatnonzero((section > 0) & (section < section.max()))
    return int(on_sphere[0]), int(on_sphere[-1])


def _along_bar(cobot: VirtualCobot, azimuth: float, elevation: float, inward: float) -> Floats:
    """Return a straight move along the bar: the in-feed, or with ``inward`` -1 the out-feed."""
    motion = cobot.parameters.motion
    unit = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    row = line_segment(motion.infeed_mm, motion.infeed_speed_mm_s, motion)
    begins = RADIUS_MM + (motion.infeed_mm if inward > 0.0 else 0.0)
    row[KIND] = LINE
    row[LINE_FROM : LINE_FROM + 3] = cobot.centre_mm(RADIUS_MM) + begins * unit
    row[LINE_TOWARDS : LINE_TOWARDS + 3] = -inward * unit
    row[[RADIUS0, ANGLE0]] = begins, azimuth
    assert len(row) == COLUMNS
    return row
