"""Run-out over speed without a phase: what repeats tell, and what they cannot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.kinds.rotation._heads import OVER_SPEED, figure_of
from dtwin.kinds.rotation._laws import CONSTANT, FEWEST_SPEEDS, Law, groups_of, law_of
from dtwin.schema import Floats, Run
from dtwin.statistics import f_tail
from dtwin.units import shown_number

_CHANCE = 0.01
_FAR = 12.0
"""Times the usual distance from the others of its speed that a spoilt reading has at least."""
_FEWEST_ALIKE = 3
_BETTER = 0.5
_SETTLING = (0.1, 0.25, 0.5)
"""Time constants of a warm-up that are tried beside a straight line, of the whole time."""
_SPREAD = 0.3
"""Part of the whole spread of times that repeats of one speed must have."""
_FEWEST_NEIGHBOURS = 8


@dataclass(frozen=True)
class _SpeedGroup:
    """Run-outs at one speed, in µm."""

    speed_rpm: float
    runout_um: Floats


@dataclass(frozen=True)
class _RunOut:
    """Run-outs of a probe over speed.

    ``repeat_um``: standard deviation of one run-out by repeats, NaN without.
    ``differs_p``: probability that speeds alike differ as much, by the repeats; NaN without.
    ``unexplained_p``: the same of what the law leaves.
    ``time_um``: how much run-outs of one speed change from the first to the last; 0 where repeats do not show it. It is taken out before speeds
    are compared.
    ``clock``: whether the table has one, or its rows are taken in their order.
    ``smooth_p``: without repeats, probability that neighbouring speeds are as alike by chance; NaN else, and of few speeds.
    """

    run_id: str
    probe: str
    groups: tuple[_SpeedGroup, ...]
    repeat_um: float
    dof: int
    differs_p: float
    law: Law | None
    unexplained_p: float
    time_um: float
    clock: bool
    smooth_p: float


def groups_in(run: Run) -> tuple[_SpeedGroup, ...]:
    """Return the run-outs of a table by speed, ascending, without those that are spoilt."""
    sound = ~spoilt(run)
    speed, runout = run.samples["speed_rpm"][sound], run.samples["runout_um"][sound]
    group = groups_of(speed)
    return tuple(_SpeedGroup(float(speed[group == g].mean()), runout[group == g]) for g in np.unique(group))


def spoilt(run: Run) -> NDArray[np.bool_]:
    """Return which run-outs stand far off at least two others of their speed; no more than one of a speed is taken for such."""
    speed, runout = run.samples["speed_rpm"], run.samples["runout_um"]
    group = groups_of(speed)
    off = np.full(len(runout), np.nan)
    for g in np.unique(group):
        own = np.flatnonzero(group == g)
        if len(own) >= _FEWEST_ALIKE:
            off[own] = [abs(runout[n] - np.median(runout[own[own != n]])) for n in own]
    if not np.isfinite(off).any():
        return np.zeros(len(runout), dtype=np.bool_)
    # Equal readings are no nearer than the display tells.
    steps = np.diff(np.unique(runout))
    usual = max(float(np.nanmedian(off)), float(steps.min()) / 2.0 if steps.size else 0.0)
    far = off > _FAR * usual
    for g in np.unique(group[far]):
        own = np.flatnonzero(far & (group == g))
        # Beside one that is far off, a half of few others is, too.
        worst = own[np.argmax(off[own])]
        far[own] = own == worst
    return far


def is_over_speed(run: Run) -> bool:
    """Return whether a run is a table of run-outs."""
    return run.meta.condition.get("form") == OVER_SPEED or "runout_um" in run.samples


def run_outs(runs: Sequence[Run]) -> list[_RunOut]:
    """Return what the tables of run-outs tell."""
    return [_told(run) for run in runs if is_over_speed(run) and not any(f.severity == "error" for f in run.findings)]


def _told(run: Run) -> _RunOut:
    sound = ~spoilt(run)
    speed, runout, t_s = (run.samples[name][sound] for name in ("speed_rpm", "runout_um", "t_s"))
    groups = groups_in(run)
    dof = sum(len(g.runout_um) - 1 for g in groups)
    repeats = sum(float(np.sum((g.runout_um - g.runout_um.mean()) ** 2)) for g in groups)
    scatter = math.sqrt(repeats / dof) if dof else float("nan")
    moved = _with_time(runout, groups_of(speed), t_s, dof)
    rest = runout - moved
    group = groups_of(speed)
    means = np.array([rest[group == g].mean() for g in group])
    within, free = float(np.sum((rest - means) ** 2)), max(dof - 2 * bool(moved.any()), 0)
    variance = within / free if free else float("nan")
    differs = float("nan")
    if free and len(groups) > 1:
        between = float(np.sum((means - rest.mean()) ** 2)) / (len(groups) - 1)
        differs = f_tail(between / max(variance, 1e-300), (len(groups) - 1.0, float(free)))
    law = None
    unexplained = differs
    if len(groups) >= FEWEST_SPEEDS and runout.max() > 0.0 and speed.max() > 0.0:
        # A change with time that repeats show is taken out: it is no rival.
        law = law_of(rest[:, None], speed, np.zeros_like(t_s) if moved.any() else t_s, variance if free else 0.0)
    if law is not None and law.name != CONSTANT and free and law.rivals[0] in ("speed", "square"):
        # What the means of the speeds are off the law.
        power = 1 if law.rivals[0] == "speed" else 2
        design = np.column_stack([np.ones(len(speed)), (speed / speed.max()) ** power])
        left = rest - design @ np.linalg.lstsq(design, rest, rcond=None)[0]
        lack = max(0.0, float(left @ left) - within) / max(len(groups) - 2, 1)
        unexplained = f_tail(lack / max(variance, 1e-300), (max(len(groups) - 2.0, 1.0), float(free)))
    return _RunOut(
        run.meta.run_id,
        str(run.meta.condition.get("probe", run.meta.run_id)),
        groups,
        scatter,
        dof,
        differs,
        law,
        unexplained,
        float(np.ptp(moved)),
        all(f.code != "clock.assumed" for f in run.findings),
        float("nan") if dof else _smooth_p(np.array([float(g.runout_um.mean()) for g in groups])),
    )


def _with_time(runout: Floats, group: Floats, t_s: Floats, dof: int) -> Floats:
    """Return what run-outs of one speed change by with time, about its mean: a straight line, or a warm-up; zeros where repeats do not show it."""
    nothing = np.zeros_like(runout)
    span = float(np.ptp(t_s))
    if dof < _FEWEST_ALIKE + 1 or span <= 0.0:
        return nothing
    share = (t_s - t_s.min()) / span
    shapes = [share, *(1.0 - np.exp(-share / tau) for tau in _SETTLING)]

    def inside(values: Floats) -> Floats:
        return np.asarray(values - np.array([values[group == g].mean() for g in group]))

    own = inside(runout)
    whole, best, left = float(own @ own), nothing, float(own @ own)
    for shape in shapes:
        along = inside(shape)
        # Repeats that follow each other at once tell nothing of the whole time.
        if (
            along @ along > _SPREAD * float(np.sum((shape - shape.mean()) ** 2))
            and (rest := whole - (along @ own) ** 2 / (along @ along)) < left
        ):
            left, best = float(rest), (along @ own) / (along @ along) * (shape - shape.mean())
    ratio = (whole - left) / 2.0 / max(left / (dof - 2), 1e-300)
    return best if left < _BETTER * whole and f_tail(ratio, (2.0, dof - 2.0)) < _CHANCE else nothing


def _smooth_p(means: Floats) -> float:
    """Return how probable it is that values differ as little from their neighbours by chance (von Neumann's ratio)."""
    n = len(means)
    whole = float(np.sum((means - means.mean()) ** 2))
    if n < _FEWEST_NEIGHBOURS or whole <= 0.0:
        return float("nan")
    ratio = float(np.sum(np.diff(means) ** 2)) / whole
    return 0.5 * math.erfc((2.0 - ratio) / math.sqrt(8.0 * (n - 2) / (n**2 - 1)))


def runout_sentences(told: _RunOut) -> list[tuple[str, str, str]]:
    """Return code, severity and text of what a table of run-outs tells."""
    first, last = told.groups[0], told.groups[-1]
    largest = max(told.groups, key=lambda g: float(g.runout_um.mean()))
    means = [float(g.runout_um.mean()) for g in told.groups]
    span = f"{first.speed_rpm:g} to {last.speed_rpm:g} rpm"
    symbol, figure = figure_of(told.probe)
    no_phase = (
        f"{'a run-out' if symbol == 'TIR' else 'this figure'} has neither phase nor mean: unbalance, a bearing that runs warm, loss of preload and the form of the target are not told "
        "apart by it; log the displacement with the angle"
    )
    changes = told.law is not None and told.law.name != CONSTANT
    moved = max(means) - min(means)
    inside = largest not in (first, last)
    out = []
    time = "the time (warming, or wear)" if told.clock else "the order of the rows (warming, or wear)"
    if told.time_um > 0.0:
        said = f"{told.probe}: at one speed {figure} changes by {shown_number(told.time_um)} µm with {time}"
        out.append(("rotation.runout_time", "warning", said))
    if len(told.groups) < 2:
        return out
    if not told.dof and not changes and told.smooth_p < _CHANCE:
        looks = "; a resonance looks so: measure between its neighbours" if inside else ""
        said = (
            f"{told.probe}: {figure} differs by {shown_number(moved)} µm between speeds, and neighbouring speeds are alike, as chance hardly leaves them; it is "
            f"largest at {largest.speed_rpm:g} rpm ({shown_number(max(means))} µm){looks}; measure every speed again"
        )
        return [("rotation.runout_peak" if inside else "rotation.runout_differs", "warning", said)]
    if not told.dof and not changes:
        said = f"{told.probe}: {figure} differs by {shown_number(moved)} µm between speeds; without repeats nobody knows whether it changes with them"
        return [("rotation.runout_unknown", "info", said)]
    if not changes and not told.differs_p < _CHANCE:
        if out:
            return out
        return [
            (
                "rotation.runout_constant",
                "info",
                f"{told.probe}: from {span} {figure} changes by no more than its repeats do ({shown_number(moved)} µm between means)",
            )
        ]
    if changes and told.law is not None:
        words = {"speed": "the speed", "square": "the square of the speed", "time": time}
        named = " or ".join(words[name] for name in told.law.rivals)
        more = "" if told.law.name else "; which, cannot be told with these speeds"
        code = "rotation.runout_time" if told.law.rivals == ("time",) else "rotation.runout_speed"
        out.append(
            (
                code,
                "warning",
                f"{told.probe}: {figure} changes by {shown_number(told.law.change)} µm with {named}{more}; {no_phase}",
            )
        )
    if told.unexplained_p < _CHANCE and inside:
        text = (
            f"{told.probe}: {figure} differs between speeds by more than repeats and a steady law explain, and is largest at {largest.speed_rpm:g} rpm "
            f"({shown_number(max(means))} µm): a resonance looks so; measure between its neighbours"
        )
        out.append(("rotation.runout_peak", "warning", text))
    if not changes and all(code != "rotation.runout_peak" for code, _, _ in out):
        said = f"{told.probe}: {figure} differs between speeds by more than repeats do; {no_phase}"
        out.append(("rotation.runout_differs", "warning", said))
    return out
