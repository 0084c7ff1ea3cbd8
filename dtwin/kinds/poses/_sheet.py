"""Test sheet of robot poses after ISO 9283, with the scatter that its figures would have again, and by how much accuracy and repeatability drift."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.kind import Drawing
from dtwin.kinds.poses._chain import left_by_setup
from dtwin.kinds.poses._check import problem_of
from dtwin.kinds.poses._iso9283 import axes, distances_off, lengths, means_of, measured_of
from dtwin.kinds.poses._series import Series
from dtwin.report.plots import error_figure, places_figure
from dtwin.report.sheet import Characteristic, Part, Sheet, sound_runs
from dtwin.report.uncertainty import Circumstances, Contribution
from dtwin.schema import Floats, Run
from dtwin.statistics import rms, shared_variances, times_simulated

if TYPE_CHECKING:
    import plotly.graph_objects as go

_FEWEST_REPEATS, _ASKED_REPEATS = 3, 30
_NUMBERS, _FEW_POSES = {"frame": 6, "frame and tool": 9}, 20
_READING_UM = 15.0
_SCALE_UM_PER_M = 6.0
_RULER = 1e-5
_OTHER_FRAME_MM = 20.0
_DRIFT = ("dAP", "dRP")
_LARGEST = ("AP", "AD", "RP")
_NAMES = {
    "AP": "pose accuracy, largest",
    "AP mean": "pose accuracy, mean",
    "AD": "distance accuracy, largest",
    "AD rms": "distance accuracy, RMS",
    "RP": "pose repeatability, largest",
    "dAP": "drift of pose accuracy, largest",
    "dRP": "drift of pose repeatability, largest",
}


def pose_sheet(runs: Sequence[Run], under: Circumstances) -> Sheet:
    """Evaluate every run: pose accuracy AP in the mean and at most, distance accuracy AD, pose repeatability RP at most.

    Drift of both, dAP and dRP, is told of poses that were measured twenty times or more.
    """
    parts, notes = [], []
    for run in runs:
        notes += sound_runs([run])[1]
        series = problem_of(run)
        sound = not any(f.severity == "error" for f in run.findings)
        notes.append(_taken_away(run, series))
        poses = int(series.poses.place.max()) + 1
        title = f"{run.meta.run_id}, {poses} pose{'' if poses == 1 else 's'}"
        parts.append(Part(title, (run.meta.run_id,), _figures(series, under), sound))
    basis = "the figures of tests made again from what repeats of a pose differ by (unit of replication: the reading)"
    return Sheet("ISO 9283, poses", "AP", tuple(parts), basis, tuple(notes))


def _figures(series: Series, under: Circumstances) -> tuple[Characteristic, ...]:
    error_um, place = 1000.0 * series.error_mm, series.poses.place
    point_um = 1000.0 * series.poses.at.tool_mm(series.setup.tool_mm)
    repeated = int(np.bincount(place).max()) > 1
    evaluated = _evaluation(place, point_um)
    told = evaluated(error_um) | _drift(error_um, place)
    taken = _taken(series)
    for name in (*taken, "dAP") if taken else ():
        told.pop(name, None)
    few = _too_small(series)
    left = left_by_setup(series.design[:, :, :9])
    # Where a longer ruler would find the figures: what it changes by for each µm/m is a length.
    away = left(point_um - point_um.mean(axis=0))
    stretched = [error_um + s * _RULER * away for s in (1, -1)]
    longer = [evaluated(one) | _drift(one, place) for one in stretched]
    metres = {name: max(abs(one[name] - value) for one in longer) / (1e6 * _RULER) for name, value in told.items()}
    dof, spread = dict.fromkeys(told, 0.0), dict.fromkeys(told, math.nan)
    if repeated:
        rng = np.random.default_rng(0)
        # The floor is of three directions; a pose is drawn about its own mean.
        scatter = _scatter_of(error_um, place, 1000.0 * series.floor_mm / math.sqrt(3.0))
        dof = {name: scatter.dof_of_one if name in _LARGEST else scatter.dof for name in told}
        one_um = scatter.of_reading[:, None]
        mean = means_of(error_um, place)[place]
        drawn = (one_um * rng.standard_normal(error_um.shape) for _ in range(times_simulated(error_um.size)))
        again = [evaluated(mean + left(one)) for one in drawn]
        spread = {name: float(np.std([a[name] for a in again], ddof=1)) for name in again[0]}
    if "dRP" in told:
        of_changes, dof_of_tens = _uncertainty_of_changes(error_um, place)
        spread |= dict(zip(_DRIFT, of_changes, strict=True))
        dof |= dict.fromkeys(_DRIFT, dof_of_tens)
    return tuple(
        Characteristic(
            symbol,
            _NAMES[symbol],
            value,
            1,
            spread[symbol],
            dof[symbol],
            contributions=_contributions(metres[symbol], under),
            too_small=few.get(symbol, ""),
        )
        for symbol, value in told.items()
    )


def _taken(series: Series) -> tuple[str, ...]:
    """Return the figures of which frame and tool leave nothing: poses tell three numbers each, and a frame keeps distances."""
    if 3 * (int(series.poses.place.max()) + 1) > _NUMBERS[series.taken_away]:
        return ()
    return ("AP", "AP mean") if series.taken_away == "frame" else ("AP", "AP mean", "AD", "AD rms")


def _too_small(series: Series) -> dict[str, str]:
    """Return why figures are smaller than those of the robot, and what to do: a frame is fitted to few poses.

    A frame keeps distances; neither frame nor tool changes what readings of a pose scatter by.
    """
    poses = int(series.poses.place.max()) + 1
    if poses >= _FEW_POSES:
        return {}
    numbers, what = _NUMBERS[series.taken_away], series.taken_away
    of_tool = ("AD", "AD rms") if what != "frame" else ()
    why = (
        f"the {numbers} numbers of {what}, fitted to {poses} pose{'' if poses == 1 else 's'}, take away more of the error than U "
        f"holds; measure {_FEW_POSES} poses or more; of an instrument in the robot's frame, see AP as the file has its errors"
    )
    return dict.fromkeys(("AP", "AP mean", "dAP", *of_tool), why)


def _taken_away(run: Run, series: Series) -> str:
    """Return what frame and tool took away before the figures: of few poses it is much of the error."""
    poses = int(series.poses.place.max()) + 1
    said = f"{run.meta.run_id}: AP and AD are of what is left by the best {series.taken_away}"
    if "target_x_mm" in run.samples:
        written_mm = np.linalg.norm(means_of(measured_of(run) - axes(run, "target"), series.poses.place), axis=1)
        # Farther off is the frame of an instrument, not that of the robot.
        if "error_x_mm" in run.samples or written_mm.max() < _OTHER_FRAME_MM:
            said += f"; as the file has its errors, AP is {1000.0 * written_mm.max():z.0f} µm"
    if poses < _FEW_POSES:
        numbers = _NUMBERS[series.taken_away]
        many = "1 pose is" if poses == 1 else f"{poses} poses are"
        taken = _taken(series)
        rest = f"nothing is left of {taken[0]} and {taken[-1]}" if taken else "the figures too small"
        said += f"; {many} few for the {numbers} numbers of {series.taken_away}, and {rest}"
    repeats = np.bincount(series.poses.place)
    fewest = int(repeats[repeats >= _FEWEST_REPEATS].min(initial=_ASKED_REPEATS))
    if repeats.max() < _FEWEST_REPEATS:
        said += "; RP is not told, for no pose was measured three times; ISO 9283 asks for thirty"
    elif fewest < _ASKED_REPEATS:
        said += f"; RP is of {fewest} readings a pose and more; ISO 9283 asks for thirty"
    return f"{said}."


def _contributions(metres: float, under: Circumstances) -> tuple[Contribution, ...]:
    """Return what the instrument and the surroundings contribute.

    ``metres``: length by which the figure changes with the scale.
    """
    scale = under.stated("uncertainty_um_per_m", _SCALE_UM_PER_M)
    own = Contribution(
        "instrument's scale", scale.value / 2 * metres, scale.basis("µm/m (k = 2)"), assumed=scale.assumed
    )
    return (under.reading(_READING_UM), *under.environment(1), own, *under.length(metres))


def _evaluation(place: Floats, point_um: Floats) -> Callable[[Floats], dict[str, float]]:
    """Return what tells the figures of errors (n, 3), in the order of measurement, of poses with these numbers.

    RP where a pose was measured three times.
    """
    count = np.bincount(place)
    often = count >= _FEWEST_REPEATS
    off = distances_off(means_of(point_um, place))

    def evaluated(error_um: Floats) -> dict[str, float]:
        means = means_of(error_um, place)
        accuracy = lengths(means.T)
        told = {"AP": float(accuracy.max()), "AP mean": float(accuracy.mean())}
        apart = off(means)
        if apart.size:
            told |= {"AD": float(np.abs(apart).max()), "AD rms": rms(apart)}
        if often.any():
            away = lengths((error_um - means[place]).T)
            mean = np.bincount(place, away) / count
            squares = np.bincount(place, (away - mean[place]) ** 2)[often] / (count[often] - 1)
            told["RP"] = float((mean[often] + 3.0 * np.sqrt(squares)).max())
        return told

    return evaluated


def _drift(error_um: Floats, place: Floats) -> dict[str, float]:
    """Return dAP and dRP of errors (n, 3), where a pose was measured twenty times."""
    return dict(zip(_DRIFT, _changes_of(error_um, place) or (), strict=False))


def pose_figure(runs: Sequence[Run]) -> go.Figure:
    """Draw the distance of every reading from its commanded pose."""
    curves = {}
    for run in runs:
        size = 1000.0 * np.linalg.norm(problem_of(run).error_mm, axis=1)
        curves[run.meta.run_id] = (np.arange(1.0, size.size + 1.0), size)
    return error_figure(
        curves,
        title="Distance from the commanded pose, as the set-up leaves it",
        x_title="reading",
        y_title="distance, µm",
    )


def _from_above(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    """Draw where the poses lie, seen from above, and how far each is off."""
    series = problem_of(run)
    return above_figure(series, series.error_mm, "Poses from above")


def above_figure(series: Series, left_mm: Floats, title: str) -> go.Figure:
    """Draw where poses lie, seen from above in the frame of the base; ``left_mm`` (n, 3): how far each is off."""
    place = series.setup.in_base(series.poses.measured_mm)
    return places_figure(place[:, 0], place[:, 1], 1000.0 * np.linalg.norm(left_mm, axis=1), title=title)


DRAWINGS = (Drawing("above", "Poses from above, by how far they are off", 520, _from_above),)


@dataclass(frozen=True)
class _Scatter:
    """Standard deviations of one reading in one direction.

    ``of_reading`` (n,): of the pose of each reading.
    ``dof``: degrees of freedom of all repeats.
    ``dof_of_one``: of what a largest figure hangs on, the scatter of one pose; that of all where poses are alike.
    """

    of_reading: Floats
    dof: float
    dof_of_one: float


def _scatter_of(error: Floats, place: Floats, usual: float) -> _Scatter:
    """Return the scatter of poses that were measured again.

    Poses far out or fast may scatter more than others. By how much more than chance the mean squares of poses differ tells
    what weight those of a pose have beside that of all (empirical Bayes): none where they differ by chance.

    ``error`` (n, 3), ``place`` (n,): errors of readings, and the numbers of their poses.
    ``usual``: standard deviation of a reading in one direction, of all poses.
    """
    count = np.bincount(place)
    square = np.bincount(place, ((error - means_of(error, place)[place]) ** 2).sum(axis=1))
    dof = np.asarray(3.0 * (count - 1.0), dtype=np.float64)
    own, weight = shared_variances(square / np.maximum(dof, 1.0), dof, usual**2)
    again = dof > 0.0
    of_all = float((count - 1).sum())
    share, of_pose = float(weight[again].mean()), float(np.median(dof[again]))
    return _Scatter(np.sqrt(own)[place], of_all, 1.0 / ((1.0 - share) / of_all + share / of_pose))


# Readings of a pose of which one accuracy and one repeatability are computed, to see them change.
_CYCLES = 10


def _changes_of(error_um: Floats, place: Floats) -> tuple[float, float] | None:
    """Return dAP and dRP of errors (n, 3), in the order of measurement, of poses with these numbers.

    None where no pose was measured twenty times. Each is the largest change since the first ten readings of a pose.
    """
    told = [_largest(*_figures_of_both(blocks)) for blocks in _blocks(error_um, place)]
    return (float(max(a for a, _ in told)), float(max(r for _, r in told))) if told else None


def _uncertainty_of_changes(error_um: Floats, place: Floats) -> tuple[tuple[float, float], float]:
    """Return standard uncertainties of dAP and dRP, and their degrees of freedom, of poses that changes_of() takes.

    The test is simulated again with what surely changed and what scatters within ten readings. How far dAP and dRP
    of 95 of 100 such tests are from what was put in, is twice the uncertainty: a largest change is too large where
    little changes.
    """
    poses = _blocks(error_um, place)
    means = [blocks.mean(axis=1) for blocks in poses]
    square = np.concatenate([blocks.var(axis=1, ddof=1).mean(axis=-1) for blocks in poses])
    dof = np.full(square.size, 3.0 * (_CYCLES - 1))
    # All poses may scatter more at first, while the robot warms: a pose is compared with the others of that time.
    ten, own = np.concatenate([np.arange(len(m)) for m in means]), np.empty_like(square)
    for now in (ten == n for n in range(int(ten.max()) + 1)):
        own[now], _ = shared_variances(square[now], dof[now], float(square[now].mean()))
    # What means of ten differ by without any drift, and what they do: the rest is drift.
    away = [m - m.mean(axis=0) for m in means]
    chance = float(square.mean()) / _CYCLES * sum(3.0 * (len(m) - 1) for m in means)
    apart = sum(float((a**2).sum()) for a in away)
    weight = 1.0 - chance / apart if apart > chance else 0.0
    rng = np.random.default_rng(0)
    times = times_simulated(sum(blocks.size for blocks in poses))
    scatter_um = np.split(np.sqrt(own), np.cumsum([len(m) for m in means])[:-1])
    true, again = [], []
    for mean, off, one_um in zip(means, away, scatter_um, strict=True):
        steady = mean - (1.0 - weight) * off
        noise = one_um[:, None, None] * rng.standard_normal((times, len(mean), _CYCLES, 3))
        accuracy, repeatability = _figures_of_both(steady[:, None] + noise)
        again.append(_largest(accuracy, repeatability))
        true.append(_largest(np.linalg.norm(steady, axis=-1), repeatability.mean(axis=0)))
    off_by = np.abs(np.max(again, axis=0) - np.max(true, axis=0)[:, None])
    accuracy_um, repeatability_um = (np.quantile(off_by, 0.95, axis=1) / 2.0).tolist()
    return (accuracy_um, repeatability_um), float(dof.sum())


def _blocks(error_um: Floats, place: Floats) -> list[Floats]:
    """Return the errors of each pose that was measured twenty times, ten readings after ten: (tens, 10, 3)."""
    often = np.flatnonzero(np.bincount(place) >= 2 * _CYCLES)
    of_poses = (error_um[place == pose] for pose in often)
    return [one[: len(one) // _CYCLES * _CYCLES].reshape(-1, _CYCLES, 3) for one in of_poses]


def _figures_of_both(blocks: Floats) -> tuple[Floats, Floats]:
    """Return AP and RP (..., tens) of readings (..., tens, 10, 3)."""
    means = blocks.mean(axis=-2)
    away = np.linalg.norm(blocks - means[..., None, :], axis=-1)
    return np.linalg.norm(means, axis=-1), away.mean(axis=-1) + 3.0 * away.std(axis=-1, ddof=1)


def _largest(accuracy: Floats, repeatability: Floats) -> tuple[Floats, Floats]:
    """Return the largest changes of both (..., tens) since the first ten readings: (...)."""
    first, second = (np.abs(one - one[..., :1]).max(axis=-1) for one in (accuracy, repeatability))
    return first, second
