"""One axis of the outside examiner's machine, followed in time.

No code and no formula is shared with dtwin. A set point comes each millisecond; a position loop with feed
forward of speed and acceleration drives a speed loop with an integral and a slow current. Motor and screw are
one mass, the table is another; a screw of finite stiffness, with play, a scale and a wave, lies between them.
Both masses rub: friction that first gives way like a spring (presliding), then slips, and falls with speed.
The table may carry a frame that swings. Inside: m, N, s; given and returned: mm and mm/s.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from dtwin.schema import Floats

STEP_S = 1e-4
RUN_IN_TURNS = 0.5
_SET_EVERY = 10  # steps: one set point a millisecond
_RAMP_S, _TAIL_RAD = 0.25, 0.25
_MOTOR_KG, _TABLE_KG = 1400.0, 450.0
_STIFFNESS_N_M = 2.5e8
_DAMPING_S = 1e-3  # of the screw: force per speed, as a share of the stiffness
_SPEED_LOOP_1_S, _INTEGRAL_S, _CURRENT_S = 320.0, 0.02, 0.0006
_WORN_WIDTH_M = 0.06
_CONTACT_M = 0.12e-6  # over which a flank takes hold
_BENDS_FROM = 0.3  # share of the presliding up to which friction is a spring alone


class Axis(NamedTuple):
    """What an axis is like: lengths in m, forces in N, speeds in m/s, times in s, angles in rad."""

    loop_1_s: float = 55.0
    speed_forward: float = 1.0
    acceleration_forward: float = 1.0
    play_m: float = 0.0
    worn: float = 0.0
    worn_at_m: float = 0.0
    table_n: float = 4.0
    screw_n: float = 4.0
    preslide_m: float = 3e-6
    static_share: float = 0.3
    fading_m_s: float = 0.002
    scale: float = 0.0
    wave_m: float = 0.0
    pitch_m: float = 0.010
    wave_phase: float = 0.0
    wave_second: float = 0.0
    mode_rad_s: float = 200.0
    mode_damping: float = 0.04
    mode_share: float = 0.0


@lru_cache(maxsize=16)
def moved(
    axis: Axis, centre_mm: float, radius_mm: float, feed_mm_min: float, sense: float, upright: bool
) -> tuple[Floats, Floats]:
    """Return place about the centre (mm) and speed (mm/s) of an axis at each step of a circle, shape (n,).

    Args:
        sense: +1 counter-clockwise, -1 clockwise.
        upright: Whether it is the second axis of the plane, which follows the sine.
    """
    angle = path(radius_mm, feed_mm_min, sense)
    turned = angle if upright else angle + 0.5 * np.pi
    place, speed = _followed(np.sin(turned), 1e-3 * centre_mm, 1e-3 * radius_mm, axis)
    return 1e3 * place - centre_mm, 1e3 * speed


def path(radius_mm: float, feed_mm_min: float, sense: float) -> Floats:
    """Return the commanded angle at each step, rad, shape (n,): a run-in that ends at 0, one turn and a bit."""
    rate = feed_mm_min / 60.0 / radius_mm
    total_s = _RAMP_S + (2.0 * np.pi * (RUN_IN_TURNS + 1.0) + _TAIL_RAD) / rate
    time_s = np.arange(int(total_s / STEP_S) + 1) * STEP_S
    pace = rate * np.where(time_s < _RAMP_S, 0.5 - 0.5 * np.cos(np.pi * time_s / _RAMP_S), 1.0)
    gone: Floats = np.cumsum(pace) * STEP_S
    return sense * (gone - 2.0 * np.pi * RUN_IN_TURNS)


@njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _strained(strain_m: float, speed: float, limit_m: float) -> float:
    """Return the strain of a friction contact one step later."""
    slips = 0.0
    if strain_m * speed > 0.0:
        part = abs(strain_m) / limit_m
        if part >= 1.0:
            slips = 1.0
        elif part > _BENDS_FROM:
            slips = 0.5 - 0.5 * math.cos(math.pi * (part - _BENDS_FROM) / (1.0 - _BENDS_FROM))
    return strain_m + speed * (1.0 - slips * abs(strain_m) / limit_m) * STEP_S


@njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _lead_m(place: float, centre: float, a: Axis) -> float:
    """Return what the screw adds to a place: a scale about the centre, and a wave with its second harmonic."""
    turn = 2.0 * math.pi * place / a.pitch_m
    wave = math.sin(turn + a.wave_phase) + a.wave_second * math.cos(2.0 * turn)
    return a.scale * (place - centre) + a.wave_m * wave


@njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _screw_force(stretch: float, closing: float, table_at: float, a: Axis) -> float:
    """Return the force of the screw on the table, N; with play, none between the flanks."""
    damping = _STIFFNESS_N_M * _DAMPING_S * closing
    if a.play_m <= 2e-9:
        return _STIFFNESS_N_M * stretch + damping
    half = 0.5 * a.play_m * (1.0 + a.worn * math.exp(-(((table_at - a.worn_at_m) / _WORN_WIDTH_M) ** 2)))
    over = abs(stretch) - half
    pressed = 0.5 * (over + math.sqrt(over * over + _CONTACT_M * _CONTACT_M))
    return math.copysign(_STIFFNESS_N_M * pressed, stretch) + damping * pressed / (pressed + _CONTACT_M)


@njit(fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _followed(swing: Floats, centre: float, amplitude: float, a: Axis) -> tuple[Floats, Floats]:
    """Return place and speed of the tool, m and m/s, for commands ``centre + amplitude * swing``, shape (n,)."""
    places, speeds = np.empty(swing.size), np.empty(swing.size)
    mass = _MOTOR_KG + _TABLE_KG
    gain = mass * _SPEED_LOOP_1_S
    period = _SET_EVERY * STEP_S
    motor = set_point = centre + amplitude * swing[0]
    table = motor + _lead_m(motor, centre, a)
    motor_speed = table_speed = set_speed = 0.0
    wanted_speed = ahead = integral = force = 0.0
    screw_strain = table_strain = 0.0
    bent = bent_speed = 0.0
    for i in range(swing.size):
        if i % _SET_EVERY == 0 and i > 0:
            new = centre + amplitude * swing[i]
            rate = (new - set_point) / period
            wanted_speed = a.loop_1_s * (set_point - motor) + a.speed_forward * rate
            ahead = a.acceleration_forward * mass * (rate - set_speed) / period
            set_point, set_speed = new, rate
        late = wanted_speed - motor_speed
        integral += gain / _INTEGRAL_S * late * STEP_S
        force += (gain * late + integral + ahead - force) * STEP_S / _CURRENT_S
        limit = a.preslide_m * (1.0 + a.static_share * math.exp(-abs(motor_speed) / a.fading_m_s))
        screw_strain = _strained(screw_strain, motor_speed, limit)
        limit = a.preslide_m * (1.0 + a.static_share * math.exp(-abs(table_speed) / a.fading_m_s))
        table_strain = _strained(table_strain, table_speed, limit)
        stretch = motor + _lead_m(motor, centre, a) - table
        held = _screw_force(stretch, motor_speed - table_speed, table, a)
        table_pull = (held - a.table_n / a.preslide_m * table_strain) / _TABLE_KG
        motor_speed += (force - a.screw_n / a.preslide_m * screw_strain - held) / _MOTOR_KG * STEP_S
        table_speed += table_pull * STEP_S
        motor += motor_speed * STEP_S
        table += table_speed * STEP_S
        back = 2.0 * a.mode_damping * a.mode_rad_s * bent_speed + a.mode_rad_s**2 * bent
        bent_speed -= (back + a.mode_share * table_pull) * STEP_S
        bent += bent_speed * STEP_S
        places[i] = table + bent
        speeds[i] = table_speed
    return places, speeds
