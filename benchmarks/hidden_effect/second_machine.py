"""A second machine with a ball bar, made of other mechanisms than the virtual mill.

Of dtwin it uses only the records of runs: it shares no code and no formula with ``dtwin.physics`` or
``dtwin.machines``. ``second_faults`` says what can be wrong with it. Two axes are followed at 4 kHz: a set
point that is smoothed, a cascade of loops with a delay and a slow current loop, friction of elements that
slip one after the other (Maxwell) and falls with speed (Tustin), stop operators for what is lost at
reversals, a lead table for each screw, a loose mass that knocks against the carriage after a reversal, and
a frame that swings. The bar starts when the tool passes the start angle, a quarter turn after the machine
began to move.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import product
from typing import NamedTuple

import numpy as np
from numba import njit

from dtwin.schema import Campaign, Direction, Floats, Run, RunMeta

_STEP_S = 1.0 / 4000.0
_BEGUN = datetime(2026, 5, 4, 7, tzinfo=UTC)
_HANDLING_S, _RAMP_S, _TAIL_S = 45.0, 0.25, 0.1
_SAMPLES, _CLOCK_S = 1080, 0.001
_CENTRE_MM, _ZERO_UM = 0.03, 5.0
# Travel at which each element of friction slips, as a share of the longest, and its share of the force.
_SLIPS = np.array([[0.1, 0.25, 0.5, 1.0], [0.3, 0.3, 0.25, 0.15]])
# What a lead table covers on each side of the middle.
HALF_TRAVEL_MM = 220.0
_STRAIGHT_OVER_MM = 150.0


class Axis(NamedTuple):
    """What is wrong with an axis: lengths in mm, times in s, friction in mm/s² of the mass it holds."""

    smoothing_s: float = 0.0005
    integral_s: float = 0.0
    friction: float = 0.0
    static_share: float = 0.0
    fading_mm_s: float = 5.0
    slip_mm: float = 0.005
    play: float = 0.0
    play_slope: float = 0.0
    aside: float = 0.0
    aside_slope: float = 0.0
    aside_travel: float = 0.005
    scale: float = 0.0
    bow: float = 0.0
    bow_cubic: float = 0.0
    lead: float = 0.0
    flank: float = 0.0
    entry_mm: float = 1.0
    mode_hz: float = 20.0
    damping: float = 0.05
    swing: float = 0.0
    knock: float = 0.0
    gap: float = 0.0004


_NO_TABLE = np.zeros(2)


@dataclass(frozen=True)
class Machine:
    """Two axes, the lead tables of their screws, and the angle between them less a right one, in rad."""

    axes: tuple[Axis, Axis] = (Axis(), Axis())
    tables: tuple[Floats, Floats] = (_NO_TABLE, _NO_TABLE)
    lean: float = 0.0

    def with_axis(self, axis: str, **changed: float) -> Machine:
        """Return the machine with other numbers of an axis."""
        axes = [a._replace(**changed) if letter == axis else a for letter, a in zip("XY", self.axes, strict=True)]
        return replace(self, axes=(axes[0], axes[1]))

    def axis(self, axis: str) -> Axis:
        """Return an axis."""
        return self.axes["XY".index(axis)]


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, by the name that is right, with its size in µm (or ms) still open.

    ``also`` are names of a part of it that is too small to be asked for.
    """

    label: str
    change: Callable[[Machine, float], Machine]
    signed: bool = True
    start: float = 1.0
    also: tuple[str, ...] = ()


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _followed(place: Floats, speed: Floats, a: Axis, table: Floats) -> tuple[Floats, Floats]:
    """Return how far an axis is off along and aside, in mm, at each step."""
    kv, kp, current_s, dt = 40.0, 250.0, 0.0008, _STEP_S
    n = place.size
    along, aside = np.empty(n), np.empty(n)
    keep = np.exp(-dt / a.smoothing_s)
    late, err, rate, force, integral = 0.0, 0.0, 0.0, 0.0, 0.0
    # What the control knows is one step old.
    seen, seen_rate = 0.0, 0.0
    strain = np.zeros(_SLIPS.shape[1])
    nut, side, flank = 0.0, 0.0, 0.0
    swung, swing_rate, omega = 0.0, 0.0, 2.0 * np.pi * a.mode_hz
    loose, pushed = place[0], 0.0
    before = speed[0]
    for i in range(n):
        late = late * keep + speed[i] * a.smoothing_s * (1.0 - keep)
        smooth = late / a.smoothing_s
        wanted = kp * (kv * seen + seen_rate)
        if a.integral_s > 0.0:
            integral += wanted * dt / a.integral_s
        force += (wanted + integral - force) * dt / current_s
        moving = smooth - rate
        way = moving * dt
        held = 0.0
        for k in range(strain.size):
            limit = a.slip_mm * _SLIPS[0, k]
            strain[k] = min(max(strain[k] + way, -limit), limit)
            held += _SLIPS[1, k] * strain[k] / limit
        held *= a.friction * (1.0 + a.static_share * np.exp(-abs(moving) / a.fading_mm_s))
        seen, seen_rate = err, rate
        rate += dt * (held - force)
        err += dt * rate
        motor = place[i] - late - err
        # Lost motion: from one flank to the other over the play itself.
        nut = min(max(nut + 2.0 * way / max(abs(a.play), 0.003), -1.0), 1.0)
        flank = min(max(flank + 2.0 * way / 0.01, -1.0), 1.0)
        side = min(max(side + 2.0 * way / a.aside_travel, -1.0), 1.0)
        at = (motor + HALF_TRAVEL_MM) / a.entry_mm
        j = min(max(int(at), 0), table.size - 2)
        read = table[j] + (at - j) * (table[j + 1] - table[j])
        # A loose mass is taken along when its gap has closed, with a knock.
        if abs(motor - loose) > 0.5 * a.gap:
            sense = 1.0 if motor > loose else -1.0
            if sense != pushed:
                swing_rate -= a.knock * moving
                pushed = sense
            loose = motor - sense * 0.5 * a.gap
        pull = (smooth - before) / dt - held + force
        before = smooth
        swing_rate -= dt * (2.0 * a.damping * omega * swing_rate + omega**2 * swung + a.swing * pull)
        swung += dt * swing_rate
        along[i] = (
            motor * (1.0 + a.scale)
            + (a.lead + a.flank * flank) * read
            - 0.5 * (a.play + a.play_slope * motor) * nut
            + swung
        )
        part = motor / 100.0
        third = part * (part**2 - 0.6 * (_STRAIGHT_OVER_MM / 100.0) ** 2)
        aside[i] = a.bow * (part**2 + a.bow_cubic * third)
        aside[i] += 0.5 * (a.aside + a.aside_slope * motor) * side
    return along, aside


@dataclass(frozen=True)
class Bench:
    """Which circles are measured; every feed and direction in each block of repeats.

    ``paired``: each radius has a feed of its own.
    """

    radii_mm: tuple[float, ...]
    feeds_mm_min: tuple[float, ...]
    repeats: int = 3
    paired: bool = False

    @property
    def circles(self) -> list[tuple[float, float, float]]:
        """Radius, feed in mm/s and sense (+1 counter-clockwise) of each distinct circle."""
        pairs = (
            zip(self.radii_mm, self.feeds_mm_min, strict=True)
            if self.paired
            else product(self.radii_mm, self.feeds_mm_min)
        )
        return [(radius, feed / 60.0, sense) for radius, feed in pairs for sense in (1.0, -1.0)]

    def sized(self, fault: Fault, wanted_um: float) -> float:
        """Return the size at which a fault alone shows with an RMS of ``wanted_um``, set-up taken out."""
        sound, size = self._shown(Machine()), fault.start
        power, last = 1.0, (0.0, 0.0)
        for _ in range(8):
            seen = self._shown(fault.change(Machine(), size)) - sound
            reached = float(np.sqrt((seen**2).mean()))
            if abs(reached / wanted_um - 1.0) < 0.02:
                return size
            if last[0] > 0.0:
                # A lag costs radius with its square.
                power = float(np.clip(np.log(reached / last[1]) / np.log(size / last[0]), 0.5, 2.5))
            last = size, reached
            size *= (wanted_um / reached) ** (1.0 / power)
        raise ValueError(f"{fault.label} cannot be made to show {wanted_um:.2f} µm in this design")

    def _shown(self, machine: Machine) -> Floats:
        """Return what a bar without noise shows by degree, shape (circles, 360); no centre, no zero."""
        angle = np.radians(np.arange(360) + 0.5)
        shown = []
        for radius, feed, sense in self.circles:
            ball = moved(machine, radius, feed, sense)
            seen = (1e3 * (np.hypot(*ball(_even(0.5))) - radius)).reshape(360, -1).mean(axis=1)
            shown.append(seen if sense > 0.0 else seen[::-1])
        out = np.array(shown)
        shapes = np.stack([np.ones(360), np.cos(angle), np.sin(angle)])
        for radius in self.radii_mm:
            here = [r == radius for r, _, _ in self.circles]
            weights = shapes @ out[here].mean(axis=0) / (shapes**2).sum(axis=1)
            out[here] -= weights @ shapes
        return out

    def measured(self, machine: Machine, noise_um: float, rng: np.random.Generator) -> tuple[Campaign, list[Run]]:
        """Return a session; each radius is one set-up of the bar."""
        runs: list[Run] = []
        clock_s = 0.0
        for radius in self.radii_mm:
            paths = {c: moved(machine, *c) for c in self.circles if c[0] == radius}
            centre, zero = rng.uniform(-_CENTRE_MM, _CENTRE_MM, (2, 1)), _ZERO_UM * rng.normal()
            for repeat in range(1, self.repeats + 1):
                for i in rng.permutation(len(paths)):
                    (_, feed, sense), ball = list(paths.items())[i]
                    # The start lies somewhere between two readings of the bar's clock.
                    late_s = _CLOCK_S * rng.uniform(-0.5, 0.5)
                    at = ball(_even(0.5) + late_s * feed / (2.0 * np.pi * radius))
                    length_um = 1e3 * (np.hypot(*(at - centre)) - radius) + zero
                    length_um += _noise(noise_um, rng)
                    name = f"r{len(runs) + 1:03d}"
                    runs.append(_run(name, (radius, feed, sense), repeat, clock_s, length_um, rng))
                    clock_s += 2.0 * np.pi * radius / feed + _HANDLING_S
        return Campaign("second", "second-machine", started=_BEGUN.isoformat()), runs


def moved(machine: Machine, radius_mm: float, feed_mm_s: float, sense: float) -> Callable[[Floats], Floats]:
    """Return where the ball is in the plane, shape (2, n), n shares of a turn after the bar starts."""
    rate = feed_mm_s / radius_mm
    turn_s = 2.0 * np.pi / rate
    t_s = np.arange(int((1.25 * turn_s + _RAMP_S + 2.0 * _TAIL_S) / _STEP_S)) * _STEP_S
    # The feed comes up smoothly, along the arc that is cut off.
    share = np.minimum(t_s / _RAMP_S, 1.0)
    gone = _RAMP_S * (share**3 - 0.5 * share**4) + np.maximum(t_s - _RAMP_S, 0.0)
    pace = rate * (3.0 * share**2 - 2.0 * share**3)
    angle = sense * (rate * gone - 0.5 * np.pi)
    x, y = radius_mm * np.cos(angle), radius_mm * np.sin(angle)
    first, pushes_second = _followed(x, -sense * pace * y, machine.axes[0], machine.tables[0])
    second, pushes_first = _followed(y, sense * pace * x, machine.axes[1], machine.tables[1])
    first, second = first + pushes_first, second + pushes_second
    first, second = first - np.sin(machine.lean) * second, np.cos(machine.lean) * second
    # The bar knows how far the tool has come, not what was commanded.
    passed = sense * np.unwrap(np.arctan2(second, first))
    passed -= 2.0 * np.pi * np.round((passed[0] + 0.5 * np.pi) / (2.0 * np.pi))
    start_s = float(np.interp(0.0, passed, t_s))

    def ball(shares: Floats) -> Floats:
        at_s = start_s + turn_s * shares
        return np.stack([np.interp(at_s, t_s, first), np.interp(at_s, t_s, second)])

    return ball


def _even(phase: float) -> Floats:
    return (np.arange(_SAMPLES) + phase) / _SAMPLES


def _noise(rms_um: float, rng: np.random.Generator) -> Floats:
    """Return what repeats disagree by: reading, a floor that shakes, a slow wander, and the bar's zero."""
    share = _even(0.5)
    shaking = np.cos(2.0 * np.pi * (rng.uniform(20.0, 120.0) * share + rng.random()))
    # Alike all round: a walk that is closed is quietest at the ends of the turn.
    order = np.arange(1, 25)
    waves = rng.standard_normal((2, order.size)) / order
    turns = 2.0 * np.pi * np.outer(order, share)
    wander = waves[0] @ np.cos(turns) + waves[1] @ np.sin(turns)
    wander /= np.sqrt((1.0 / order**2).sum())
    parts = [1.5 * rng.standard_normal(_SAMPLES), shaking, wander, rng.normal()]
    weights = np.array([0.6, 0.3, 0.7, 0.2])
    weights *= rms_um / np.linalg.norm(weights)
    return sum((w * p for w, p in zip(weights, parts, strict=True)), np.zeros(_SAMPLES))


def _run(
    name: str,
    circle: tuple[float, float, float],
    repeat: int,
    clock_s: float,
    length_um: Floats,
    rng: np.random.Generator,
) -> Run:
    radius, feed, sense = circle
    turn_s = 2.0 * np.pi * radius / feed
    way: Direction = "CCW" if sense > 0.0 else "CW"
    meta = RunMeta(
        name,
        plane="XY",
        direction=way,
        radius_mm=radius,
        feed_mm_min=round(60.0 * feed, 6),
        repeat=repeat,
        setup=f"bar{radius:g}",
        sample_rate_hz=_SAMPLES / turn_s,
        started=(_BEGUN + timedelta(seconds=clock_s)).isoformat(),
        covariates={"temperature_c": 20.0 + 0.05 * rng.normal()},
    )
    return Run(
        meta,
        {
            "t_s": turn_s * np.arange(_SAMPLES) / _SAMPLES,
            "angle_deg": sense * 360.0 * _even(0.5),
            "deviation_um": length_um,
        },
    )
