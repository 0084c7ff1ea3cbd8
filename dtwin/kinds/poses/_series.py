"""Poses of a campaign as a linear problem: errors, columns of every term, and blocks that are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from dtwin.kinds.poses._chain import Frames, Setup, columns, fitted, frames
from dtwin.kinds.poses._effects import EFFECTS, Poses, Term, library
from dtwin.schema import Floats
from dtwin.statistics import f_tail

# Blocks at most, and poses in each: of thousands, of some, of few. A gain over four blocks is no evidence.
_BLOCKS = ((64, 30), (24, 5), (8, 2))
_SAME_DEG, _SAME_MM = 0.03, 0.05
# Repeats that never differ scatter by what no tracker resolves.
_FINEST_MM = 1e-4
# Repeats move with time when chance does so this seldom.
_SURELY = 1e-3


@dataclass(frozen=True)
class Series:
    """One mounting of one robot, ready to fit.

    ``error_mm`` (n, 3): measured less commanded, base frame, frame and tool taken away.
    ``design`` (n, 3, m): what a unit of every parameter does: the set-up's nine first.
    ``slots``: parameters of every term in ``design``.
    ``block`` (n,): neighbouring poses share a block; they are held out together.
    ``floor_mm``: root of the mean square distance of a reading from the mean of its pose, by the median of the repeats:
    a spoilt one does not lift it. NaN without repeats.
    ``repeats``: poses that were measured more than once.
    ``moved_mm``: how far repeats moved from the first row to the last, in the mean; 0 where that is no more than chance. The
    floor is without it.
    """

    poses: Poses
    setup: Setup
    error_mm: Floats
    design: Floats
    slots: Mapping[Term, slice]
    block: Floats
    floor_mm: float
    repeats: int
    moved_mm: float = 0.0

    @property
    def taken_away(self) -> str:
        """What was fitted before errors are told: where all poses are turned alike, a tool is part of the frame."""
        turned = self.poses.at.rotation[-1]
        return "frame" if np.allclose(turned, turned[0]) else "frame and tool"

    def chosen(self, terms: Sequence[Term]) -> list[int]:
        """Return the numbers of the parameters of some terms, the set-up's first."""
        return [*range(9), *(i for term in terms for i in range(self.slots[term].start, self.slots[term].stop))]

    def floor_of_left_mm(self, left_mm: Floats) -> float:
        """Return the floor of what terms leave (n, 3): they may take what repeats differ by, as lost motion does."""
        return _floor_of(left_mm, self.poses.place, self.poses.t_s)[0]


def series_of(
    joints_deg: Floats,
    measured_mm: Floats,
    dh: Floats,
    ambient_c: Floats | None,
    setup: Setup | None = None,
    t_s: Floats | None = None,
) -> Series:
    """Return measured poses as a problem.

    ``joints_deg`` (n, joints): commanded.
    ``measured_mm`` (n, 3): in any frame.
    ``dh`` (joints, 4): the nominal chain, as :func:`dtwin.kinds.poses._chain.chain_of` gives it.
    ``ambient_c`` (n,) or None: temperature.
    ``setup``: frame and tool of another campaign of the same mounting; fitted without.
    ``t_s`` (n,) or None: when they were measured.
    """
    joints = np.radians(joints_deg)
    at = frames(joints, dh)
    place = _places(joints_deg)
    poses = Poses(joints, measured_mm, at, ambient_c, place, t_s)
    setup = setup or fitted(at, measured_mm)
    point = at.tool_mm(setup.tool_mm)
    error = setup.in_base(measured_mm) - point
    parts, slots, begin = [columns(at, setup.tool_mm)], {}, 9
    warmed = ambient_c is not None and float(np.ptp(ambient_c)) > 0.5
    for term in library(joints.shape[1], ambient=warmed, timed=t_s is not None and float(np.ptp(t_s)) > 0.0):
        made = EFFECTS[term.effect].columns(poses, point, term.joint)
        slots[term] = slice(begin, begin + made.shape[2])
        parts.append(made)
        begin += made.shape[2]
    floor, repeats, moved = _floor_of(error, place, t_s)
    design, block = np.concatenate(parts, axis=2), _blocks(joints, place)
    return Series(poses, setup, error, design, slots, block, floor, repeats, moved)


def series_of_targets(target_mm: Floats, rotation: Floats, measured_mm: Floats, t_s: Floats | None = None) -> Series:
    """Return measured poses of a robot whose joints are not told: frame and tool, and no term of an arm.

    ``target_mm``, ``measured_mm`` (n, 3): commanded, and measured in any frame.
    ``rotation`` (n, 3, 3): commanded orientations; of equal ones the tool is part of the frame.
    ``t_s`` (n,) or None: when they were measured.
    """
    n = len(target_mm)
    at = Frames(target_mm[None], rotation[None])
    place = _places(np.concatenate([target_mm * (_SAME_DEG / _SAME_MM), np.degrees(rotation.reshape(n, 9))], axis=1))
    setup = fitted(at, measured_mm)
    error = setup.in_base(measured_mm) - at.tool_mm(setup.tool_mm)
    poses = Poses(np.zeros((n, 0)), measured_mm, at, None, place)
    floor, repeats, moved = _floor_of(error, place, t_s)
    return Series(poses, setup, error, columns(at, setup.tool_mm), {}, np.zeros(n), floor, repeats, moved)


def mean_mm(error_mm: Floats) -> float:
    """Return the mean distance of errors of shape (n, 3)."""
    return float(np.linalg.norm(error_mm, axis=1).mean())


def _places(joints_deg: Floats) -> Floats:
    """Return the number of the commanded pose of every row; poses within ``_SAME_DEG`` are one."""
    # Thousands of readings of one pose would be millions of pairs.
    different, number = np.unique(joints_deg, axis=0, return_inverse=True)
    n = len(different)
    pairs = cKDTree(different).query_pairs(_SAME_DEG, output_type="ndarray")
    linked = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(linked, directed=False)[1][number])


def _floor_of(error: Floats, place: Floats, t_s: Floats | None) -> tuple[float, int, float]:
    """Return the floor of errors (n, 3), how many poses were measured again, and how far these moved over the test."""
    count = np.bincount(place)
    again = count > 1
    if not again.any():
        return float("nan"), 0, 0.0
    off, moved = _about_mean(error, place), 0.0
    if t_s is not None:
        later = _about_mean(t_s[:, None], place)[:, 0]
        power, dof = float(later @ later), 3.0 * float((count - 1).sum() - 1)
        rate = later @ off / power if power > 0.0 else np.zeros(3)
        without = off - later[:, None] * rate
        told, left = float(rate @ rate) * power, float((without**2).sum())
        if dof > 0.0 and left > 0.0 and f_tail(told / 3.0 / (left / dof), (3.0, dof)) < _SURELY:
            off, moved = without, float(np.linalg.norm(rate) * np.ptp(t_s))
    squares = np.bincount(place, (off**2).sum(axis=1))[again]
    # By what the median of chi-squared is of three directions of that many repeats.
    variances = squares / (2.0 * gammaincinv(1.5 * (count[again] - 1.0), 0.5))
    return max(float(np.sqrt(3.0 * np.median(variances))), _FINEST_MM), int(again.sum()), moved


def _about_mean(values: Floats, place: Floats) -> Floats:
    """Return values (n, m) less the mean of their pose."""
    count = np.bincount(place)
    mean = np.stack([np.bincount(place, column) / count for column in values.T], axis=1)
    return np.asarray(values - mean[place])


def _blocks(joints: Floats, place: Floats) -> Floats:
    """Return blocks of poses whose joints stand alike, of the same size; all repeats of a pose are in one.

    The largest block is halved where its joints differ most, until there are enough.
    """
    first = np.unique(place, return_index=True)[1]
    around = np.concatenate([np.cos(joints[first]), np.sin(joints[first])], axis=1)
    many = max(min(most, len(first) // each) for most, each in _BLOCKS)
    parts = [np.arange(len(first))]
    while len(parts) < many:
        largest = parts.pop(max(range(len(parts)), key=lambda n: len(parts[n])))
        centred = around[largest] - around[largest].mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        order = np.argsort(along, kind="stable")
        parts += [largest[half] for half in np.array_split(order, 2)]
    label = np.empty(len(first), dtype=int)
    for number, part in enumerate(parts):
        label[part] = number
    return np.asarray(label[place])
