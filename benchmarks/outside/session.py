"""A session of the outside machine with a ball bar: circles, what the bar reads, and what each fault makes of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from drives import RUN_IN_TURNS, STEP_S, Axis, moved
from faults import PLANES, Design, Fault, Motion
from numba import njit

from dtwin.schema import Campaign, Direction, Floats, Plane, Run, RunMeta

_BEGUN = datetime(2026, 3, 2, 8, tzinfo=UTC)
_SETTING_UP_MIN, _HANDLING_S, _RUN_IN_SHARE = 4.0, 12.0, 1.5
_CENTRE_UM, _ZERO_UM = 12.0, 1.5
_RATES_HZ, _SAMPLES = (100, 200, 250, 500, 1000), 1500
_WANDER_S = 0.03
_DIRECTIONS: tuple[Direction, ...] = ("CCW", "CW")
_PITCH_M: Mapping[str, float] = {"X": 0.010, "Y": 0.012, "Z": 0.008}


@dataclass(frozen=True)
class Circle:
    """One circle of a session; ``minute`` is when it begins."""

    plane: Plane
    radius_mm: float
    feed_mm_min: float
    direction: Direction
    repeat: int
    minute: float

    @property
    def setup(self) -> str:
        """Name of the mounting of the bar."""
        return f"{self.plane}{self.radius_mm:g}"

    @property
    def turn_s(self) -> float:
        """Duration of a turn."""
        return 2.0 * math.pi * self.radius_mm / (self.feed_mm_min / 60.0)

    @property
    def sense(self) -> float:
        """+1 counter-clockwise."""
        return 1.0 if self.direction == "CCW" else -1.0


@dataclass(frozen=True)
class Machine:
    """A machine: where the circles have their middle, the friction of each contact, and what is wrong."""

    centre_mm: Mapping[str, float]
    rubbing_n: float
    faults: tuple[Fault, ...]

    def axis(self, letter: str, minute: float) -> Axis:
        """Return the drive of an axis at a minute of the session."""
        out = Axis(pitch_m=_PITCH_M[letter], table_n=self.rubbing_n, screw_n=self.rubbing_n)
        # The guideway that holds a table with play holds it whatever else it rubs with.
        for fault in sorted(self.faults, key=lambda fault: fault.kind == "backlash"):
            if fault.axis in (letter, ""):
                out = fault.drive(out, minute)
        return out

    def without(self, fault: Fault) -> Machine:
        """Return the machine with one fault less."""
        return Machine(self.centre_mm, self.rubbing_n, tuple(f for f in self.faults if f is not fault))


def circles(design: Design) -> Iterator[Circle]:
    """Yield the circles of a session in their order."""
    minute = 0.0
    for plane in design.planes:
        for radius in design.radii_mm:
            minute += _SETTING_UP_MIN
            for feed in design.feeds_mm_min:
                for repeat in range(1, design.repeats + 1):
                    for direction in _DIRECTIONS:
                        circle = Circle(plane, radius, feed, direction, repeat, minute)
                        yield circle
                        minute += (_RUN_IN_SHARE * circle.turn_s + _HANDLING_S) / 60.0


def read(
    machine: Machine, circle: Circle, centre_um: Sequence[float] = (0.0, 0.0), late: float = 0.0
) -> tuple[Floats, Floats, Floats]:
    """Return times (s), signed nominal angles (deg) and readings without noise (µm), each of shape (n,).

    Args:
        centre_um: How far the middle of the bar lies off that of the circle, in the two axes of the plane.
        late: How late the first reading comes, as a share of the time between two.
    """
    letters = PLANES[circle.plane]
    radius, sense = circle.radius_mm, circle.sense
    place: dict[str, Floats] = {}
    speed: dict[str, Floats] = {}
    for letter in letters:
        drive = machine.axis(letter, circle.minute)
        upright = letter == letters[1]
        place[letter], speed[letter] = moved(
            drive, machine.centre_mm[letter], radius, circle.feed_mm_min, sense, upright
        )
    first, second = (place[letter] for letter in letters)
    time_s: Floats = np.arange(first.size, dtype=np.float64) * STEP_S
    minute: Floats = circle.minute + time_s / 60.0
    motion = Motion(place, speed, minute, radius)
    aside = {letter: np.zeros(first.size) for letter in "XYZ"}
    for fault in machine.faults:
        for letter, pushed in fault.push(motion).items():
            aside[letter] += pushed
    off = [1e-3 * (aside[letter] + c) for letter, c in zip(letters, centre_um, strict=True)]
    reading = 1e3 * (np.hypot(first + off[0], second + off[1]) - radius)
    # The bar starts when the axes pass the start angle, and goes by time from there.
    passed = sense * np.unwrap(np.arctan2(second, first))
    passed -= passed[0] + 2.0 * np.pi * RUN_IN_TURNS
    begun = int(np.argmax(passed >= 0.0))
    start_s = time_s[begun - 1] - passed[begun - 1] / (passed[begun] - passed[begun - 1]) * STEP_S
    rate = next((r for r in _RATES_HZ if r * circle.turn_s >= _SAMPLES), _RATES_HZ[-1])
    since_s = (late + np.arange(int(circle.turn_s * rate) + 1)) / rate
    return since_s - since_s[0], sense * 360.0 * since_s / circle.turn_s, np.interp(start_s + since_s, time_s, reading)


def measured(
    machine: Machine, design: Design, noise_um: float, name: str, rng: np.random.Generator
) -> tuple[Campaign, list[Run]]:
    """Return a session with noise."""
    runs: list[Run] = []
    bars: dict[str, Floats] = {}
    for circle in circles(design):
        bar = bars.setdefault(circle.setup, rng.normal(size=3) * (_CENTRE_UM, _CENTRE_UM, _ZERO_UM))
        time_s, angle_deg, reading = read(machine, circle, bar[:2].tolist(), rng.uniform())
        reading = reading + bar[2] + _noise(time_s, angle_deg, noise_um, rng)
        minute = circle.minute
        meta = RunMeta(
            f"r{len(runs) + 1:03d}",
            plane=circle.plane,
            direction=circle.direction,
            radius_mm=circle.radius_mm,
            feed_mm_min=circle.feed_mm_min,
            repeat=circle.repeat,
            setup=circle.setup,
            sample_rate_hz=1.0 / time_s[1],
            started=(_BEGUN + timedelta(minutes=minute)).isoformat(),
            covariates={
                "air_temperature_c": 20.5 + 0.01 * minute + 0.05 * rng.normal(),
                "spindle_temperature_c": 22.0 + 3.0 * (1.0 - math.exp(-minute / 25.0)) + 0.1 * rng.normal(),
            },
        )
        runs.append(Run(meta, {"t_s": time_s, "angle_deg": angle_deg, "deviation_um": reading}))
    return Campaign(name, f"mc-{name}", started=_BEGUN.isoformat(), instrument={"model": "ball bar"}), runs


def _noise(time_s: Floats, angle_deg: Floats, rms_um: float, rng: np.random.Generator) -> Floats:
    """Return noise of one run, µm: white, a wander of 30 ms, three slow waves and the zero."""
    keep = math.exp(-time_s[1] / _WANDER_S)
    pushed = math.sqrt(1.0 - keep**2) * rng.normal(size=time_s.size)
    out: Floats = math.sqrt(0.65) * rng.normal(size=time_s.size)
    out += math.sqrt(0.35) * _wandering(pushed, keep, rng.normal())
    for order in (1, 2, 3):
        turn = np.radians(order * angle_deg)
        out += 0.15 * (rng.normal() * np.cos(turn) + rng.normal() * np.sin(turn))
    return rms_um * (out + 0.3 * rng.normal())


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _wandering(pushed: Floats, keep: float, start: float) -> Floats:
    out = np.empty(pushed.size)
    now = start
    for i in range(pushed.size):
        now = keep * now + pushed[i]
        out[i] = now
    return out


def left_out_um(machine: Machine, design: Design) -> list[float]:
    """Return how much each fault makes beside all others, RMS, centre and radius of a set-up taken out.

    In each plane: the slowest and the fastest feed at the largest radius, early and late in its set-up, and the
    fastest at the smallest.
    """
    looks = _looks(list(circles(design)))
    shown: list[list[Floats]] = [[] for _ in machine.faults]
    for look in looks:
        whole = _by_degree(machine, look)
        for fault, out in zip(machine.faults, shown, strict=True):
            out.append(whole - _by_degree(machine.without(fault), look))
    setups = [look.setup for look in looks]
    return [_beside_setup(setups, out) for out in shown]


def _looks(session: Sequence[Circle]) -> list[Circle]:
    out: dict[tuple[str, float, float], Circle] = {}
    for setup in dict.fromkeys(circle.setup for circle in session):
        here = [circle for circle in session if circle.setup == setup]
        largest = here[0].radius_mm == max(c.radius_mm for c in session)
        smallest = here[0].radius_mm == min(c.radius_mm for c in session)
        chosen = [here[0], here[-1]] if largest else [here[-1]] if smallest else []
        out |= {(setup, c.feed_mm_min, c.minute): c for c in chosen}
    return list(out.values())


def _by_degree(machine: Machine, look: Circle) -> Floats:
    """Return readings of both directions by degree of angle, shape (2, 360)."""
    out = []
    for direction in _DIRECTIONS:
        circle = Circle(look.plane, look.radius_mm, look.feed_mm_min, direction, look.repeat, look.minute)
        _, angle_deg, reading = read(machine, circle)
        at = np.floor(angle_deg * circle.sense).astype(int) % 360
        mean = np.bincount(at, reading, 360) / np.bincount(at, minlength=360)
        out.append(mean[:: int(circle.sense)])
    return np.array(out)


def _beside_setup(setups: Sequence[str], shown: Sequence[Floats]) -> float:
    angle = np.radians(np.arange(360) + 0.5)
    shapes = np.stack([np.ones(360), np.cos(angle), np.sin(angle)])
    rest = []
    for setup in dict.fromkeys(setups):
        here = np.array([one for name, one in zip(setups, shown, strict=True) if name == setup])
        weights = shapes @ here.mean(axis=(0, 1)) / (shapes**2).sum(axis=1)
        rest.append((here - weights @ shapes).ravel())
    return float(np.sqrt((np.concatenate(rest) ** 2).mean()))
