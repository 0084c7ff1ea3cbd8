"""Readings and cycles of a ball array that went wrong: they stand off what was read before them and after them alike."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.volumetric._identify import Balls, keys_of
from dtwin.schema import Finding, Floats
from dtwin.statistics import usual_size
from dtwin.units import is_number, shown_number

_FEWEST = 5
_BESIDE = 3
_FAR = 15.0
_LEAST_UM = 5.0
_MOST = 0.25
"""Part of the readings of a cycle that may stand off; of more, the cycle went wrong."""
_SHOWN = 3
_A_NUMBER = 3
"""Balls for each number of the smooth part, at least."""
_ROUNDS = 8


@dataclass(frozen=True)
class _Spoilt:
    """What went wrong in a campaign.

    ``readings``: for each cycle which of its readings stand off, or lie at the place of another ball.
    ``off_um``: for each cycle how far its readings stand off.
    ``cycles`` (cycles,): which went wrong as a whole.
    """

    readings: tuple[NDArray[np.bool_], ...]
    off_um: tuple[Floats, ...]
    cycles: NDArray[np.bool_]

    def kept(self, cycles: Sequence[Balls], least: int) -> list[tuple[int, Balls]]:
        """Return the cycles that did not go wrong with their numbers, without spoilt readings; all of them where too few are left."""
        gone = self.cycles if int((~self.cycles).sum()) >= least else np.zeros_like(self.cycles)
        out = []
        for n, (cycle, spoilt) in enumerate(zip(cycles, self.readings, strict=True)):
            if not gone[n]:
                keep = np.ones_like(spoilt) if self.cycles[n] else ~spoilt
                out.append(
                    (n, Balls(cycle.position_mm[keep], cycle.error_um[keep], cycle.pose[keep], cycle.ball[keep]))
                )
        return out


def spoilt_in(cycles: Sequence[Balls]) -> _Spoilt:
    """Return what went wrong; nothing of fewer than five cycles.

    ``cycles``: in the order of their times. What heat does goes on from cycle to cycle, and what stays from a cycle on stands off nothing after it.
    """
    keys = [keys_of(cycle) for cycle in cycles]
    place = {key: n for n, key in enumerate(dict.fromkeys(key for own in keys for key in own))}
    at = [np.array([place[key] for key in own], dtype=int) for own in keys]
    error = np.full((len(cycles), len(place), 3), np.nan)
    nominal = np.full_like(error, np.nan)
    for n, cycle in enumerate(cycles):
        error[n, at[n]], nominal[n, at[n]] = cycle.error_um, cycle.position_mm
    off = np.zeros((len(cycles), len(place)))
    if len(cycles) >= _FEWEST:
        off = _off(error, nominal, np.array([key[0] for key in place]))
    swapped = _swapped(nominal, np.array([key[0] for key in place]))
    # Of most readings the usual distance is known, and what is far is measured by it.
    usual = usual_size(off[np.isfinite(error[:, :, 0])]) if len(place) else 0.0
    far = off > max(_FAR * usual, _LEAST_UM)
    bad = np.array([far[n, own].mean() > _MOST if own.size else False for n, own in enumerate(at)])
    readings = tuple((far | swapped)[n, own] for n, own in enumerate(at))
    return _Spoilt(readings, tuple(off[n, own] for n, own in enumerate(at)), bad)


def _off(error: Floats, nominal: Floats, pose: NDArray[np.int64]) -> Floats:
    """Return how far each reading stands off both sides in time, the largest axis.

    What is smooth over the volume, as the errors of heat are, and what a pose moves by as a whole, is taken out.
    """
    count = len(error)
    usual = np.nanmedian(nominal, axis=0)
    unit = (usual - usual.mean(axis=0)) / max(float(np.ptp(usual)), 1.0)
    products = np.stack([unit[:, i] * unit[:, j] for i in range(3) for j in range(i, 3)], axis=1)
    smooth = np.column_stack([np.ones(len(unit)), unit, products])
    sides = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for way in (-1, 1):
            side = np.full_like(error, np.nan)
            for n in range(count):
                near = [n + way * k for k in range(1, _BESIDE + 1) if 0 <= n + way * k < count]
                if len(near) == _BESIDE:
                    side[n] = error[n] - np.nanmedian(error[near], axis=0)
            for n in range(count):
                side[n] -= _smooth(smooth, side[n])
            for number in np.unique(pose):
                own = pose == number
                side[:, own] -= np.nanmedian(side[:, own], axis=1, keepdims=True)
            sides.append(side)
    before, after = sides
    alike = np.sign(before) == np.sign(after)
    both = np.where(alike, np.minimum(np.abs(before), np.abs(after)), 0.0)
    # At an end there is one side, and heat moves on in it: half of it counts.
    one = np.where(np.isfinite(before), np.abs(before), np.abs(after)) / 2.0
    off = np.where(np.isfinite(before) & np.isfinite(after), both, one)
    return np.asarray(np.nan_to_num(off).max(axis=2))


def _smooth(design: Floats, side: Floats) -> Floats:
    """Return the smooth part of what readings (balls, 3) differ by; those far off it count less. Zeros where balls are few."""
    there = np.asarray(np.isfinite(side).all(axis=1), dtype=np.bool_)
    if int(there.sum()) < _A_NUMBER * design.shape[1]:
        return np.zeros_like(side)
    weight = there.astype(np.float64)
    values = np.where(there[:, None], side, 0.0)
    fitted = np.zeros_like(side)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        fitted = design @ np.linalg.lstsq(design * root, values * root, rcond=None)[0]
        left = np.abs(values - fitted).max(axis=1)
        usual = max(float(np.median(left[there])), 1e-9)
        weight = there / np.maximum(1.0, left / (2.0 * usual)) ** 2
    return fitted


def _swapped(nominal: Floats, pose: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which readings are stated nearer to the usual place of another ball of their pose than to their own."""
    usual = np.nanmedian(nominal, axis=0)
    out = np.zeros(nominal.shape[:2], dtype=np.bool_)
    for number in np.unique(pose):
        own = np.flatnonzero(pose == number)
        apart = np.linalg.norm(nominal[:, own, None, :] - usual[None, None, own, :], axis=3)
        mine = np.diagonal(apart, axis1=1, axis2=2)
        there = np.isfinite(mine)
        # Readings of one ball have one place.
        out[:, own] = there & (np.where(there[..., None], apart, 0.0).min(axis=2) < 0.5 * np.where(there, mine, 0.0))
    return out


def spoilt_findings(names: Sequence[str], cycles: Sequence[Balls], reading: _Spoilt) -> list[Finding]:
    """Return what went wrong in words."""
    out = []
    if reading.cycles.any():
        gone = [name for name, bad in zip(names, reading.cycles, strict=True) if bad]
        said = (
            f"{', '.join(gone[:_SHOWN])}{' and others' if len(gone) > _SHOWN else ''}: more than a quarter of the balls stand far off what was read before "
            "and after: the cycle went wrong, and twins and training leave it out"
        )
        out.append(Finding("cycle.spoilt", "warning", said, {"cycles_1": float(len(gone))}))
    single = [
        (float(reading.off_um[n][k]), f"{names[n]} pose {cycles[n].pose[k]} ball {cycles[n].ball[k]}")
        for n, spoilt in enumerate(reading.readings)
        if not reading.cycles[n]
        for k in np.flatnonzero(spoilt)
    ]
    if single:
        single.sort(reverse=True)
        shown = ", ".join(f"{name} ({shown_number(um)} µm)" for um, name in single[:_SHOWN])
        said = (
            f"readings stand far off what was read before and after, or lie at the place of another ball, and twins and training leave them out ({len(single)}): "
            f"{shown}: a missed touch, dirt, or exchanged balls"
        )
        out.append(Finding("balls.spoilt", "warning", said, {"readings_1": float(len(single))}))
    return out


def stroke_mm(geometry: Mapping[str, Any], axis: str, where: str) -> tuple[float, float]:
    """Return the two ends of the stroke of an axis."""
    reach = geometry.get(f"stroke_{axis}_mm")
    two = isinstance(reach, list | tuple) and len(reach) == 2 and all(map(is_number, reach))
    if isinstance(reach, list | tuple) and two and reach[0] < reach[1]:
        return float(reach[0]), float(reach[1])
    setting = f"machine_geometry.stroke_{axis}_mm"
    length = float(reach) if is_number(reach) and reach > 0.0 else 800.0
    raise InputError(
        "the stroke of an axis is needed",
        code="volumetric.stroke",
        where=f"{where} {setting}",
        got="nothing" if reach is None else f"one number: {reach}" if is_number(reach) else str(reach)[:60],
        allowed=f"two positions in mm, ascending, as the control counts them, such as [0.0, {length:z.1f}] or [{-length / 2:z.1f}, {length / 2:z.1f}]",
        hint="state it in campaign.toml; of a campaign that is in the lake already, which a change of campaign.toml does not reach: "
        f"dtwin amend NAME --set '{setting}=[LOW, HIGH]' --because WHY",
    )
