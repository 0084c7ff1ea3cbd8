"""Test sheet of positioning tests after ISO 230-2, with the scatter that its figures would have again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.linear import linear_figures, stacked_figures
from dtwin.positioning._spoilt import spoilt_finding
from dtwin.positioning.check import by_axis
from dtwin.positioning.matrix import LinearTest, linear_test, other_formulas_um
from dtwin.positioning.ways import BOTH, LENGTHS, Scale, Ways, can_be_told, ways_of
from dtwin.report.plots import error_figure
from dtwin.report.sheet import Characteristic, Part, Sheet, sound_runs
from dtwin.report.uncertainty import Contribution
from dtwin.schema import Floats, Run
from dtwin.statistics import shared_variances, times_simulated
from dtwin.units import shown_number

if TYPE_CHECKING:
    import plotly.graph_objects as go


_Asked = Callable[[LinearTest], list[str]]
_Uncertain = Callable[[str, LinearTest], tuple[Contribution, ...]]
_FIGURES = (
    ("A", "bi-directional accuracy", "accuracy_um"),
    ("A↑", "accuracy, forward", "accuracy_forward_um"),
    ("A↓", "accuracy, reverse", "accuracy_backward_um"),
    ("R", "bi-directional repeatability", "repeatability_um"),
    ("R↑", "repeatability, forward", "repeatability_forward_um"),
    ("R↓", "repeatability, reverse", "repeatability_backward_um"),
    ("E", "bi-directional systematic deviation", "systematic_um"),
    ("E↑", "systematic deviation, forward", "systematic_forward_um"),
    ("E↓", "systematic deviation, reverse", "systematic_backward_um"),
    ("B", "reversal error", "reversal_um"),
    ("B̄", "mean reversal error", "mean_reversal_um"),
    ("M", "mean bi-directional deviation", "mean_deviation_um"),
)


def positioning_sheet(runs: Sequence[Run], asked: _Asked, uncertain: _Uncertain, scale: Scale = LENGTHS) -> Sheet:
    """Evaluate every axis of a campaign.

    ``runs``: with all columns; runs with an error of quality are left out where there are others, and named. Runs of one
    direction are evaluated, in that direction, where an axis has no others.
    ``asked``: returns what the standard asks for and a test has not, and what else is to be noted of it.
    ``uncertain``: returns what makes a figure of a test uncertain, by its symbol.
    """
    tests = by_axis(runs)
    evaluated = {id(run) for _, alike in tests for run in alike}
    parts: list[Part] = []
    notes = [f"{r.meta.run_id} is not evaluated: it has one direction only." for r in runs if id(r) not in evaluated]
    for ways, every in sorted(tests, key=lambda test: (str(test[1][0].meta.condition.get("axis", "Z")), test[0])):
        title = f"axis {every[0].meta.condition.get('axis', 'Z')}" + ("" if ways == BOTH else f", {ways[0]} only")
        part, said = _evaluated(title, every, ways, asked, uncertain, scale)
        parts += [] if part is None else [part]
        notes += said
    basis = "the figures of tests made again from what runs differ by as wholes and at each target (unit of replication: the run)"
    return Sheet("ISO 230-2, positioning", "A", tuple(parts), basis, tuple(notes), unit=scale.figure)


def evaluated_tests(runs: Sequence[Run], scale: Scale = LENGTHS) -> list[LinearTest]:
    """Return the test of each axis that was approached from both sides, of the runs that the sheet evaluates."""
    return [linear_test(sound_runs(alike)[0], ways, scale) for ways, alike in by_axis(runs) if ways == BOTH]


def _evaluated(
    title: str, every: Sequence[Run], ways: Ways, asked: _Asked, uncertain: _Uncertain, scale: Scale
) -> tuple[Part | None, list[str]]:
    members, notes = sound_runs(every)
    sound = not any(f.severity == "error" for run in members for f in run.findings)
    test = linear_test(members, ways, scale)
    if not test.position_mm.size:
        return None, [*notes, f"{title} is not evaluated: its runs share no target."]
    span = f"{test.position_mm[0]:g} to {test.position_mm[-1]:g} {scale.unit}"
    spoilt = spoilt_finding(test)
    if spoilt is not None:
        sound = False
        notes.append(f"{title}: {spoilt.message}.")
    if test.left_out:
        many = "1 target is" if test.left_out == 1 else f"{test.left_out} targets are"
        sides = " from both sides" if ways == BOTH else ""
        notes.append(f"{title}: {many} not evaluated, for not every run read them{sides}.")
    setups = list(dict.fromkeys(run.meta.setup for run in members))
    if len(setups) > 1:
        notes.append(
            f"{title}: these are runs of {len(setups)} set-ups ({', '.join(setups)[:60]}), evaluated as one test: R and A hold what the mountings differ by. "
            "A test is made in one set-up: make a campaign of each."
        )
    if ways == BOTH and len(members) > 1:
        notes += _other_formulas(test, title)
    notes += [f"{title}: {said}." for said in asked(test)]
    stated = {f.message for run in members for f in run.findings if f.code.endswith(".stated_figures")}
    notes += [f"{title}: {message}." for message in sorted(stated)]
    targets = "1 target" if len(test.position_mm) == 1 else f"{len(test.position_mm)} targets"
    ids = tuple(run.meta.run_id for run in members)
    return Part(f"{title}, {span}, {targets}", ids, _figures(test, ways, uncertain), sound), notes


def _figures(test: LinearTest, ways: Ways, uncertain: _Uncertain) -> tuple[Characteristic, ...]:
    n = test.forward_um.shape[1]
    named = [figure for figure in _FIGURES if can_be_told(figure[0], ways, n)]
    if n == 1:
        # Of single readings means are known, and what runs differ by is not.
        twice = (np.repeat(errors, 2, axis=1) for errors in (test.forward_um, test.reverse_um))
        told = asdict(linear_figures(*twice))
        scatter, dof = dict.fromkeys(told, math.nan), 0.0
    else:
        told = asdict(linear_figures(test.forward_um, test.reverse_um))
        forward, reverse, dof = _made_again(test, one_way=ways != BOTH)
        drawn = stacked_figures(forward, reverse)
        scatter = {key: float(np.std(drawn[key], ddof=1)) for key in told}
    return tuple(
        Characteristic(symbol, name, told[key], 1, scatter[key], dof, contributions=uncertain(symbol, test))
        for symbol, name, key in named
    )


def _other_formulas(test: LinearTest, title: str) -> list[str]:
    """Return what R and E would be by formulas that some reports use instead of the standard's, where they differ."""
    told, other = linear_figures(test.forward_um, test.reverse_um), other_formulas_um(test.forward_um, test.reverse_um)
    larger, narrow = other["R"], other["E"]
    said = []
    if larger < 0.995 * told.repeatability_um:
        said.append(
            f"R as the larger of R↑ and R↓ would be {shown_number(larger, 4)} {test.scale.fine}; the standard's has the reversal in it"
        )
    if narrow < 0.995 * told.systematic_um:
        said.append(
            f"E from the higher of both minima would be {shown_number(narrow, 4)} {test.scale.fine}; the standard takes the lowest of all means"
        )
    return [f"{title}: {'; '.join(said)}."] if said else []


def positioning_figure(runs: Sequence[Run], scale: Scale = LENGTHS) -> go.Figure:
    """Draw the mean of each direction over the position, with two standard deviations of the runs at each target."""
    ways = ways_of(runs[0])
    test = linear_test(runs, ways, scale)
    if not test.position_mm.size:
        raise InputError("no target was read in every run from both sides", code="sheet.targets")
    count = "1 run" if len(runs) == 1 else f"{len(runs)} runs ± 2 s"
    # Of one direction both are the same.
    errors = {f"{way}, mean of {count}": e for way, e in zip(ways, (test.forward_um, test.reverse_um), strict=True)}
    figure = error_figure(
        {name: (test.position_mm, error.mean(axis=1)) for name, error in errors.items()},
        title=f"Deviation of axis {test.axis}",
        x_title=f"position, {scale.unit}",
        y_title=f"deviation, {scale.fine}",
    )
    for trace, error in zip(figure.data, errors.values(), strict=True):
        trace.update(mode="lines+markers", marker_size=5)
        if len(runs) > 1 and len(trace.y) == len(error):
            trace.error_y = {"array": 2.0 * error.std(axis=1, ddof=1), "width": 2, "thickness": 1}
    if scale.turn and np.ptp(test.position_mm) > scale.turn / 2:
        figure.update_xaxes(dtick=scale.turn / 8)
    return figure


def _made_again(test: LinearTest, *, one_way: bool = False) -> tuple[Floats, Floats, float]:
    """Return readings of tests like this one, forward and reverse, (tests, targets, runs) each, and the degrees of freedom.

    A run differs from the others by a shift and a stretch of all its readings, as by warming, by what moves between there
    and back, and by the scatter of each reading. A shift that all targets of a run share makes R no less certain than that of one target, and moves no range of
    means: drawn target by target it would count for the one too little and for the other too much.

    ``one_way``: whether both directions are the same readings.
    """
    rng = np.random.default_rng(0)
    ways = [test.forward_um] if one_way else [test.forward_um, test.reverse_um]
    every = np.concatenate(ways)
    mean = every.mean(axis=1, keepdims=True)
    moved = every - mean
    along = _along(test.position_mm, len(ways))
    size, rest = _wholes(moved, along)
    runs = every.shape[1]
    scatter, own = _scatter(rest, along.shape[1])
    if not one_way:
        mean = _calm(mean, 2.0 * float(scatter.mean()) / runs)
    count = times_simulated(every.size)
    drawn = mean + np.sqrt(scatter)[:, None] * rng.standard_normal((count, *every.shape))
    drawn = drawn + along @ (size[:, None] * rng.standard_normal((count, along.shape[1], runs)))
    parts = np.split(drawn, len(ways), axis=1)
    whole = float((along**2 @ size**2).mean())
    share = whole / max(whole + float(scatter.mean()), 1e-12)
    of_all = len(every) - along.shape[1]
    of_scatter = (1.0 - own) / of_all + own / min(len(ways), of_all)
    return parts[0], parts[-1], (runs - 1.0) / (share**2 + (1.0 - share) ** 2 * of_scatter)


def _calm(mean: Floats, chance: float) -> Floats:
    """Return means (readings, 1), forward before reverse, whose reversals differ as much as those of the axis surely do.

    About means as they are, the largest reversal would stand out twice: by its own scatter, and by what is drawn.

    ``chance``: variance of a reversal by the scatter of readings.
    """
    forward, reverse = np.split(mean, 2)
    reversal = reverse - forward
    differ = float(reversal.var(ddof=1)) if len(reversal) > 1 else 0.0
    kept = np.sqrt(max(0.0, 1.0 - chance / differ)) if differ > 0.0 else 1.0
    less = (1.0 - kept) * (reversal - reversal.mean()) / 2.0
    return np.concatenate([forward + less, reverse - less])


def _along(position_mm: Floats, ways: int) -> Floats:
    """Return what a shift and a stretch of a run, and what moves between there and back, do to its readings.

    (readings, 3); fewer columns of few readings, or of one direction.
    """
    half = max(float(np.ptp(position_mm)) / 2.0, 1e-9)
    stretch = (position_mm - position_mm.mean()) / half
    columns = np.stack([np.ones(len(position_mm)), stretch], axis=1)[:, : max(len(position_mm) * ways - 1, 0)]
    both = np.tile(columns[:, : 1 if len(position_mm) < 3 else 2], (ways, 1))
    back = np.repeat([[-0.5], [0.5]], len(position_mm), axis=0) if ways > 1 and len(position_mm) > 2 else both[:, :0]
    return np.concatenate([both, back], axis=1)


def _wholes(moved: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return the standard deviations of shift and stretch, without what scatter adds to them, and what they leave."""
    runs = moved.shape[1]
    if not along.shape[1]:
        return np.zeros(0), moved
    told = np.linalg.pinv(along)
    amounts = told @ moved
    rest = moved - along @ amounts
    scatter = float((rest**2).sum()) / ((len(moved) - along.shape[1]) * (runs - 1))
    variance = (amounts**2).sum(axis=1) / (runs - 1) - scatter * (told**2).sum(axis=1)
    return np.sqrt(np.maximum(variance, 0.0)), rest


def _scatter(rest: Floats, columns: int) -> tuple[Floats, float]:
    """Return the variance of each target and direction, as far as they surely differ, and the weight of a target's own."""
    readings, runs = rest.shape
    lost = readings / (readings - columns)
    own = lost * (rest**2).sum(axis=1) / (runs - 1)
    shared, weight = shared_variances(own, np.full(readings, runs - 1.0), float(own.mean()))
    return shared, float(weight.mean())
