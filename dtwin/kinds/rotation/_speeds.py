"""A probe at several speeds: its once-per-turn vector, its mean reading, its form, and what they follow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from dtwin.kinds.rotation._heads import AT_REST, OVER_SPEED
from dtwin.kinds.rotation._laws import Law, groups_of, law_of
from dtwin.kinds.rotation._orders import Order, orders_of
from dtwin.kinds.rotation._turns import Figures, Turns, figures_of, one_way, synchronous_um, turns_of
from dtwin.schema import Floats, Run
from dtwin.statistics import k2_factor, t_tail

_FORM = np.arange(2, 41)
_REACH_DEG, _NEAR_DEG = 25.0, 5.0
_ALIKE, _SMALL = 0.9, 0.1
_CHANCE = 0.01
_ODD_DEG = 10.0
"""Phase by which a wave that is no part of the form turns at least."""
_LEAST_DEG = 0.2
_OF_A_STEP = 0.25
_ONE = "s1"
"""The set-up that is not told."""
_HIGHEST = 40
_BLOCKS = 10
_LARGE = 4.0
"""Times what covers 95 % of the scatter of an amplitude."""
_MATTERS, _LINEAR = 0.05, 2e-3
"""Part of the largest synchronous error, without what comes once per turn, and of the run-out, of which a probe makes waves."""
_SAME_HZ = 0.02
_FEWEST = 3


@dataclass(frozen=True)
class Point:
    """One run of a probe; ``place``: among the runs of the campaign."""

    run_id: str
    sense: str
    speed_rpm: float
    turns: Turns
    figures: Figures
    orders: tuple[Order, ...]
    phased: bool
    started: str
    place: int


@dataclass(frozen=True)
class _Delay:
    """How far the form turns with the speed: ``ms`` that the angle is behind the probe, with k = 2."""

    ms: float
    k2_ms: float
    largest_deg: float


@dataclass(frozen=True)
class OverSpeed:
    """A probe over its speeds.

    ``odd_wave``: how often per turn the largest wave comes, where it turns and the form does not turn with it; 0 without.
    ``wave``: the wave whose amplitude changes most, None where none surely does. ``vector``, ``mean``: what the once-per-turn vector and the mean reading follow; None with too few speeds, or
    without a phase.
    ``spread_um``: largest distance of two vectors, delay taken away; NaN without a phase.
    ``noise_um``: k = 2 of a vector by blocks of turns, of the worst run.
    """

    probe: str
    sense: str
    points: tuple[Point, ...]
    delay: _Delay | None
    form_known: bool
    odd_wave: int
    wave: _MovingWave | None
    vector: Law | None
    mean: Law | None
    spread_um: float
    noise_um: float


def points_of(runs: Sequence[Run]) -> dict[tuple[str, str], list[Point]]:
    """Return the sound turning runs by probe and set-up with the sense of rotation, by speed."""
    by_figure: dict[tuple[str, str], list[Point]] = {}
    for place, run in enumerate(runs):
        if run.meta.condition.get("form") in (AT_REST, OVER_SPEED) or any(f.severity == "error" for f in run.findings):
            continue
        if "displacement_um" not in run.samples or (turns := turns_of(run)) is None:
            continue
        way = "" if turns.forward else ", turning backwards"
        key = (str(run.meta.condition.get("probe", run.meta.run_id)), run.meta.setup + way)
        phased = run.meta.condition.get("angle") != "speed"
        by_figure.setdefault(key, []).append(
            Point(
                run.meta.run_id,
                str(run.meta.condition.get("sense", "")),
                _speed_of(run),
                turns,
                figures_of(turns),
                orders_of(turns),
                phased,
                run.meta.started,
                place,
            )
        )
    return {key: sorted(points, key=lambda p: p.speed_rpm) for key, points in by_figure.items()}


def _speed_of(run: Run) -> float:
    """Return the speed of a run: as it turned, else as it is stated."""
    part = one_way(run.samples["angle_deg"])
    a, t = run.samples["angle_deg"][part], run.samples["t_s"][part]
    span = float(t[-1] - t[0])
    turned = abs(float(a[-1] - a[0])) / 6.0 / span if span > 0.0 else math.nan
    told = run.meta.condition.get("speed_rpm")
    return turned if math.isfinite(turned) else float(told or math.nan)


def over_speed(key: tuple[str, str], points: Sequence[Point]) -> OverSpeed:
    """Return what a probe follows over its speeds."""
    speed = np.array([p.speed_rpm for p in points])
    times = _times(points)
    phased = all(p.phased for p in points)
    known, shift, odd = _form_shift(points) if phased else (False, np.zeros(len(points)), 0)
    delay = _delay(speed, shift) if known else None
    once = np.array([p.figures.once for p in points])
    if delay is not None:
        once = once * np.exp(1j * np.radians(delay.ms * 6e-3 * speed))
    # A high spot that lags lies at a larger angle, of a spindle that turns backwards at a smaller one.
    vectors = np.column_stack([once.real, once.imag if points[0].turns.forward else -once.imag])
    within = [p.figures.once_covariance for p in points]
    noise = [float(np.trace(c)) / 2.0 for c in within if np.isfinite(c).all()]
    mean = np.array([[p.figures.mean_um] for p in points])
    mean_noise = [(p.figures.mean_k2_um / 2.0) ** 2 for p in points if math.isfinite(p.figures.mean_k2_um)]
    return OverSpeed(
        key[0] if key[1] == _ONE else f"{key[0]} ({key[1]})",
        points[0].sense,
        tuple(points),
        delay,
        known,
        odd,
        _moving_wave([p.turns for p in points], speed, [p.orders for p in points]),
        law_of(vectors, speed, times, float(np.mean(noise)) if noise else 0.0) if phased else None,
        law_of(mean, speed, times, float(np.mean(mean_noise)) if mean_noise else 0.0, pairs=True),
        float(max(abs(a - b) for a in once for b in once)) if phased else math.nan,
        2.0 * math.sqrt(max(noise, default=math.nan)),
    )


def _times(points: Sequence[Point]) -> Floats:
    """Return when runs began in hours; where clocks do not tell it, their places in the campaign."""
    try:
        at = [datetime.fromisoformat(p.started).timestamp() / 3600.0 for p in points]
    except ValueError:
        at = []
    if len(set(at)) == len(points):
        return np.array(at) - min(at)
    return np.array([float(p.place) for p in points])


def _form_shift(points: Sequence[Point]) -> tuple[bool, Floats, int]:
    """Return whether the form of all runs is the same but turned, by how many degrees from that of the slowest, and its odd wave.

    The form is what comes 2 to 40 times per turn, features with it: unbalance has no part in it. The odd wave is its largest,
    where the others do not turn with it, and is no part of the form then; 0 where they do. A delay turns all of them, a force
    through a structure that lags only its own.
    """
    bins = min(p.turns.read_um.shape[1] for p in points)
    orders = _FORM[bins // 4 > _FORM]
    if len(orders) < 4 or len(points) < 2:
        return False, np.zeros(len(points)), 0
    waves = np.array([_waves(p.turns, orders) for p in points])
    size = np.sqrt(np.mean(np.abs(waves) ** 2, axis=0))
    # Noise of high orders would turn the form by more than it is.
    told = size >= _SMALL * size.max()
    waves, orders = waves[:, told], orders[told]
    alike, shift = _turned(waves, orders)
    if not alike:
        return False, shift, 0
    largest = int(np.argmax(np.sum(np.abs(waves) ** 2, axis=0)))
    rest_alike, rest = _turned(np.delete(waves, largest, axis=1), np.delete(orders, largest))
    speed = np.array([p.speed_rpm for p in points])
    apart = shift - rest if rest_alike else shift
    least_deg = max(0.5 * np.ptp(shift), 0.5 * np.ptp(rest), _ODD_DEG / float(orders[largest]))
    if _delay(speed, apart) is None or np.ptp(apart) < least_deg:
        return True, shift, 0
    return rest_alike, rest, int(orders[largest])


def _turned(waves: NDArray[np.complex128], orders: NDArray[np.int64]) -> tuple[bool, Floats]:
    """Return whether waves (runs, orders) are the same but turned, and by how many degrees from those of the first run."""
    tried = np.arange(-_REACH_DEG, _REACH_DEG, 0.1)
    shift, alike = np.zeros(len(waves)), True
    for n, of in enumerate(waves):
        # From its neighbour in speed: the form turns little from one to the next.
        turn = _turn(of, waves[max(0, n - 1)], orders, tried)
        alike &= turn is not None
        shift[n] = (shift[n - 1] if n else 0.0) + (turn or 0.0)
    # Once more from the mean form of all others: what neighbours are off by has added up.
    back = waves * np.exp(-1j * np.outer(np.radians(shift), orders))
    near = np.arange(-_NEAR_DEG, _NEAR_DEG, 0.1)
    others = [np.delete(back, n, axis=0).mean(axis=0) for n in range(len(waves))]
    finer = [_turn(of, form, orders, at + near) for of, form, at in zip(waves, others, shift, strict=True)]
    shift = np.array([at if fine is None else fine for at, fine in zip(shift, finer, strict=True)])
    return bool(alike), shift - shift[0]


def _turn(
    of: NDArray[np.complex128], reference: NDArray[np.complex128], orders: NDArray[np.int64], tried: Floats
) -> float | None:
    """Return by which of the tried angles waves are turned from others, between them by a parabola; None where they are not alike."""
    match = (np.exp(-1j * np.outer(np.radians(tried), orders)) @ (of * np.conj(reference))).real
    best = int(np.argmax(match))
    scale = float(np.linalg.norm(of) * np.linalg.norm(reference))
    if not 0 < best < len(tried) - 1 or not match[best] > _ALIKE * scale:
        return None
    bend = match[best - 1] - 2.0 * match[best] + match[best + 1]
    vertex = 0.5 * (match[best - 1] - match[best + 1]) / bend if bend else 0.0
    return float(tried[best] + 0.1 * np.clip(vertex, -0.5, 0.5))


def _waves(turns: Turns, orders: NDArray[np.int64]) -> NDArray[np.complex128]:
    mean = turns.read_um.mean(axis=0)
    waves = np.asarray(2.0 * np.exp(1j * np.outer(orders, np.radians(turns.angle_deg))) @ mean / len(mean))
    # What the steps of a display leave turns with the eccentricity, and is no form.
    return np.where(np.abs(waves) > _OF_A_STEP * turns.step_um, waves, 0.0)


def _delay(speed: Floats, shift_deg: Floats) -> _Delay | None:
    """Return the delay that a form which turns in proportion to the speed shows, None where it does not surely turn."""
    if len(np.unique(groups_of(speed))) < 3:
        return None
    design = np.column_stack([np.ones(len(speed)), speed])
    coefficients = np.linalg.lstsq(design, shift_deg, rcond=None)[0]
    left = shift_deg - design @ coefficients
    dof = len(speed) - 2
    error = math.sqrt(float(left @ left) / dof * float(np.linalg.inv(design.T @ design)[1, 1]))
    slope = float(coefficients[1])
    if abs(slope) * float(np.ptp(speed)) < _LEAST_DEG or 2.0 * t_tail(abs(slope) / max(error, 1e-12), dof) > _CHANCE:
        return None
    return _Delay(-slope / 6e-3, k2_factor(dof) * error / 6e-3, abs(slope) * float(speed.max()))


def next_speed(speed_rpm: Floats) -> float:
    """Return the speed that would tell most, to three digits: in the widest gap of the squares of the speeds."""
    squares = np.sort(np.concatenate([[0.0], np.unique(speed_rpm) ** 2]))
    widest = int(np.argmax(np.diff(squares)))
    return float(f"{np.sqrt(0.5 * (squares[widest] + squares[widest + 1])):z.3g}")


@dataclass(frozen=True)
class _MovingWave:
    """The wave whose amplitude changes most from speed to speed; ``times``: how often per turn; at which speeds it is smallest and largest."""

    times: int
    least_um: float
    least_rpm: float
    most_um: float
    most_rpm: float


def _moving_wave(turns: Sequence[Turns], speed_rpm: Floats, lines: Sequence[Sequence[Order]]) -> _MovingWave | None:
    """Return the wave of two times per turn or more whose amplitude changes, if it surely does; None of two speeds and fewer.

    ``lines``: what stands between whole orders, by run. A frequency of its own that is a whole order at one speed is no change there.
    """
    if len(np.unique(np.round(speed_rpm, -1))) < _FEWEST or any(run.n < _FEWEST for run in turns):
        return None
    bins = min(run.moved_um.shape[1] for run in turns)
    orders = np.arange(2, min(_HIGHEST, bins // 4) + 1)
    told = [_amplitudes(run, orders) for run in turns]
    size, unsure = (np.array([one[k] for one in told]) for k in (0, 1))
    hertz = {line.order * rpm / 60.0 for rpm, of_run in zip(speed_rpm, lines, strict=True) for line in of_run}
    own = np.outer(speed_rpm / 60.0, orders)
    alien = np.any([np.abs(own - hz) < _SAME_HZ * hz for hz in hertz], axis=0) if hertz else np.zeros_like(own, bool)
    low, high = np.where(alien, np.inf, size), np.where(alien, -np.inf, size)
    change = high.max(axis=0) - low.min(axis=0)
    synchronous = max(float(np.ptp(synchronous_um(run)[1])) for run in turns)
    runout = max(float(np.ptp(run.read_um, axis=1).mean()) for run in turns)
    least = max(_MATTERS * synchronous, _LINEAR * runout, *(run.step_um for run in turns))
    sure = change > np.maximum(_LARGE * unsure.max(axis=0), least)
    if not sure.any():
        return None
    best = int(np.argmax(np.where(sure, change, 0.0)))
    least, most = int(np.argmin(low[:, best])), int(np.argmax(high[:, best]))
    at = float(size[least, best]), float(speed_rpm[least]), float(size[most, best]), float(speed_rpm[most])
    return _MovingWave(int(orders[best]), *at)


def _amplitudes(turns: Turns, orders: Floats) -> tuple[Floats, Floats]:
    """Return the amplitudes of the mean turn, and what covers 95 % of their scatter by blocks of turns."""
    waves = (
        2.0 / turns.moved_um.shape[1] * (turns.moved_um @ np.exp(1j * np.outer(np.radians(turns.angle_deg), orders)))
    )
    parts = np.array_split(waves, min(turns.n, _BLOCKS))
    means = np.array([part.mean(axis=0) for part in parts])
    scatter = np.sqrt(np.var(means, axis=0, ddof=1) / len(parts))
    return np.abs(waves.mean(axis=0)), k2_factor(len(parts) - 1.0) * scatter
