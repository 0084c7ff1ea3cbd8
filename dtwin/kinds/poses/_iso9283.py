"""Figures of ISO 9283 from measured poses: accuracy, repeatability and distance accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.kinds.poses._chain import rigid
from dtwin.kinds.poses._series import Series, mean_mm
from dtwin.schema import Floats, Run
from dtwin.statistics import rms

_FEWEST_REPEATS = 3
_PAIRS = 2000


def axes(run: Run, what: str) -> Floats:
    """Return columns ``what_x_mm`` ... as (n, 3)."""
    return np.stack([run.samples[f"{what}_{a}_mm"] for a in "xyz"], axis=1)


def measured_of(run: Run) -> Floats:
    """Return measured points (n, 3); target plus error when that is what was written."""
    if "measured_x_mm" in run.samples:
        return axes(run, "measured")
    return axes(run, "target") + axes(run, "error")


def joints_of(run: Run) -> Floats:
    """Return commanded joints (n, joints) in degrees; (n, 0) where they are not told."""
    names = [f"joint_{j}_deg" for j in range(1, 1 + sum(n.startswith("joint_") for n in run.samples))]
    return np.stack([run.samples[name] for name in names], axis=1) if names else np.zeros((run.n_samples, 0))


def numbers_of(run: Run) -> NDArray[np.int64]:
    """Return the numbers of the rows in their table, counted from 1 below the heads."""
    told = run.samples.get("row_1")
    return np.arange(1, run.n_samples + 1) if told is None else np.asarray(told, dtype=np.int64)


def times_of(run: Run) -> Floats | None:
    """Return the times of the rows in s; None where they are not known."""
    return None if any(f.code == "poses.times" for f in run.findings) else run.samples.get("t_s")


def figures(run: Run, series: Series) -> dict[str, Any]:
    """Return figures of one run, in mm; None for what its rows do not allow."""
    measured, setup, error, place = measured_of(run), series.setup, series.error_mm, series.poses.place
    point = series.poses.at.tool_mm(setup.tool_mm)
    count, means = np.bincount(place), means_of(error, place)
    accuracy = np.linalg.norm(means, axis=1)
    scatter = np.linalg.norm(error - means[place], axis=1)
    often = np.flatnonzero(count >= _FEWEST_REPEATS)
    repeatability = [scatter[place == p].mean() + 3.0 * scatter[place == p].std(ddof=1) for p in often]
    apart = distances_off(means_of(point, place))(means)
    as_is = None
    if "error_x_mm" in run.samples:
        as_is = mean_mm(axes(run, "error"))
        rotation, shift = rigid(axes(run, "target"), measured)
        frame_alone = mean_mm((measured - shift) @ rotation - axes(run, "target"))
    return {
        "poses": len(count),
        "readings": len(error),
        "repeated_poses": int((count > 1).sum()),
        "mean_error_mm": mean_mm(error),
        "largest_error_mm": float(np.linalg.norm(error, axis=1).max()),
        "pose_accuracy_mm": {"mean": float(accuracy.mean()), "max": float(accuracy.max())},
        "pose_repeatability_mm": None
        if not repeatability
        else {"median": float(np.median(repeatability)), "max": float(np.max(repeatability)), "poses": len(often)},
        "distance_accuracy_mm": None if not apart.size else {"rms": rms(apart), "max": float(np.abs(apart).max())},
        "as_written_mm": as_is,
        "frame_alone_mm": frame_alone if as_is is not None else None,
        "taken_away": series.taken_away,
        "tool_mm": setup.tool_mm.tolist(),
    }


def means_of(values: Floats, place: Floats) -> Floats:
    """Return the mean of the readings (n, 3) of each pose, (poses, 3); ``place`` (n,): number of the pose of each."""
    count = np.bincount(place)
    return np.stack([np.bincount(place, values[:, i]) / count for i in range(3)], axis=1)


def distances_off(point: Floats) -> Callable[[Floats], Floats]:
    """Return what tells by how much the distances of pairs of poses are too long: of all pairs, of many poses of 2000.

    The standard takes the mean of repeated distances, so that scatter is no error of distance; a reading is never paired
    with another one of its own pose.

    ``point`` (poses, 3): commanded points. What is returned takes the mean of measured less commanded (poses, 3), and
    returns (pairs,).
    """
    one, other = _pairs(len(point))
    wanted = (point[one] - point[other]).T
    length = lengths(wanted)

    def off(error: Floats) -> Floats:
        along = error.T
        return np.asarray(lengths(wanted + along.take(one, axis=1) - along.take(other, axis=1)) - length)

    return off


def lengths(along: Floats) -> Floats:
    """Return the lengths (n,) of vectors by their coordinates (3, n): a third of the time of ``norm``."""
    x, y, z = along
    return np.asarray(np.sqrt(x * x + y * y + z * z))


@lru_cache(maxsize=8)
def _pairs(poses: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the numbers of both poses of each pair, always the same ones."""
    if poses * (poses - 1) // 2 <= _PAIRS:
        return np.triu_indices(poses, k=1)
    rng = np.random.default_rng(0)
    one = rng.integers(0, poses, _PAIRS)
    return one, (one + rng.integers(1, poses, _PAIRS)) % poses


def lines(run_id: str, values: dict[str, Any]) -> Iterator[str]:
    """Yield the text of the figures of one run."""
    yield f"{run_id}: {values['readings']} readings of {values['poses']} poses, {values['repeated_poses']} measured again"
    if values["as_written_mm"] is not None:
        yield (
            f"  error as written {values['as_written_mm']:z.4f} mm; the best frame alone leaves "
            f"{values['frame_alone_mm']:z.4f} mm"
        )
    accuracy, distance = values["pose_accuracy_mm"], values["distance_accuracy_mm"]
    yield f"  left by {values['taken_away']}: {values['mean_error_mm']:z.3f} mm in the mean, {values['largest_error_mm']:z.3f} at most"
    yield f"  pose accuracy AP {accuracy['mean']:z.3f} mm in the mean, {accuracy['max']:z.3f} at most"
    if distance is not None:
        yield f"  distance accuracy AD {distance['rms']:z.3f} mm RMS, {distance['max']:z.3f} at most"
    said = values["pose_repeatability_mm"]
    if said is not None:
        yield f"  pose repeatability RP {said['median']:z.3f} mm (median of {said['poses']} poses), {said['max']:z.3f} at most"
