"""Positioning tests along one axis, on the targets that all runs share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.grid import Grid, OneAxis, PathCondition, Row
from dtwin.physics.state import State
from dtwin.positioning.still import still
from dtwin.schema import Floats, Run, RunMeta
from dtwin.units import shown_number

_Way = Literal["forward", "reverse"]
WAYS: tuple[_Way, _Way] = ("forward", "reverse")
_FEWEST_TARGETS = 5
_ROUND_MM = 1e-4
_FEED_MM_MIN = 60.0
_NOT_LOGGED = ("t_s", "position_mm", "error_um", "direction", "laser_mm", "read_mm", "status_1")


@dataclass(frozen=True)
class Stroke(OneAxis):
    """A sweep along an axis, from one side.

    ``radius_mm``: half the stroke.
    ``feed_mm_min``: feed between targets; 60 where it is not stated, it then says nothing.
    ``direction``: ``forward`` or ``reverse``.
    """

    radius_mm: float
    feed_mm_min: float
    direction: _Way

    @property
    def sense(self) -> float:
        """+1 forward, -1 reverse."""
        return 1.0 if self.direction == "forward" else -1.0

    @property
    def turned(self) -> Stroke:
        """The same sweep from the other side."""
        return replace(self, direction="reverse" if self.direction == "forward" else "forward")

    @property
    def swept(self) -> Mapping[str, float]:
        """What campaigns change."""
        return {"feed": self.feed_mm_min}

    @property
    def seconds(self) -> float:
        """Time of the sweep without its stops."""
        return 2.0 * self.radius_mm / (self.feed_mm_min / 60.0)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {"axis": self.axis, "direction": self.direction, "feed_mm_min": self.feed_mm_min}

    def __str__(self) -> str:
        return f"{self.axis} {self.direction}"


def stroke_rows(runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
    """Put positioning runs on their common targets, every sweep a row.

    ``runs``: with ``position_mm``, ``direction`` and ``error_um``.
    ``times_h``: session time at the start of each run.
    Returns ``grid``: the targets.
    Returns ``rows``: for each run its sweep forward and its sweep back.
    Raises ``InputError`` when columns are missing, more than one axis moved, or the targets are too few or differ from
    run to run.
    """
    axis = _axis(runs)
    for run in runs:
        absent = {"position_mm", "direction", "error_um"} - set(run.samples)
        if absent:
            raise InputError(
                "a positioning run needs position_mm, direction and error_um",
                code="twin.columns",
                where=f"run {run.meta.run_id}",
                got=", ".join(run.samples),
            )
    runs = still(runs)
    of_runs = [np.round(run.samples["position_mm"] / _ROUND_MM).astype(np.int64) for run in runs]
    targets = np.unique(np.concatenate(of_runs))
    most = max(len(np.unique(positions)) for positions in of_runs)
    if len(targets) < _FEWEST_TARGETS or len(targets) > 2 * most:
        few = len(targets) < _FEWEST_TARGETS
        raise InputError(
            f"{len(targets)} targets are too few for a twin, which takes {_FEWEST_TARGETS}; the test sheet takes them"
            if few
            else "the runs have different targets",
            code="twin.targets",
            where=f"axis {axis}",
            got=f"{len(targets)} targets, {most} at most in a run",
            allowed=f"at least {_FEWEST_TARGETS}, the same in every run",
        )
    points = np.asarray(targets * _ROUND_MM, dtype=np.float64)
    half_mm = 0.5 * float(points[-1] - points[0])
    rows: list[Row] = []
    for run, positions, time_h in zip(runs, of_runs, times_h, strict=True):
        feed = run.meta.condition.get("feed_mm_min")
        feed_mm_min = float(feed) if isinstance(feed, int | float) else _FEED_MM_MIN
        for way in WAYS:
            here = np.asarray(run.samples["direction"] == way)
            if here.any():
                condition = Stroke(axis, half_mm, feed_mm_min, way)
                bins = np.searchsorted(targets, positions[here])
                rows.append(_row(run, condition, here, bins, len(targets), time_h))
    return _grid(points), rows


def _axis(runs: Sequence[Run]) -> str:
    axes = sorted({str(run.meta.condition.get("axis", "")) for run in runs})
    if len(axes) == 1 and axes[0] in ("X", "Y", "Z"):
        return axes[0]
    raise InputError(
        "a twin of positioning tests is about one axis",
        code="twin.axis",
        got=", ".join(a or "not stated" for a in axes),
        allowed="X, Y or Z, the same in all runs",
        hint='axis = "Z" under [run.condition]; a campaign for each axis',
    )


def _row(run: Run, condition: Stroke, here: Any, bins: Any, n_bins: int, time_h: float) -> Row:
    count = np.bincount(bins, minlength=n_bins)

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(bins, values, n_bins) / np.maximum(count, 1))

    numbers = {
        name: mean(np.asarray(values, dtype=float)[here])
        for name, values in run.samples.items()
        if name not in _NOT_LOGGED and not name.startswith(("cmd_", "act_"))
    }
    if not count.all():
        numbers = {name: _bridged(values, count) for name, values in numbers.items()}
    if "t_s" in run.samples:
        t_s = np.asarray(run.samples["t_s"], dtype=float)
        spent_h = _bridged(mean((t_s - t_s[0])[here]), count) / 3600.0
        numbers["time_h"] = time_h + spent_h
    columns = {"time_h": time_h, **run.meta.covariates, **numbers}
    y_um = mean(np.asarray(run.samples["error_um"], dtype=float)[here])
    return Row(run, condition, y_um, count > 0, columns, condition.feed_mm_min / 60.0)


def _bridged(values: Floats, count: Any) -> Floats:
    known = np.flatnonzero(count)
    return np.asarray(np.interp(np.arange(len(count)), known, values[known]))


def _grid(points: Floats) -> Grid:
    centre_mm = 0.5 * float(points[0] + points[-1])
    half_mm = 0.5 * float(points[-1] - points[0])
    step_mm = 2.0 * half_mm / (len(points) - 1)

    def state(meta: RunMeta, condition: PathCondition, feed_mm_s: float, geometry: Mapping[str, Any]) -> State:
        # Tests turn round beyond the last target, so that play is taken up there: ISO 230-2.
        return _state(points - centre_mm, half_mm + step_mm, condition, feed_mm_s, geometry)

    def wave(harmonic: int) -> str:
        if not harmonic:
            return "the same all along the axis"
        return f"a wave of {shown_number(len(points) * step_mm / harmonic, 4)} mm along the axis"

    return Grid(
        kind="linear",
        coordinate="position_mm",
        points=points,
        setup=np.ones((len(points), 1)),
        setup_names=("datum_um",),
        fine=1,
        averaged=lambda values: values,
        state=state,
        described=len(points),
        wave=wave,
    )


def _state(
    position_mm: Floats, turns_at_mm: float, condition: PathCondition, feed_mm_s: float, geometry: Mapping[str, Any]
) -> State:
    (axis,) = condition.axes
    n, sense = len(position_mm), condition.sense
    travelled_mm = turns_at_mm + sense * position_mm
    return State(
        kind="linear",
        axes=(axis,),
        plane="",
        position_mm={axis: position_mm},
        velocity_mm_s={axis: np.full(n, sense * feed_mm_s)},
        # The axis stands at each target.
        acceleration_mm_s2={axis: np.zeros(n)},
        sensitivity={axis: np.ones(n)},
        since_reversal_s={axis: travelled_mm / feed_mm_s},
        last_end={axis: np.full(n, -sense)},
        angle_rad=np.asarray((np.arange(n) + 0.5) * (2.0 * np.pi / n), dtype=np.float64),
        radius_mm=turns_at_mm,
        feed_mm_s=feed_mm_s,
        direction=sense,
        geometry=geometry,
    )
