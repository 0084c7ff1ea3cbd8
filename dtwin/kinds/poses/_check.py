"""What is wrong with a table of poses, said before anyone fits to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dtwin.kinds.poses._chain import Frames, fitted
from dtwin.kinds.poses._data import chain_in
from dtwin.kinds.poses._iso9283 import axes, joints_of, measured_of, numbers_of, times_of
from dtwin.kinds.poses._orientation import QUATERNION
from dtwin.kinds.poses._series import Series, series_of, series_of_targets
from dtwin.schema import Finding, Floats, Run
from dtwin.statistics import usual_size
from dtwin.units import shown_number

_FEWEST = 20
_FAR_MM = 50.0
_SMALL_MM = 10.0
# Millimetres of error that no robot is as good as; metres under their name look so.
_EXACT_MM = 1e-3
_WILD = 12.0
_ROUNDS, _MOST_KEPT, _LISTED = 10, 0.8, 8
_FEWEST_STOPS = 3
_ALIKE = 0.05
_MUCH_MM = 2.0
"""Of a reflector beside the commanded point, rather than of a robot."""
_NO_ORIENTATION = (
    "does the reflector sit on the commanded point: without target_qx … target_qw its place on the tool is not found"
)
_LEFT_HANDED = "one of both frames is left-handed: turn the sign of one axis"
_MIRROR = np.array([1.0, 1.0, -1.0])


def problem_of(run: Run) -> Series:
    """Return a run as a problem to fit; of a run without joints, with frame and tool alone."""
    if not joints_of(run).size:
        quaternion = [run.samples.get(f"target_{name}_1") for name in QUATERNION]
        told = [part for part in quaternion if part is not None]
        turned = (
            Rotation.from_quat(np.stack(told, axis=1)).as_matrix()
            if told
            else np.tile(np.eye(3), (run.n_samples, 1, 1))
        )
        return series_of_targets(axes(run, "target"), turned, measured_of(run), times_of(run))
    ambient, t_s = run.samples.get("ambient_c"), times_of(run)
    return series_of(joints_of(run), measured_of(run), chain_in(run), ambient, t_s=t_s)


def judge_poses(run: Run) -> list[Finding]:
    """Return what is wrong with one table."""
    n = run.n_samples
    if n < _FEWEST:
        said = f"{n} poses: frame and tool alone take nine numbers, at least {_FEWEST} are needed"
        return [Finding("poses.few", "error", said, {"poses_1": float(n)})]
    series = problem_of(run)
    size = np.linalg.norm(series.error_mm, axis=1)
    typical = float(np.median(size))
    if typical > _FAR_MM:
        said = f"commanded poses and measured points do not belong together: {typical:z.0f} mm apart after {series.taken_away}"
        return [Finding("poses.chain", "error", f"{said}{_why(run)}", {"median_mm": typical})]
    commanded_mm = float(np.ptp(axes(run, "target"), axis=0).max()) if "target_x_mm" in run.samples else 0.0
    aside: list[Finding] = []
    if 0.0 < commanded_mm < _SMALL_MM:
        said = f"the poses span {shown_number(commanded_mm)} mm, less than a robot is judged by: metres under a name of millimetres?"
        if typical < _EXACT_MM:
            said += f" Errors of {shown_number(1e3 * typical, 2)} µm are less than a robot's, too"
            return [Finding("poses.units", "error", said, {"span_mm": commanded_mm})]
        aside.append(Finding("poses.units", "warning", said, {"span_mm": commanded_mm}))
    if typical > _MUCH_MM and not joints_of(run).size and "target_qx_1" not in run.samples:
        said = f"{shown_number(typical)} mm are left by the frame alone, much for a robot; {_NO_ORIENTATION}"
        aside.append(Finding("poses.reflector", "warning", said, {"median_mm": typical}))
    return [*_spoilt(run, series), *_commanded(run, series), *aside, *_repeats(series)]


def _why(run: Run) -> str:
    """Return what would bring them together: a unit, or another chain."""
    joints, measured = joints_of(run), measured_of(run)
    if np.ptp(measured, axis=0).max() < _SMALL_MM:
        return f"; the points span less than {_SMALL_MM:g} mm: are they in metres?"
    if not joints.size:
        target = axes(run, "target")
        if not _ALIKE < (ratio := float(np.ptp(target, axis=0).max() / np.ptp(measured, axis=0).max())) < 1.0 / _ALIKE:
            return f"; targets span {shown_number(ratio)} times what the points do: are they in another unit?"
        mirrored = series_of_targets(target, np.tile(np.eye(3), (len(target), 1, 1)), measured * _MIRROR).error_mm
        if np.median(np.linalg.norm(mirrored, axis=1)) < _FAR_MM:
            return f"; {_LEFT_HANDED}"
        untold = "" if "target_qx_1" in run.samples else f", and {_NO_ORIENTATION}"
        return f"; do the rows of both belong together{untold}?"
    tried: tuple[tuple[str, Callable[[Floats], Floats]], ...] = (
        ("joints are radians under a name of degrees", np.degrees),
        ("joints are degrees under a name of radians", np.radians),
    )
    for said, turned in tried:
        left = series_of(turned(joints), measured, chain_in(run), None).error_mm
        if np.median(np.linalg.norm(left, axis=1)) < _FAR_MM:
            return f"; {said}"
    mirrored = series_of(joints, measured * _MIRROR, chain_in(run), None).error_mm
    if np.median(np.linalg.norm(mirrored, axis=1)) < _FAR_MM:
        return f"; {_LEFT_HANDED}"
    return "; is the chain that of this robot?"


def _spoilt(run: Run, series: Series) -> list[Finding]:
    """Name rows far off the others, with frame and tool of those others: a few wild rows turn a frame that is fitted to all."""
    at, measured = series.poses.at, series.poses.measured_mm
    kept = np.ones(len(measured), dtype=bool)
    for _ in range(_ROUNDS):
        setup = fitted(Frames(at.origin_mm[:, kept], at.rotation[:, kept]), measured[kept])
        point = at.tool_mm(setup.tool_mm)
        size = np.linalg.norm(setup.in_base(measured) - point, axis=1)
        typical = float(np.median(size[kept]))
        limit = typical + _WILD * usual_size(size[kept] - typical)
        before, kept = kept, size <= limit
        if (kept == before).all() or kept.mean() < _MOST_KEPT:
            break
    rows = np.flatnonzero(~kept)
    if not rows.size:
        return []
    number = numbers_of(run)
    # Of two rows whose points were exchanged each lies where the other should.
    across = np.linalg.norm(setup.in_base(measured[rows])[:, None] - point[rows][None], axis=2)
    pairs = np.argwhere(np.triu(np.maximum(across, across.T) <= limit, 1))
    swapped = "".join(f"; the points of {number[rows[i]]} and {number[rows[j]]} look exchanged" for i, j in pairs[:4])
    said = (
        f"{_rows(number[rows])} beyond {limit:z.2f} mm of the commanded pose, where half of the others lie within {typical:z.2f}{swapped}; "
        f'condition = {{ leave_out = "{", ".join(str(n) for n in number[rows][:_LISTED])}" }} in the run leaves rows out'
    )
    return [Finding("poses.spoilt", "warning", said, {"rows_1": float(len(rows)), "largest_mm": float(size.max())})]


def _rows(numbers: NDArray[np.int64]) -> str:
    if len(numbers) == 1:
        return f"row {numbers[0]} lies"
    more = f" and {len(numbers) - _LISTED} more" if len(numbers) > _LISTED else ""
    return f"rows {', '.join(str(n) for n in numbers[:_LISTED])}{more} lie"


def _commanded(run: Run, series: Series) -> Iterator[Finding]:
    """Compare the target with what joints and chain give, up to a frame and the tool that it was planned for."""
    if "target_x_mm" not in run.samples:
        return
    size = np.zeros(run.n_samples)
    if joints_of(run).size:
        planned = series_of(joints_of(run), axes(run, "target"), chain_in(run), None)
        size = np.linalg.norm(planned.error_mm, axis=1)
    rows = np.flatnonzero(size > max(1.0, 20.0 * float(np.median(size))))
    if rows.size:
        listed = ", ".join(str(n) for n in numbers_of(run)[rows[:_LISTED]])
        said = f"the target of {len(rows)} rows does not follow from joints and chain, by up to {size.max():z.1f} mm: {listed}"
        yield Finding("poses.commanded", "warning", said, {"rows_1": float(len(rows))})
    if "measured_x_mm" in run.samples:
        ratio = float(
            np.ptp(axes(run, "target"), axis=0).max()
            / np.ptp(series.setup.in_base(axes(run, "measured")), axis=0).max()
        )
        # One pose spans nothing.
        if ratio > 0.0 and not _ALIKE < ratio < 1.0 / _ALIKE:
            said = f"targets span {shown_number(ratio)} times what the points do: metres under a name of millimetres?"
            yield Finding("poses.units", "warning", said, {"ratio_1": ratio})


def _repeats(series: Series) -> list[Finding]:
    if not series.repeats:
        said = "no pose was measured twice: the noise floor cannot be known, nor what is significant"
        return [Finding("poses.no_repeats", "warning", said)]
    said = f"{series.repeats} poses were measured again: a reading scatters by {1000.0 * series.floor_mm:z.0f} µm"
    told = [Finding("poses.repeats", "info", said, {"floor_mm": series.floor_mm})]
    # Each place is one stretch of rows.
    place = series.poses.place
    if series.repeats >= _FEWEST_STOPS and np.count_nonzero(np.diff(place)) + 1 == np.unique(place).size:
        said = (
            "the readings of each pose stand in rows one after the other: if the robot did not move in between, they are no repeats, "
            "and repeatability, noise floor and U are too small"
        )
        told.append(Finding("poses.one_stop", "warning", said, {"poses_1": float(series.repeats)}))
    if series.moved_mm:
        said = (
            f"poses that were measured again moved by {1000.0 * series.moved_mm:z.0f} µm from the first row to the last: "
            "the robot's base, the arm or the instrument drifts, and the figures hold it"
        )
        told.append(Finding("poses.drift", "warning", said, {"moved_mm": series.moved_mm}))
    return told
