"""A run cut into turns, and its figures after ISO 230-7: total run-out, once per turn, synchronous, asynchronous."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dtwin.kinds.rotation._features import Feature, features_of
from dtwin.kinds.rotation._heads import AXIAL
from dtwin.schema import Floats, Run
from dtwin.statistics import k2_factor

_TURN = 360.0
_BINS = (360, 180, 120, 90, 72, 60, 36, 24, 16)
_COARSE_BINS = 60
_FINE = 360
_HIGHEST_ORDER = 50
_GAP_DEG = 6.0
_GAP_BINS = 3
_BACK_DEG = 20.0
_MOST_BLOCKS = 6
_FEWEST_PARTED, _FEW_TURNS, _PARTS = 4, 6, 60
_AT_ONCE = 500_000
_KEEP = "keep"
"""What the condition of a run states as ``features`` when local features are not to be left out."""


@dataclass(frozen=True)
class Turns:
    """Whole turns of a run on a grid of angles.

    ``angle_deg`` (bins,): middle of each bin, from 0 to 360, in the order of the turn.
    ``read_um`` (turns, bins): readings as they are.
    ``moved_um`` (turns, bins): the same without mean, straight drift over the time, and local features.
    ``t_s`` (turns,): middle of each turn.
    ``whole``: turns of the run, with those that gaps spoil.
    ``forward``: whether the angle rose.
    ``step_um``: least difference of two readings, the resolution of a coarse display.
    """

    angle_deg: Floats
    read_um: Floats
    moved_um: Floats
    t_s: Floats
    whole: int
    drift_um: float
    features: tuple[Feature, ...]
    axial: bool
    forward: bool = True
    step_um: float = 0.0

    @property
    def n(self) -> int:
        """Turns that are used."""
        return len(self.moved_um)


@dataclass(frozen=True)
class Value:
    """A figure, with the standard deviation of one block of turns."""

    um: float
    block_um: float
    blocks: int

    @property
    def expanded_um(self) -> float:
        """Half width that covers 95 %, by what differs from block to block; NaN of one block."""
        if self.blocks < 2:
            return float("nan")
        return k2_factor(self.blocks - 1.0) * self.block_um / float(np.sqrt(self.blocks))


@dataclass(frozen=True)
class Figures:
    """Figures of a run.

    ``once``: amplitude and phase of what comes once per turn, in µm: it is largest at the angle of the number.
    ``once_covariance`` (2, 2): of its real and imaginary part, from blocks; NaN of one block.
    ``floor_um``: range that blocks of turns alone would leave in the synchronous curve; NaN of one turn.
    """

    turns: int
    total: Value
    once_amplitude: Value
    once: complex
    once_covariance: Floats
    synchronous: Value
    residual: Value
    asynchronous: Value
    asynchronous_rms: Value
    mean_um: float
    mean_k2_um: float
    floor_um: float


def one_way(angle_deg: Floats) -> slice:
    """Return the longest stretch in which the axis did not turn back by more than 20 degrees."""
    step = np.diff(angle_deg)
    if (step > 0.0).all() or (step < 0.0).all():
        return slice(0, len(angle_deg))
    rising = _longest_rise(angle_deg)
    falling = _longest_rise(-angle_deg)
    return max((rising, falling), key=lambda s: abs(angle_deg[s.stop - 1] - angle_deg[s.start]))


def _longest_rise(angle_deg: Floats) -> slice:
    """Return the longest stretch in which an angle rises, but for less than 20 degrees."""
    best, longest = slice(0, 1), 0.0
    start, peak = 0, 0
    lowest = top = float(angle_deg[0])
    # Each tenth degree is enough, and spares a loop over every reading.
    steps = _steps(angle_deg)
    for n, angle in zip(steps, angle_deg[steps].tolist(), strict=True):
        if angle > top:
            top, peak = angle, n
        elif top - angle > _BACK_DEG or angle < lowest:
            if top - lowest > longest:
                best, longest = slice(start, peak + 1), top - lowest
            start, lowest, top, peak = n, angle, angle, n
    return slice(start, peak + 1) if top - lowest > longest else best


def _steps(angle_deg: Floats) -> list[int]:
    coarse = np.floor(10.0 * angle_deg)
    change = np.flatnonzero(np.diff(coarse) != 0.0) + 1
    return [*change.tolist(), len(angle_deg) - 1]


def turns_of(run: Run) -> Turns | None:
    """Return the turns of a run, None when it holds no whole one with enough readings."""
    part = one_way(run.samples["angle_deg"])
    a, x, t = (run.samples[name][part] for name in ("angle_deg", "displacement_um", "t_s"))
    forward = bool(a[-1] >= a[0])
    if not forward:
        a, x, t = a[::-1], x[::-1], t[::-1]
    whole = int((a[-1] - a[0]) // _TURN)
    if whole < 1:
        return None
    per_turn = len(a) * _TURN / float(a[-1] - a[0])
    bins = next((b for b in _BINS if b <= per_turn), 0)
    if not bins:
        return None
    width = _TURN / bins
    begin = float(np.ceil(a[0] / width) * width)
    whole = int((a[-1] - begin + 1e-9) // _TURN)
    if whole < 1:
        return None
    # A bin more at both ends, for those between which the first and the last one lie.
    cells = whole * bins + 2
    place = np.floor((a - begin) / width).astype(int) + 1
    inside = (place >= 0) & (place < cells)
    count = np.bincount(place[inside], minlength=cells)
    full = count > 0
    grid = begin + width * (np.arange(whole * bins) + 0.5)
    at, of, when = (np.bincount(place[inside], v[inside], cells)[full] / count[full] for v in (a, x, t))
    # Backlash of an encoder and jitter leave an order that is not quite that of the angle.
    order = np.argsort(at, kind="stable")
    if bins < _COARSE_BINS:
        # Straight lines between few readings flatten what comes several times a turn.
        rising = np.append(True, np.diff(np.maximum.accumulate(a)) > 0.0)
        read = CubicSpline(a[rising], x[rising])(np.clip(grid, a[0], a[-1])).reshape(whole, bins)
    else:
        read = np.interp(grid, at[order], of[order]).reshape(whole, bins)
    middle = np.interp(grid, at[order], when[order]).reshape(whole, bins).mean(axis=1)
    sound = np.array([_largest_gap(row) <= max(_GAP_BINS, _GAP_DEG / width) for row in full[1:-1].reshape(whole, bins)])
    if not sound.any():
        return None
    angle = np.mod(grid[:bins], _TURN)
    if not forward:
        read, middle, sound = read[::-1], middle[::-1], sound[::-1]
    axial = run.meta.condition.get("sense") == AXIAL
    kept = read[sound]
    level, slope = _line(np.flatnonzero(sound).astype(np.float64), kept.mean(axis=1))
    along = np.arange(bins) / bins - 0.5
    drift = level + slope * (np.flatnonzero(sound)[:, None] + (along if forward else -along)[None, :])
    moved = kept - drift
    features = () if run.meta.condition.get("features") == _KEEP else features_of(moved, width)
    for feature in features:
        moved = feature.bridged(moved)
    features = tuple(replace(f, angle_deg=float(np.mod(begin + f.angle_deg, _TURN))) for f in features)
    moved = moved - moved.mean()
    return Turns(angle, kept, moved, middle[sound], whole, slope * (whole - 1), features, axial, forward, _step(x))


def _step(x: Floats) -> float:
    steps = np.diff(np.unique(x))
    # Less is what arithmetic leaves.
    steps = steps[steps > 1e-6]
    return float(steps.min()) if steps.size else 0.0


def _line(at: Floats, mean: Floats) -> tuple[float, float]:
    """Return level and slope of the means of turns; no slope of fewer than three."""
    if len(at) < 3:
        return float(mean.mean()), 0.0
    slope, level = np.polyfit(at, mean, 1)
    return float(level), float(slope)


def _largest_gap(full: NDArray[np.bool_]) -> int:
    empty = np.concatenate([[0], (~full).astype(int), [0]])
    edges = np.flatnonzero(np.diff(empty))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0


def filtered(curve_um: Floats) -> Floats:
    """Return curves over one turn without what comes more than 50 times a turn; shape (..., bins)."""
    waves = np.fft.rfft(curve_um, axis=-1)
    waves[..., _HIGHEST_ORDER + 1 :] = 0.0
    return np.asarray(np.fft.irfft(waves, curve_um.shape[-1], axis=-1))


def _open_filtered(curve_um: Floats) -> Floats:
    """Return what :func:`filtered` does of curves whose end need not meet their begin: there it would ring by a tenth of the step."""
    bins = curve_um.shape[-1]
    waves = np.fft.rfft(np.concatenate([curve_um, curve_um[..., ::-1]], axis=-1), axis=-1)
    waves[..., 2 * _HIGHEST_ORDER + 1 :] = 0.0
    return np.asarray(np.fft.irfft(waves, 2 * bins, axis=-1)[..., :bins])


def _range(curve_um: Floats) -> Floats:
    """Return the ranges of curves over one turn, shape (..., bins), also between the places of a coarse grid."""
    bins = curve_um.shape[-1]
    if bins >= _COARSE_BINS:
        return np.asarray(np.ptp(curve_um, axis=-1))
    return np.asarray(np.ptp(np.fft.irfft(np.fft.rfft(curve_um), _FINE), axis=-1) * _FINE / bins)


def once_of(curve_um: Floats, angle_deg: Floats) -> complex:
    """Return amplitude and phase of what comes once per turn."""
    return complex(2.0 * np.mean(curve_um * np.exp(1j * np.radians(angle_deg))))


def synchronous_um(turns: Turns) -> tuple[Floats, Floats]:
    """Return the synchronous curve, and its residual without what comes once per turn; both of shape (bins,)."""
    return _synchronous_um(turns, filtered(turns.moved_um.mean(axis=0)))


def _synchronous_um(turns: Turns, mean_um: Floats) -> tuple[Floats, Floats]:
    """Return what :func:`synchronous_um` does, of filtered means (..., bins) of turns."""
    turn = np.exp(1j * np.radians(turns.angle_deg))
    level = mean_um - mean_um.mean(axis=-1, keepdims=True)
    once = 2.0 / mean_um.shape[-1] * (mean_um @ turn)
    residual = level - (once[..., None] * np.conj(turn)).real
    return (level if turns.axial else residual), residual


def figures_of(turns: Turns) -> Figures:
    """Return the figures of a run; what they are uncertain by comes from blocks of neighbouring turns."""
    moved, read = turns.moved_um, turns.read_um
    parts = np.array_split(np.arange(turns.n), min(turns.n, _MOST_BLOCKS))
    blocks = len(parts)
    # Means of all turns, and of all but one block each: of every row at once.
    means_of = np.ones((1 + blocks, turns.n))
    for k, part in enumerate(parts):
        means_of[1 + k, part] = 0.0
    used = means_of.sum(axis=1)
    means_of /= np.maximum(used, 1.0)[:, None]

    def figure(of_all_and_without: Floats) -> Value:
        return Value(float(of_all_and_without[0]), _deviation(of_all_and_without[1:]), blocks)

    # Of the readings as they are: what the drift adds within a turn belongs to it.
    total = np.ptp(read, axis=1)
    once = 2.0 / moved.shape[1] * (moved @ np.exp(1j * np.radians(turns.angle_deg)))
    own = np.array([once[part].mean() for part in parts])
    covariance = np.full((2, 2), np.nan)
    if blocks > 1:
        covariance = np.cov(own.real, own.imag) / blocks
    smooth = filtered(moved)
    off = moved - moved.mean(axis=0)
    apart = _open_filtered(off)
    left = means_of @ np.mean(off**2, axis=1) - np.mean((means_of @ off) ** 2, axis=1)
    unbiased = np.array([_unbiased(round(n)) for n in used])
    rms = figure(np.sqrt(np.maximum(left, 0.0) * unbiased))
    wide = float(np.ptp(apart, axis=0).max()) if turns.n > 1 else float("nan")
    # A range draws on few turns: its scatter relative to its size is that of the RMS, and more where parts of the turns say so.
    share = rms.block_um / rms.um if rms.um else 0.0
    scatter = max(wide * share, _range_of_parts(apart) * blocks**0.5)
    floor = float("nan")
    if turns.n > 1:
        halves = smooth[::2].mean(axis=0) - smooth[1::2].mean(axis=0)
        floor = float(np.ptp(halves)) / 2.0
    means = read.mean(axis=1)
    synchronous, residual = _synchronous_um(turns, means_of @ smooth)
    return Figures(
        turns.n,
        figure(means_of @ total),
        figure(np.abs(means_of @ once)),
        once_of(moved.mean(axis=0), turns.angle_deg),
        covariance,
        figure(_range(synchronous)),
        figure(_range(residual)),
        Value(wide, scatter, blocks),
        rms,
        float(means.mean()),
        2.0 * float(np.std([means[p].mean() for p in parts], ddof=1)) / blocks**0.5 if blocks > 1 else np.nan,
        floor,
    )


def _range_of_parts(apart_um: Floats) -> float:
    """Return the standard deviation of the largest range over turns (turns, bins), of a part of the turns; 0 of few.

    Leaving out one block moves a range only where it holds an extreme; the range of a third of the turns, drawn without
    replacement (of half of few), scatters about as much as that of tests made again.
    """
    turns = len(apart_um)
    if turns < _FEWEST_PARTED:
        return 0.0
    many = max(turns // 3, min(turns // 2, _FEW_TURNS))
    rng = np.random.default_rng(0)
    chosen = np.array([rng.permutation(turns)[:many] for _ in range(_PARTS)])
    # Few turns at once, many in parts of their own: their readings shall not take much memory.
    together = max(1, _AT_ONCE // (many * apart_um.shape[1]))
    ranges = [np.ptp(apart_um[chosen[k : k + together]], axis=1).max(axis=1) for k in range(0, _PARTS, together)]
    return float(np.std(np.concatenate(ranges), ddof=1))


def _unbiased(n: int) -> float:
    return n / (n - 1) if n > 1 else np.nan


def _deviation(without: Floats) -> float:
    """Return the standard deviation of one block, by figures that leave out each block in turn."""
    n = len(without)
    if n < 2 or not np.isfinite(without).all():
        return float("nan")
    return float(np.sqrt((n - 1) * np.sum((without - without.mean()) ** 2)))
