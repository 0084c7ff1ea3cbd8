"""Local features of a surface: short dips or bumps at the same angle in every turn, a groove, a hole, a weld seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from dtwin.schema import Floats

_ORDERS = 8
_TUKEY = 4.685
_ROUNDS = 12
_NEAREST = 0.4
_SETTLED = 0.02
_PEAK = 8.0
_EDGE = 2.5
_ERRORS = 5.0
_NEAR_DEG = 2.0
_WIDEST_DEG = 30.0
_MOST = 0.65
"""Part of the turn that features may take: what is left must tell the smooth form."""
_BESIDE_DEG = 20.0
_THIRD = 0.3
_FAR_LESS = 2.0
_QUANTILE = 0.3
_OF_NORMAL = 0.3853
"""Below it lies that part of the sizes of normal values."""
_EVERY = 0.8
_FEWEST_BINS = 60
_TOLD = 0.2
"""Part of the largest number on the diagonal of the factor of the normal equations that the least must be."""


@dataclass(frozen=True)
class Feature:
    """A feature.

    ``angle_deg``: where it is deepest or highest.
    ``height_um``: above the smooth form beside it, negative of a dip.
    ``bins``: of the grid of the turn; they may go over its end.
    """

    angle_deg: float
    width_deg: float
    height_um: float
    bins: NDArray[np.intp]
    smooth_um: Floats

    def bridged(self, moved_um: Floats) -> Floats:
        """Return turns in which the smooth form stands in the place of the feature, between what both sides differ from it by."""
        out = moved_um.copy()
        n = moved_um.shape[1]
        sides = ((self.bins[0] - 1) % n, (self.bins[-1] + 1) % n)
        left, right = (moved_um[:, [side]] - self.smooth_um[side] for side in sides)
        share = np.arange(1, len(self.bins) + 1) / (len(self.bins) + 1)
        out[:, self.bins] = self.smooth_um[self.bins] + left * (1.0 - share) + right * share
        return out


def features_of(moved_um: Floats, width_deg: float) -> tuple[Feature, ...]:
    """Return the local features of turns (turns, bins); none of fewer than two turns or of a coarse grid.

    What stands out of the eight lowest orders, fitted so that a few bins do not matter, by far more than the rest does, is one where
    it is short and in nearly every turn.
    """
    turns, n = moved_um.shape
    if turns < 2 or n < _FEWEST_BINS:
        return ()
    mean = moved_um.mean(axis=0)
    smooth = _smooth(mean)
    left = mean - smooth
    scale = _scale(left)
    error = moved_um.std(axis=0, ddof=1) / np.sqrt(turns)
    usual = float(np.median(error))
    out = np.abs(left) > max(_EDGE * scale, _EDGE * usual)
    features = []
    for bins in _regions(out, max(2, round(_NEAR_DEG / width_deg))):
        peak = bins[int(np.argmax(np.abs(left[bins])))]
        each = (moved_um[:, peak] - smooth[peak]) / left[peak]
        high = abs(left[peak]) > max(_PEAK * scale, _ERRORS * usual)
        if high and len(bins) * width_deg <= _WIDEST_DEG and np.mean(each > 0.5) >= _EVERY:
            # A bin more on each side: an edge lies anywhere in it.
            wide = np.arange(bins[0] - 1, bins[0] + len(bins) + 1) % n
            features.append(Feature(width_deg * (peak + 0.5), len(bins) * width_deg, float(left[peak]), wide, smooth))
    if sum(len(f.bins) - 2 for f in features) > _MOST * n:
        return ()
    return tuple(features)


def _smooth(mean: Floats) -> Floats:
    """Return the lowest orders of a curve; bins far off them count less.

    It begins with all bins, with the lower third of each neighbourhood, and with the upper: of a surface with many gaps or teeth
    one of them lies on it, and leaves far less at a third of the bins. Where it does not, the fit to all bins is taken: one to a
    part may leave a little less there, and run wild elsewhere.
    """
    n = len(mean)
    angle = 2.0 * np.pi * np.arange(n) / n
    waves = np.arange(1, min(_ORDERS, n // 6) + 1)
    design = np.hstack([np.ones((n, 1)), np.cos(np.outer(angle, waves)), np.sin(np.outer(angle, waves))])
    reach = max(1, round(_BESIDE_DEG / 360.0 * n))
    near = np.take(mean, np.arange(n)[:, None] + np.arange(-reach, reach + 1), mode="wrap")
    low, high = np.quantile(near, (_THIRD, 1.0 - _THIRD), axis=1)
    starts = [np.asarray(part, dtype=np.float64) for part in (np.ones(n), mean <= low, mean >= high)]
    fits = [_settled(design, mean, start) for start in starts]
    leaves = [_scale(mean - fitted) for fitted in fits]
    return fits[0] if leaves[0] <= _FAR_LESS * min(leaves) else fits[int(np.argmin(leaves))]


def _settled(design: Floats, mean: Floats, weight: Floats) -> Floats:
    """Return the fit to the bins that lie nearest to it, then to all, those far off it counting less."""
    kept = min(len(mean), max(round(_NEAREST * len(mean)), 3 * design.shape[1]))
    fitted = mean
    for nearest in (True, False):
        for _ in range(_ROUNDS):
            fitted = design @ _weighted(design, mean, weight)
            off = np.abs(mean - fitted)
            scale = _scale(off)
            if scale <= 0.0:
                return np.asarray(fitted)
            if nearest:
                counted = np.asarray(off <= np.partition(off, kept - 1)[kept - 1], dtype=np.float64)
            else:
                counted = np.clip(1.0 - (off / (_TUKEY * scale)) ** 2, 0.0, 1.0) ** 2
            change, weight = float(np.abs(counted - weight).max()), counted
            if change < _SETTLED:
                break
    return np.asarray(fitted)


def _weighted(design: Floats, mean: Floats, weight: Floats) -> Floats:
    """Return the coefficients of weighted least squares.

    By the normal equations, in a third of the time, where the diagonal of their factor says that they keep ten digits: bins that
    all lie on one side of the turn hardly tell the orders apart.
    """
    heavy = (design * weight[:, None]).T
    factor, solution, failed = dposv(heavy @ design, heavy @ mean)
    if not failed and factor.diagonal().min() > _TOLD * factor.diagonal().max():
        return np.asarray(solution, dtype=np.float64)
    used = weight > 0.0
    root = np.sqrt(weight[used])
    return np.asarray(np.linalg.lstsq(design[used] * root[:, None], mean[used] * root, rcond=None)[0])


def _scale(left: Floats) -> float:
    """Return the deviation of the bins that lie near a curve, though most may lie far off."""
    place = int(_QUANTILE * (len(left) - 1))
    return float(np.partition(np.abs(left), place)[place]) / _OF_NORMAL


def _regions(out: NDArray[np.bool_], near: int) -> list[NDArray[np.intp]]:
    """Return runs of true bins on a circle, those that are near each other as one."""
    n = len(out)
    at = np.flatnonzero(out)
    if not at.size or at.size == n:
        return []
    gaps = np.diff(np.append(at, at[0] + n))
    begins = np.flatnonzero(gaps > near)
    if not begins.size:
        return []
    regions = []
    for k, end in enumerate(begins):
        first = at[(begins[k - 1] + 1) % len(at)] if k or len(begins) > 1 else at[(end + 1) % len(at)]
        last = at[end]
        regions.append(np.arange(first, last + 1 + (n if last < first else 0)) % n)
    return regions
