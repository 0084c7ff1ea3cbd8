"""Commanded motion of a ball-bar program: in-feed, arcs that stop, out-feed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.kinematics import kernel, plane_axes
from dtwin.machines.parameters import MotionParameters
from dtwin.schema import Floats, standard_plane

START_S, DURATION_S, SPEED, RAMP_S, JERK_S, KIND, RADIUS0, ANGLE0, SIGN, LENGTH = range(10)
LINE_FROM, LINE_TOWARDS, COLUMNS = 10, 13, 16
# Kinds of segment: straight along the radius, on the arc, straight from point to point, and on a
# sphere, where azimuth and elevation change in proportion.
_RADIAL, _ARC, LINE, SPHERE = 0.0, 1.0, 2.0, 3.0
TURN, ELEVATION0, RISE = LINE_FROM, LINE_FROM + 1, LINE_FROM + 2


@dataclass(frozen=True)
class CircleCondition:
    """What one circular run is asked to do.

    ``plane``: XY, YZ or ZX (XZ and the like are converted, which flips the direction).
    ``direction``: ``"CCW"`` or ``"CW"``, seen from the positive normal of the plane.
    """

    plane: str
    radius_mm: float
    feed_mm_min: float
    direction: str

    def standard(self) -> CircleCondition:
        """Return the same motion with its plane named XY, YZ or ZX.

        Raises ``InputError`` when plane, direction, radius or feed make no sense.
        """
        if self.direction not in ("CCW", "CW"):
            raise InputError("unknown direction", code="run.direction", got=self.direction, allowed="CCW, CW")
        if not (10.0 <= self.radius_mm <= 400.0 and 50.0 <= self.feed_mm_min <= 30000.0):
            raise InputError(
                "radius or feed is outside what this robot can do",
                code="run.condition",
                got=f"radius {self.radius_mm} mm, feed {self.feed_mm_min} mm/min",
                allowed="radius 10 to 400 mm, feed 50 to 30000 mm/min",
            )
        plane, direction = standard_plane(self.plane, "CCW" if self.direction == "CCW" else "CW")
        return CircleCondition(plane, self.radius_mm, self.feed_mm_min, direction)

    @property
    def sign(self) -> float:
        """+1 for counter-clockwise, -1 for clockwise."""
        return 1.0 if self.direction == "CCW" else -1.0


@dataclass(frozen=True)
class MotionPlan:
    """Timed segments of one program.

    ``segments`` (n, 16): one row per straight move or arc, columns as named in this module.
    ``frame`` (3, 3): rows: first and second axis of the plane, centre in mm.
    ``duration_s``: length of the program, a whole number of ticks.
    ``window_rad``: path angles between which the run counts as measured.
    """

    segments: Floats
    frame: Floats
    duration_s: float
    window_rad: tuple[float, float]


@kernel
def _cubed(time_s: float) -> float:
    return time_s * time_s * time_s if time_s > 0.0 else 0.0


@kernel
def travelled_kernel(time_s: float, duration_s: float, speed: float, ramp_s: float, jerk_s: float) -> float:
    """Return the way travelled on a jerk-limited, stop-to-stop speed profile.

    Acceleration is a trapezoid: jerk phases of ``jerk_s`` around a ramp of ``ramp_s``.

    ``time_s``, ``duration_s``: time since the start of the segment, and its whole length.
    ``speed``: speed between the ramps, mm/s.
    ``ramp_s``, ``jerk_s``: speed over acceleration, and acceleration over jerk.
    """
    gain = speed / (6.0 * ramp_s * jerk_s)
    brake_s = duration_s - ramp_s - jerk_s
    way = 0.0
    for side in range(2):
        t = time_s if side == 0 else time_s - brake_s
        bent = _cubed(t) - _cubed(t - jerk_s) - _cubed(t - ramp_s) + _cubed(t - ramp_s - jerk_s)
        way += gain * bent if side == 0 else -gain * bent
    return way


@kernel
def path_kernel(time_s: float, segments: Floats, frame: Floats, position_mm: Floats) -> int:
    """Write the commanded position at a path time and return the segment number.

    ``segments``, ``frame``: as in ``MotionPlan``.
    ``position_mm``, (3,): receives the position in the base frame.
    """
    current = 0
    while current + 1 < segments.shape[0] and time_s >= segments[current + 1, START_S]:
        current += 1
    segment = segments[current]
    time_s = min(max(time_s - segment[START_S], 0.0), segment[DURATION_S])
    way = segment[SIGN] * travelled_kernel(
        time_s, segment[DURATION_S], segment[SPEED], segment[RAMP_S], segment[JERK_S]
    )
    if segment[KIND] == LINE:
        for i in range(3):
            position_mm[i] = segment[LINE_FROM + i] + way * segment[LINE_TOWARDS + i]
        return current
    radius, angle = segment[RADIUS0], segment[ANGLE0]
    if segment[KIND] == SPHERE:
        share = way / segment[LENGTH]
        angle += share * segment[TURN]
        elevation = segment[ELEVATION0] + abs(share) * segment[RISE]
        height = radius * np.sin(elevation)
        radius *= np.cos(elevation)
        c, s = np.cos(angle), np.sin(angle)
        for i in range(3):
            flat = radius * (c * frame[0, i] + s * frame[1, i])
            position_mm[i] = frame[2, i] + flat
        # Spheres are driven about the vertical axis only.
        position_mm[2] += height
        return current
    if segment[KIND] == _ARC:
        angle += way / radius
    else:
        radius += way
    c, s = np.cos(angle), np.sin(angle)
    for i in range(3):
        position_mm[i] = frame[2, i] + radius * (c * frame[0, i] + s * frame[1, i])
    return current


@kernel
def jolt_kernel(time_s: float, segment: Floats, frame: Floats, jolts: Floats, acceleration: Floats) -> None:
    """Write the jolt with which the drives let go and catch the arm around an arc.

    ``segment``, ``frame``: current row of ``MotionPlan.segments``, and the plan's frame.
    ``jolts``, (3,): share of the path speed that is caught at a stop, part of that at a start, duration of the
    half-sine pulse in s.
    ``acceleration``, (3,): receives the pulse in mm/s^2, base frame; zero outside a pulse.
    """
    acceleration[:] = 0.0
    if segment[KIND] != _ARC and segment[KIND] != SPHERE:
        return
    since = time_s - segment[START_S]
    share, angle = jolts[0] * jolts[1], segment[ANGLE0]
    if since >= segment[DURATION_S]:
        since -= segment[DURATION_S]
        share = -jolts[0]
        turned = segment[LENGTH] / segment[RADIUS0] if segment[KIND] == _ARC else segment[TURN]
        angle += segment[SIGN] * turned
    if not 0.0 <= since < jolts[2]:
        return
    change = share * segment[SPEED] * segment[SIGN]
    pulse = 0.5 * np.pi * change / jolts[2] * np.sin(np.pi * since / jolts[2])
    for i in range(3):
        acceleration[i] = pulse * (np.cos(angle) * frame[1, i] - np.sin(angle) * frame[0, i])


def plan_motion(condition: CircleCondition, centre_mm: Floats, motion: MotionParameters, tick_s: float) -> MotionPlan:
    """Return the timed program of a circular run.

    XY runs are two revolutions of half circles with a stop after each; the middle revolution
    counts. The upright planes are one arc over the top with a run-in and run-out.

    ``condition``: in standard form.
    ``centre_mm``, (3,): centre of the circle in the base frame.
    ``motion``: acceleration, jerk, in-feed and dwell.
    ``tick_s``: controller period; segments start on whole ticks.
    """
    full = condition.plane == "XY"
    arcs_deg = [180.0] * 4 if full else [180.0 + 2 * motion.arc_overlap_deg]
    middle_deg = motion.start_angle_xy_deg if full else {"YZ": 90.0, "ZX": 0.0}[condition.plane]
    half_deg = 0.0 if full else arcs_deg[0] / 2
    start = np.radians(middle_deg - condition.sign * half_deg)
    lead = np.radians(motion.overshoot_xy_deg if full else motion.arc_overlap_deg)
    radius, feed = condition.radius_mm, condition.feed_mm_min / 60.0
    steps = [(False, motion.infeed_mm, radius + motion.infeed_mm, start, -1.0)]
    angle = start
    for arc_deg in arcs_deg:
        arc = np.radians(arc_deg)
        steps.append((True, arc * radius, radius, angle, condition.sign))
        angle += condition.sign * arc
    steps.append((False, motion.infeed_mm, radius, angle, 1.0))
    segments = np.zeros((len(steps), COLUMNS))
    clock_s = motion.rest_s
    for row, (is_arc, length_mm, radius0_mm, angle0, sign) in zip(segments, steps, strict=True):
        speed = feed if is_arc else min(feed, motion.infeed_speed_mm_s)
        row[:] = _segment(is_arc, length_mm, speed, radius0_mm, angle0, sign, motion)
        row[START_S] = tick_s * round(clock_s / tick_s)
        clock_s = tick_s * np.ceil((row[START_S] + row[DURATION_S] + motion.dwell_s) / tick_s)
    ends = (start + condition.sign * lead, angle - condition.sign * lead)
    frame = np.vstack([*plane_axes(condition.plane), centre_mm])
    return MotionPlan(segments, frame, float(clock_s + motion.rest_s), (ends[0], ends[1]))


def line_segment(length_mm: float, speed_mm_s: float, motion: MotionParameters) -> Floats:
    """Return the row (16,) of a straight move without its start time, points and kind.

    ``length_mm``, ``speed_mm_s``: way, and the speed that is asked for.
    ``motion``: acceleration and jerk.
    """
    return _segment(False, length_mm, speed_mm_s, 0.0, 0.0, 1.0, motion)


def _segment(
    is_arc: bool,
    length_mm: float,
    speed_mm_s: float,
    radius0_mm: float,
    angle0_rad: float,
    sign: float,
    motion: MotionParameters,
) -> Floats:
    jerk_s = motion.acceleration_mm_s2 / motion.jerk_mm_s3
    reach_s = np.sqrt(jerk_s**2 + 4.0 * length_mm / motion.acceleration_mm_s2) - jerk_s
    speed_mm_s = min(speed_mm_s, 0.5 * motion.acceleration_mm_s2 * reach_s)
    ramp_s = speed_mm_s / motion.acceleration_mm_s2
    duration_s = length_mm / speed_mm_s + ramp_s + jerk_s
    shape = [0.0, duration_s, speed_mm_s, ramp_s, jerk_s]
    path = [_ARC if is_arc else _RADIAL, radius0_mm, angle0_rad, sign, length_mm]
    return np.array([*shape, *path, *np.zeros(COLUMNS - LINE_FROM)])
