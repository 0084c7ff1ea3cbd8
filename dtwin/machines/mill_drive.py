"""Motion of one axis of the virtual mill, step by step in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.kinematics import kernel
from dtwin.machines.mill_parameters import AxisParameters
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

STEP_S = 0.001
_RAMP_S = 0.2
_LEAD_IN_RAD = np.pi
_LEAD_OUT_S = 0.1


@dataclass(frozen=True)
class Command:
    """Commanded circle on the controller's clock.

    ``start_s``: time at which the lead-in ends and the measured turn begins.
    ``phase_rad``, shape (n,): path angle.
    ``position_mm``, ``velocity_mm_s``, ``acceleration_mm_s2``, shape (2, n): of the two axes of the plane.
    """

    start_s: float
    phase_rad: Floats
    position_mm: Floats
    velocity_mm_s: Floats
    acceleration_mm_s2: Floats


def circle(radius_mm: float, feed_mm_s: float, sense: float, changeover_mm: float) -> Command:
    """Return the command of a half turn of lead-in and one turn.

    ``sense``: +1 counter-clockwise, -1 clockwise.
    ``changeover_mm``: by how much the radius is smaller while the second axis leads.
    """
    speed = feed_mm_s / radius_mm
    start_s = _LEAD_IN_RAD / speed + 0.5 * _RAMP_S
    n = int((start_s + 2.0 * np.pi / speed + _LEAD_OUT_S) / STEP_S) + 2
    t_s = np.arange(n) * STEP_S
    ramp = np.minimum(t_s / _RAMP_S, 1.0)
    rising = 0.5 * _RAMP_S * (ramp - np.sin(np.pi * ramp) / np.pi)
    travelled = rising + np.maximum(t_s - _RAMP_S, 0.0)
    phase = sense * (speed * travelled - _LEAD_IN_RAD)
    rate = sense * speed * 0.5 * (1.0 - np.cos(np.pi * ramp))
    gain = sense * speed * 0.5 * np.pi / _RAMP_S * np.sin(np.pi * ramp)
    along, across = (np.stack([np.cos(phase), np.sin(phase)]), np.stack([-np.sin(phase), np.cos(phase)]))
    leads = np.abs(across[1]) > np.abs(across[0])
    r = radius_mm + np.where(leads, -0.5, 0.5) * changeover_mm
    return Command(start_s, phase, r * along, radius_mm * across * rate, radius_mm * (across * gain - along * rate**2))


@dataclass(frozen=True)
class Driven:
    """Where an axis really goes.

    ``along_mm``, (n,): position of the table minus the command.
    ``sideways_mm``, (n,): displacement across the axis, in the plane.
    ``encoder_mm``, (n,): position that the encoder at the motor reports, minus the command: it sees the servo loop and
    its friction, but neither screw, play, carriage nor structure.
    """

    along_mm: Floats
    sideways_mm: Floats
    encoder_mm: Floats


def drive(
    command: Command, number: int, axis: AxisParameters, offset_mm: float, correction_mm: Floats | None = None
) -> Driven:
    """Return what one axis makes of a command.

    ``number``: 0 for the first axis of the plane, 1 for the second.
    ``offset_mm``: position of the circle's centre on the screw.
    ``correction_mm``, (n,): added to the position that the loop follows, as an offset of the encoder is: nothing of it
    is fed forward.
    """
    values = _vector(axis, offset_mm)
    added = np.zeros_like(command.phase_rad) if correction_mm is None else correction_mm
    along, sideways, encoder = _drive_kernel(
        command.position_mm[number],
        command.velocity_mm_s[number],
        command.acceleration_mm_s2[number],
        np.ascontiguousarray(added),
        values,
    )
    bow = _bow_mm(command.position_mm[number], axis.bow_um)
    return Driven(along, sideways + bow, encoder)


def _bow_mm(position_mm: Floats, bow_um: float) -> Floats:
    """Return the height of a guideway that is bent to a circular arc."""
    if bow_um == 0.0:
        return np.zeros_like(position_mm)
    rise = bow_um / UM_PER_MM
    bend_mm = (100.0**2 + rise**2) / (2.0 * abs(rise))
    return np.asarray(np.sign(rise) * (bend_mm - np.sqrt(bend_mm**2 - position_mm**2)))


def _vector(a: AxisParameters, offset_mm: float) -> Floats:
    return np.array(
        [
            a.position_gain_1_s,
            a.velocity_gain_1_s,
            a.integral_time_ms / 1000.0,
            a.feed_forward,
            a.play_um / UM_PER_MM,
            a.play_taper_um / UM_PER_MM / 100.0,
            a.play_curve_um / UM_PER_MM / 1e4,
            a.lateral_um / UM_PER_MM,
            a.lateral_taper_um / UM_PER_MM / 100.0,
            a.lateral_travel_mm,
            a.friction_mm_s2,
            a.presliding_mm,
            a.stribeck_mm_s2,
            a.stribeck_mm_s,
            a.pitch_error_um / UM_PER_MM,
            a.pitch_mm,
            a.pitch_phase_rad,
            a.pitch_flank_um / UM_PER_MM,
            2.0 * np.pi * a.mode_hz,
            a.mode_damping,
            a.mode_share,
            a.breakaway_mm,
            offset_mm,
        ]
    )


@kernel
def _drive_kernel(
    command: Floats, speed: Floats, acceleration: Floats, added: Floats, p: Floats
) -> tuple[Floats, Floats, Floats]:
    """Step the servo loop, friction, screw, play, carriage and structure of one axis."""
    kv, kp, ti, forward = p[0], p[1], p[2], p[3]
    play, play_slope, play_curve = p[4], p[5], p[6]
    side, side_slope, side_travel = p[7], p[8], p[9]
    friction, presliding, extra, fading = p[10], p[11], p[12], p[13]
    wave, pitch, phase, flank = p[14], p[15], p[16], p[17]
    omega, damping, share, breakaway, offset = p[18], p[19], p[20], p[21], p[22]
    dt = STEP_S
    n = command.shape[0]
    along, sideways, encoder = np.empty(n), np.empty(n), np.empty(n)
    lag, lag_speed, integral = 0.0, 0.0, 0.0
    grip, contact, carriage = 0.0, 0.0, 0.0
    table = command[0]
    bent, bent_speed = 0.0, 0.0
    before = 0.0
    for i in range(n):
        # Motor, as its lag behind the command, so that small errors keep their digits.
        moving = speed[i] - lag_speed
        sense = 1.0 if moving >= 0.0 else -1.0
        travel = abs(moving) * dt
        grip = sense + (grip - sense) * np.exp(-travel / presliding)
        held = grip * (friction + extra * np.exp(-((moving / fading) ** 2)))
        wanted = kv * lag - (1.0 - forward) * speed[i]
        miss = wanted + lag_speed
        if ti > 0.0:
            integral += kp / ti * miss * dt
        lag_speed += dt * (held - kp * miss - integral)
        lag += dt * lag_speed
        lag += added[i] - (added[i - 1] if i > 0 else 0.0)
        motor = command[i] + added[i] - lag
        encoder[i] = added[i] - lag
        # Screw.
        contact = sense + (contact - sense) * np.exp(-travel / 0.02)
        turn = 2.0 * np.pi * (motor + offset) / pitch + phase
        nut = motor + wave * np.cos(turn) + flank * contact * np.cos(turn)
        # Lost motion: the table moves only when pushed.
        half = 0.5 * (play + play_slope * motor + play_curve * motor * motor)
        # A width below zero is a screw that winds up the other way round.
        pushed = max(nut - half, min(nut + half, table))
        table = pushed if half > 0.0 else nut - half * contact
        carriage = sense + (carriage - sense) * np.exp(-travel / side_travel)
        sideways[i] = 0.5 * (side + side_slope * motor) * carriage
        # Structure: bent by acceleration, struck when a stuck axis breaks away.
        if before * moving < 0.0:
            bent_speed += sense * np.sqrt(2.0 * abs(acceleration[i]) * breakaway)
        before = moving
        bent_speed -= dt * (2.0 * damping * omega * bent_speed + omega * omega * bent + share * acceleration[i])
        bent += dt * bent_speed
        along[i] = table + bent - command[i]
    return along, sideways, encoder
