"""What can be wrong with the outside slide that is told tones: stages in time, from the command to the probe, and their right names.

No code and no formula is shared with dtwin. A stage takes positions in µm, shape (n, tones), at the rate of the loop, and returns
positions; stages of one machine follow each other in the order of ``ORDER``. Each mechanism draws its own sizes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import bilinear, lfilter

from dtwin.schema import Floats

ORDER = ("loop", "friction", "scale", "lost", "structure", "time", "probe")
SEEN_BY_ENCODER = ORDER[:2]
_TURN = 2.0 * math.pi
_CURRENT_LOOPS = 12.0
_INNER_STEPS = 2
# A loop of discrete steps with a current that lags swings up at a higher rate, in rad a step.
_STABLE = 0.08

Stage = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Design:
    """Which tones are told, and how they are sampled.

    Attributes:
        frequency_hz, amplitude_um: Every frequency is told with every amplitude.
        loop_hz: Rate at which the machine is followed.
        rate_hz: Rate at which it is recorded.
        warm_s: Before the record begins; the tone grows in the first half of it.
    """

    frequency_hz: Floats
    amplitude_um: Floats
    repeats: int
    seconds: float
    rate_hz: float
    loop_hz: float
    noise_um: float
    at_random: bool
    warm_s: float

    @property
    def tones(self) -> Floats:
        """Frequency and amplitude of each tone, shape (tones, 2)."""
        return np.array([(hz, um) for hz in self.frequency_hz for um in self.amplitude_um])

    @property
    def time_s(self) -> Floats:
        """Times at which the machine is followed, shape (n,)."""
        return np.asarray(np.arange(int((self.warm_s + self.seconds) * self.loop_hz) + 8) / self.loop_hz - self.warm_s)

    @property
    def highest(self) -> float:
        """The highest frequency, rad/s."""
        return _TURN * float(self.frequency_hz.max())


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong, where it comes in the order of stages, and what it may be called."""

    kind: str
    where: str
    names: frozenset[str]
    consequences: frozenset[str]
    stage: Stage

    def __str__(self) -> str:
        return self.kind


Mechanism = Callable[[Design, np.random.Generator], Fault]


class _Rubbing(NamedTuple):
    """A friction that is worked through by way: sliders of several reaches, or one that loses force with speed.

    ``reach_um`` (k,): ways after which the sliders give, all of one size; empty for the other kind.
    """

    reach_um: NDArray[np.float64]
    size_um: float
    way_um: float
    viscous_s: float
    stiction: float
    speed_um_s: float


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _force(bent: Floats, moved: float, step_s: float, rub: _Rubbing) -> float:
    """Move the sliders on, in place, and return what they and the way make, as µm of static deflection."""
    if rub.reach_um.size:
        share = rub.size_um / rub.reach_um.size
        for k in range(rub.reach_um.size):
            bent[k] = min(max(bent[k] + share * moved / rub.reach_um[k], -share), share)
        return bent.sum() + rub.viscous_s * moved / step_s
    level = rub.size_um * (1.0 + rub.stiction * np.exp(-abs(moved / step_s) / rub.speed_um_s)) * np.sign(moved)
    bent[0] = level + (bent[0] - level) * np.exp(-abs(moved) / rub.way_um)
    return float(bent[0])


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _held(x: Floats, step_s: float, rate: float, damping: float, integral: float, rub: _Rubbing) -> Floats:
    """Return where a loop holds a slide that rubs."""
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        off, speed, kept, last = 0.0, 0.0, 0.0, x[0, c]
        bent = np.zeros(max(1, rub.reach_um.size))
        for i in range(x.shape[0]):
            force = _force(bent, x[i, c] + off - last, step_s, rub)
            last = x[i, c] + off
            kept += integral * off * step_s
            speed += step_s * (-2.0 * damping * rate * speed - rate * rate * (off + force) - kept)
            off += speed * step_s
            out[i, c] = x[i, c] + off
    return out


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _wound(x: Floats, step_s: float, rub: _Rubbing) -> Floats:
    """Return what is left of positions behind a part that friction winds up."""
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        bent = np.zeros(max(1, rub.reach_um.size))
        last = x[0, c]
        for i in range(x.shape[0]):
            out[i, c] = x[i, c] - _force(bent, x[i, c] - last, step_s, rub)
            last = x[i, c]
    return out


class _Loop(NamedTuple):
    """A position loop at discrete times; ``lag``: share of the current that comes within a step."""

    rate: float
    damping: float
    integral: float
    speed_forward: float
    acceleration_forward: float
    lag: float
    limit: float


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _looped(x: Floats, speed: Floats, acceleration: Floats, step_s: float, loop: _Loop) -> Floats:
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        y, v, asked, current, kept = x[0, c], 0.0, 0.0, 0.0, 0.0
        for i in range(x.shape[0]):
            off = x[i, c] - y
            kept += loop.integral * off * step_s
            wanted = loop.rate**2 * off + kept + loop.acceleration_forward * acceleration[i, c]
            wanted += 2.0 * loop.damping * loop.rate * (loop.speed_forward * speed[i, c] - v)
            wanted = min(max(wanted, -loop.limit), loop.limit)
            # What was asked in the step before is what the current follows.
            current += loop.lag * (asked - current)
            asked = wanted
            v += current * step_s
            y += v * step_s
            out[i, c] = y
    return out


class _Spring(NamedTuple):
    """A tool on a spring: its damping grows with speed over ``speed_um_s``, its stiffness with stretch over ``stretch_um``."""

    rate: float
    damping: float
    more_damping: float
    speed_um_s: float
    stiffening: float
    stretch_um: float


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _swung(x: Floats, step_s: float, spring: _Spring) -> Floats:
    h = step_s / _INNER_STEPS
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        y, v, before = x[0, c], 0.0, x[0, c]
        for i in range(x.shape[0]):
            slide_v = (x[i, c] - before) / step_s
            for k in range(_INNER_STEPS):
                stretch = before + (x[i, c] - before) * (k + 1) / _INNER_STEPS - y
                away = slide_v - v
                damped = 2.0 * spring.damping * spring.rate * away
                more = 1.0 + spring.more_damping * np.sqrt(abs(away) / spring.speed_um_s)
                stiffer = 1.0 + spring.stiffening * abs(stretch) / spring.stretch_um
                v += h * (spring.rate**2 * stretch * stiffer + damped * more)
                y += h * v
            before = x[i, c]
            out[i, c] = y
    return out


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _played(x: Floats, play_um: float) -> Floats:
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        y = x[0, c]
        for i in range(x.shape[0]):
            y = min(max(y, x[i, c] - 0.5 * play_um), x[i, c] + 0.5 * play_um)
            out[i, c] = y
    return out


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def _remembered(x: Floats, share: float, reach_um: Floats) -> Floats:
    """Return how a drive follows that remembers where it turned: elements of several widths of play share in it."""
    out = np.empty_like(x)
    for c in range(x.shape[1]):
        at = np.zeros(reach_um.size)
        for i in range(x.shape[0]):
            for k in range(reach_um.size):
                at[k] = min(max(at[k], x[i, c] - reach_um[k]), x[i, c] + reach_um[k])
            out[i, c] = x[i, c] * (1.0 - share / 3.0) + share * at.mean()
    return out


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm lies evenly between two bounds."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _rubbing(d: Design, rng: np.random.Generator) -> _Rubbing:
    size, way = between(rng, 0.01, 0.15) * d.amplitude_um.min(), between(rng, 0.01, 0.3) * d.amplitude_um.min()
    if rng.random() < 0.5:
        spread, viscous = rng.uniform(0.3, 1.5), rng.choice([0.0, 1.0]) * rng.uniform(0.0, 0.003) / d.highest
        return _Rubbing(way * np.exp(np.linspace(-spread, spread, 6)), size, way, viscous, 0.0, 1.0)
    slow = 0.2 * _TURN * float(d.frequency_hz.min() * d.amplitude_um.max())
    return _Rubbing(np.zeros(0), size, way, 0.0, rng.uniform(0.0, 0.5), slow)


def _loop_stage(d: Design, loop: _Loop) -> Stage:
    def stage(x: Floats) -> Floats:
        speed = np.gradient(x, 1.0 / d.loop_hz, axis=0)
        return np.asarray(_looped(x, speed, np.gradient(speed, 1.0 / d.loop_hz, axis=0), 1.0 / d.loop_hz, loop))

    return stage


_LINEAR = frozenset(("servo_response", "tracking_delay", "structural_mode", "inertial_compliance"))


def servo_loop(d: Design, rng: np.random.Generator) -> Fault:
    rate = min(d.highest * rng.uniform(1.8, 5.0), _STABLE * d.loop_hz)
    damping, integral = rng.uniform(0.3, 0.9), float(rng.choice([0.0, 0.03])) * rate**3
    corner_hz = max(d.loop_hz / _CURRENT_LOOPS, 8.0 * d.highest / _TURN)
    lag = 1.0 - math.exp(-_TURN * corner_hz / d.loop_hz)
    loop = _Loop(rate, damping, integral, rng.uniform(0.7, 1.05), rng.uniform(0.0, 0.7), lag, math.inf)
    return Fault("servo loop", "loop", frozenset(["servo_response"]), _LINEAR, _loop_stage(d, loop))


def velocity_lag(d: Design, rng: np.random.Generator) -> Fault:
    kept = math.exp(-d.highest * rng.uniform(3.0, 15.0) / d.loop_hz)

    def stage(x: Floats) -> Floats:
        return np.asarray(lfilter([(1.0 - kept) / 2.0] * 2, [1.0, -kept], x - x[0], axis=0) + x[0])

    return Fault("velocity lag", "loop", frozenset(["tracking_delay", "servo_response"]), _LINEAR, stage)


def dead_time(d: Design, rng: np.random.Generator) -> Fault:
    late_s = between(rng, 0.004, 0.06) / d.highest
    also = frozenset(("servo_response", "inertial_compliance"))
    return Fault(
        "dead time",
        "time",
        frozenset(["tracking_delay"]),
        also,
        lambda x: np.asarray(CubicSpline(d.time_s, x)(d.time_s - late_s)),
    )


def mode(d: Design, rng: np.random.Generator) -> Fault:
    above = rng.uniform(1.5, 5.0)
    damping, more = rng.uniform(0.008, 0.06), float(rng.choice([0.0, 0.5, 2.0]))
    spring = _Spring(d.highest * above, damping, more, d.highest * float(d.amplitude_um.max()) / above**2, 0.0, 1.0)
    also = _LINEAR | {"stiffening_joint"} if more else _LINEAR
    return Fault(
        "mode",
        "structure",
        frozenset(["structural_mode"]),
        also,
        lambda x: np.asarray(_swung(x, 1.0 / d.loop_hz, spring)),
    )


def inertia(d: Design, rng: np.random.Generator) -> Fault:
    rate, damping, sign = (
        d.highest * rng.uniform(7.0, 15.0),
        rng.uniform(0.01, 0.05),
        float(rng.choice([1.0, 1.0, -1.0])),
    )
    b, a = bilinear([rate**2], [1.0, 2.0 * damping * rate, rate**2], d.loop_hz)

    def stage(x: Floats) -> Floats:
        return np.asarray(x + sign * (lfilter(b, a, x - x[0], axis=0) + x[0] - x))

    return Fault("inertia", "structure", frozenset(["inertial_compliance", "structural_mode"]), _LINEAR, stage)


def stiffening(d: Design, rng: np.random.Generator) -> Fault:
    above = rng.uniform(1.6, 3.0)
    damping, gain = rng.uniform(0.02, 0.08), rng.uniform(0.5, 3.0)
    spring = _Spring(d.highest * above, damping, 0.0, 1.0, gain, float(d.amplitude_um.max()) / above**2)
    # At one amplitude a joint that stiffens is a mode.
    names = frozenset(["stiffening_joint"] + (["structural_mode"] if d.amplitude_um.size == 1 else []))
    return Fault(
        "stiffening joint", "structure", names, _LINEAR, lambda x: np.asarray(_swung(x, 1.0 / d.loop_hz, spring))
    )


def friction(d: Design, rng: np.random.Generator) -> Fault:
    rub, rate = _rubbing(d, rng), d.highest * rng.uniform(1.5, 6.0)
    damping, integral = rng.uniform(0.3, 0.9), float(rng.choice([0.0, 0.0, 0.04])) * rate**3
    return Fault(
        "friction",
        "friction",
        frozenset(["guideway_friction"]),
        frozenset(("backlash", "tracking_delay")),
        lambda x: np.asarray(_held(x, 1.0 / d.loop_hz, rate, damping, integral, rub)),
    )


def windup(d: Design, rng: np.random.Generator) -> Fault:
    rub = _rubbing(d, rng)
    return Fault(
        "wind-up",
        "lost",
        frozenset(("backlash", "guideway_friction")),
        frozenset(("tracking_delay", "lead_error")),
        lambda x: np.asarray(_wound(x, 1.0 / d.loop_hz, rub)),
    )


def backlash(d: Design, rng: np.random.Generator) -> Fault:
    play, kept = between(rng, 0.02, 0.3) * float(d.amplitude_um.min()), math.exp(-1.0 / rng.uniform(0.5, 3.0))

    def stage(x: Floats) -> Floats:
        # Flanks meet softly.
        return np.asarray(lfilter([1.0 - kept], [1.0, -kept], _played(x, play) - x, axis=0) + x)

    also = frozenset(("guideway_friction", "tracking_delay"))
    return Fault("backlash", "lost", frozenset(["backlash"]), also, stage)


def scale(d: Design, rng: np.random.Generator) -> Fault:
    share = 1.0 + _sign(rng) * between(rng, 0.002, 0.03)
    return Fault("scale", "scale", frozenset(["lead_error"]), frozenset(), lambda x: x * share)


def zero(d: Design, rng: np.random.Generator) -> Fault:
    um = _sign(rng) * between(rng, 2.0, 50.0) * d.noise_um
    return Fault("zero", "probe", frozenset(), frozenset(), lambda x: x + um)


_BENT = frozenset(["lead_error"])


def graduation(d: Design, rng: np.random.Generator) -> Fault:
    pitch, phase = between(rng, 0.4, 3.0) * float(d.amplitude_um.min()), rng.uniform(0.0, _TURN)
    um = rng.uniform(0.02, 0.06) * pitch
    return Fault("graduation", "probe", frozenset(), _BENT, lambda x: x + um * np.sin(_TURN * x / pitch + phase))


def bent_probe(d: Design, rng: np.random.Generator) -> Fault:
    bend = _sign(rng) * rng.uniform(0.01, 0.05) / float(d.amplitude_um.max())
    return Fault("bent probe", "probe", frozenset(), _BENT, lambda x: x + bend * x * x)


def cable(d: Design, rng: np.random.Generator) -> Fault:
    pull = rng.uniform(0.02, 0.08) / float(d.amplitude_um.max()) ** 2
    return Fault("cable", "scale", frozenset(), _BENT, lambda x: x - pull * x**3)


def bellows(d: Design, rng: np.random.Generator) -> Fault:
    begins, pull = rng.uniform(0.1, 0.5) * float(d.amplitude_um.min()), rng.uniform(0.03, 0.1)
    return Fault("bellows", "scale", frozenset(), _BENT, lambda x: x - pull * np.maximum(0.0, x - begins))


def piezo(d: Design, rng: np.random.Generator) -> Fault:
    share, reach_um = rng.uniform(0.03, 0.12), np.linspace(0.1, 1.1, 8) * float(d.amplitude_um.max())
    also = frozenset(("lead_error", "backlash", "guideway_friction", "tracking_delay"))
    return Fault("piezo", "lost", frozenset(), also, lambda x: np.asarray(_remembered(x, share, reach_um)))


def saturated(d: Design, rng: np.random.Generator) -> Fault:
    most = d.highest**2 * float(d.amplitude_um.max()) * rng.uniform(0.6, 0.9)
    loop = _Loop(d.highest * rng.uniform(4.0, 8.0), 0.7, 0.0, 1.0, 1.0, 1.0, most)
    also = _LINEAR | {"stiffening_joint", "guideway_friction"}
    return Fault("saturated drive", "loop", frozenset(), also, _loop_stage(d, loop))


POOL: tuple[Mechanism, ...] = (
    servo_loop,
    velocity_lag,
    dead_time,
    mode,
    inertia,
    stiffening,
    friction,
    windup,
    backlash,
    scale,
    zero,
)
UNKNOWN: tuple[Mechanism, ...] = (graduation, bent_probe, cable, bellows, piezo, saturated)
# Of each of these a machine has one at most: no tone tells them apart.
_ALIKE: tuple[frozenset[Mechanism], ...] = (
    frozenset((servo_loop, mode, inertia, stiffening)),
    frozenset((servo_loop, velocity_lag, dead_time)),
    frozenset((friction, windup, backlash, piezo)),
    frozenset((servo_loop, velocity_lag, saturated)),
    frozenset((saturated, mode, inertia, stiffening)),
)


def drawn(count: int, beside: tuple[Mechanism, ...], rng: np.random.Generator) -> list[Mechanism]:
    """Return so many mechanisms of the pool, none like another or like those that are there ``beside`` them."""
    chosen: list[Mechanism] = []
    while len(chosen) < count:
        one = POOL[int(rng.integers(len(POOL)))]
        there = {*chosen, *beside}
        if one not in there and not any(one in group and group & there for group in _ALIKE):
            chosen.append(one)
    return chosen
