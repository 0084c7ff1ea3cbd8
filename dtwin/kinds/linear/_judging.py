"""How positioning errors are judged by runs that were left out, what a champion leaves of recorded ones, and the errors of strokes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.kinds.linear._bundle import axis_number, told
from dtwin.kinds.linear._gates import along
from dtwin.kinds.linear._models import Unidirectional, averages_of
from dtwin.lake.store import Lake
from dtwin.positioning.matrix import LinearTest, linear_test
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from dtwin.train.champion_error import (
    ChampionError,
    Condition,
    HeldOut,
    RunError,
    as_served,
    held_out,
    require_inputs,
    require_trained,
)
from dtwin.train.results import Scores

HELD_OUT = "run"
# Parts of the travel, each in both directions, that no candidate may make worse.
_PARTS = 10


def without_run(test: LinearTest, run: int) -> LinearTest:
    """Return a test without one of its runs."""
    others = [k for k in range(test.forward_um.shape[1]) if k != run]
    return replace(test, forward_um=test.forward_um[:, others], reverse_um=test.reverse_um[:, others])


def runs_left_out(test: LinearTest, expected_um: Callable[[int], Floats]) -> Floats:
    """Leave out every run in turn; return what is left of it, shape (2 targets, runs).

    ``test``: two runs or more.
    ``expected_um``: given the number of the run that is left out, returns the errors in both directions that the others
    let expect, shape (2 targets,).
    """
    error = stacked(test)[2]
    return np.column_stack([error[:, k] - expected_um(k) for k in range(error.shape[1])])


def table_rms_um(test: LinearTest) -> float:
    """Return what a table and one backlash leave of runs left out: what a control can do by itself."""
    direction, position, _ = stacked(test)

    def table(run: int) -> Floats:
        averages = averages_of(without_run(test, run))
        return Unidirectional(averages).error_um(direction, position)

    return rms(runs_left_out(test, table))


def noise_floor_um(test: LinearTest) -> float:
    """Return what runs disagree by at the same target and direction: pooled standard deviation.

    ``test``: two runs or more; drift between the runs counts.
    """
    return _spread_um(np.vstack([test.forward_um, test.reverse_um]))


def scores_of(test: LinearTest, left: Floats) -> Scores:
    """Return scores of what is left of runs left out, shape (2 targets, runs), um."""
    direction, position, error = stacked(test)
    share = (position - position.min()) / (position.max() - position.min())
    part = np.minimum((share * _PARTS).astype(int), _PARTS - 1) + _PARTS * direction.astype(int)
    ratios = {}
    for k in np.unique(part):
        # The laser was zeroed at the first target: near it there is nothing but noise to take away.
        without = np.hypot(rms(error[part == k]), _spread_um(error[part == k]))
        inside = position[part == k]
        where = f"{'reverse' if k >= _PARTS else 'forward'}, {inside.min():z.0f} to {inside.max():z.0f} mm"
        ratios[where] = rms(left[part == k]) / without
    worst = max(ratios, key=lambda name: ratios[name])
    r2 = 1.0 - float(np.sum(left**2) / np.sum((error - error.mean()) ** 2))
    runs = error.shape[1]
    return Scores(HELD_OUT, r2, rms(left), float(np.mean(np.abs(left))), ratios[worst], worst, runs, runs)


def explained_share(error: Floats, left: Floats, floor: float) -> float:
    """Return the share of what the runs have in common that is explained in runs left out.

    Drift from run to run cannot be foretold: the mean of the other runs leaves the noise floor times
    the root of n / (n - 1), n being the number of runs.
    """
    runs = error.shape[1]
    common = float(np.var(error)) - floor**2
    missed = max(float(np.mean(left**2)) - floor**2 * runs / (runs - 1), 0.0)
    return 1.0 - missed / common if common > 0.0 else 0.0


def stacked(test: LinearTest) -> tuple[Floats, Floats, Floats]:
    """Return direction and position in mm, (2 targets,), and errors in um, (2 targets, runs)."""
    direction, position, _ = averages_of(test).stacked()
    return direction, position, np.vstack([test.forward_um, test.reverse_um])


def _spread_um(errors: Floats) -> float:
    """Return the pooled standard deviation over runs of errors, (targets, runs)."""
    return rms(errors.std(axis=1, ddof=1))


_BOTH = {"forward", "reverse"}


def strokes_error(lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, *_: object) -> ChampionError:
    """Return a bundle's error over all readings, the zero of the laser in each set-up taken out."""
    here = np.zeros(1)
    require_inputs(bundle, tuple(told(here, here)), ("base_x", "base_y", "base_z"), "the position of one axis")
    runs = [lake.load(row) for row in rows]
    moved = "XYZ"[axis_number(bundle)]
    runs = [run for run in runs if _axis(run) == moved]
    require_trained([{"condition_json": f'{{"axis": "{moved}"}}'}], rows, "axis")
    parts = [_served(bundle, run) for run in runs]
    setups = [run.meta.setup for run in runs]
    measured = [run.samples["error_um"] for run in runs]
    left = [error - served for error, (served, _) in zip(measured, parts, strict=True)]
    both = [run for run in runs if set(run.samples["direction"]) == _BOTH]
    return ChampionError(
        rms_um=rms(_without_zero(left, setups)),
        before_um=rms(_without_zero(measured, setups)),
        noise_floor_um=noise_floor_um(linear_test(both)) if len(both) > 1 else float("nan"),
        outside_box_share=float(np.mean(np.concatenate([outside for _, outside in parts]))),
        n_runs=len(runs),
    )


def strokes_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with runs left out, on the axis that was trained."""
    require_trained(known, fresh, "axis")
    return held_out(HELD_OUT)


def _served(bundle: Bundle, run: Run) -> tuple[Floats, Any]:
    """Return the error that serving takes away at each reading of a run, and where it takes none."""
    place = np.asarray(run.samples["position_mm"], float)
    way = (run.samples["direction"] == "reverse").astype(float)
    return as_served(bundle, told(place, way), along(bundle, place))


def _without_zero(errors: Sequence[Floats], setups: Sequence[str]) -> Floats:
    parts = [
        np.concatenate([e for e, own in zip(errors, setups, strict=True) if own == setup]) for setup in set(setups)
    ]
    return np.concatenate([part - part.mean() for part in parts])


def _axis(run: Run) -> str:
    return str(run.meta.condition.get("axis", "Z"))


def stroke_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of strokes along an axis.

    The zero of a laser is arbitrary: the mean over both directions is no error.
    """
    errors = []
    for number, run in enumerate(runs):
        middle = float(np.mean(run.samples["error_um"]))
        axis = str(run.meta.condition.get("axis", ""))
        for way in sorted({str(d) for d in run.samples["direction"]}):
            chosen = run.samples["direction"] == way
            place, error = run.samples["position_mm"][chosen], run.samples["error_um"][chosen]
            rest = error[np.argsort(place)] - middle
            condition: Condition = {
                "axis": axis,
                "approached": way,
                "targets": float(len(place)),
                "from_mm": round(float(place.min()), 2),
                "to_mm": round(float(place.max()), 2),
            }
            errors.append(RunError(number, condition, way, rms(rest), rest))
    return errors
