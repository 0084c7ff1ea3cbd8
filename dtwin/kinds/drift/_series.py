"""A log as a series: what moved, of the tool, without the steps of a probe that was touched and of sensors that slipped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.drift._model import Series
from dtwin.schema import Floats, Run
from dtwin.statistics import usual_size

# A step of a probe: times the usual step, times the largest of so many beside it, of the whole range, and of it what stays;
# between readings that are not farther apart than so many times the usual.
_TIMES_USUAL, _TIMES_AROUND, _BESIDE, _OF_SPAN, _STAYS, _PAUSE = 10.0, 5.0, 6, 0.05, 0.7, 3.0
# Steps of a sensor that slipped; what is beyond was told as it was read.
_SLIP_C, _OTHER_UNIT_C = 1.0, 10.0


@dataclass(frozen=True)
class _Shift:
    """A reading that stepped and stayed, µm or K: a probe that was touched, a sensor that slipped. ``at_s``: of the first behind it."""

    at_s: float
    size: float


def series_of(run: Run, *, as_read: bool = False) -> Series:
    """Return a run as a series, without the steps of a touched probe and of sensors that slipped unless ``as_read``.

    What follows a sensor that slipped is so named only where it holds apart from the step.
    """
    temperatures = {n: v for n, v in run.samples.items() if n.startswith("temperature_")}
    sample = run.samples.get("sample_1")
    whole = None if sample is None else np.round(sample).astype(int)
    series = Series(run.samples["t_s"], moved_um(run), temperatures, whole)
    return series if as_read else _without_steps(series)


def _without_steps(series: Series) -> Series:
    """Return a series without the steps of a touched probe and of sensors that slipped."""
    steps, slipped = shifts(series), slips(series)
    straight = {
        channel: _without(series.t_s, values, slipped.get(channel, ()))
        for channel, values in series.temperatures_c.items()
    }
    at_s = {step.at_s for steps_of_one in (steps, *slipped.values()) for step in steps_of_one}
    return replace(
        series,
        moved_um=_without(series.t_s, series.moved_um, steps),
        temperatures_c=straight,
        touched_s=tuple(sorted(at_s)),
    )


def _without(t_s: Floats, values: Floats, steps: Sequence[_Shift]) -> Floats:
    """Return readings without steps."""
    for step in steps:
        values = values - step.size * (t_s >= step.at_s)
    return values


def shifts(series: Series) -> list[_Shift]:
    """Return the steps that heat does not make: far beyond all steps around, without a pause, and for good."""
    label = np.arange(len(series.t_s)) if series.sample is None else np.unique(series.sample, return_inverse=True)[1]
    count = np.bincount(label)
    t_s, moved = (np.bincount(label, values) / count for values in (series.t_s, series.moved_um))
    if len(moved) < 2 * _BESIDE:
        return []
    steps, pauses = np.diff(moved), np.diff(t_s)
    span = float(np.subtract(*np.percentile(moved, [98.0, 2.0])))
    usual = usual_size(steps - np.median(steps))
    large = np.abs(steps) > max(_TIMES_USUAL * usual, _OF_SPAN * span)
    shifted = []
    for i in map(int, np.flatnonzero(large & (pauses > 0.0) & (pauses <= _PAUSE * np.median(pauses)))):
        begin, end = i + 1 - _BESIDE, i + 1 + _BESIDE
        if begin < 0 or end > len(moved):
            continue
        near, around = slice(begin, end), np.delete(np.abs(steps[begin : end - 1]), _BESIDE - 1)
        if np.abs(steps[i]) < _TIMES_AROUND * around.max():
            continue
        time = t_s[near] - t_s[i + 1]
        columns = np.column_stack([np.ones(len(time)), time, time >= 0.0])
        size = float(np.linalg.lstsq(columns, moved[near], rcond=None)[0][2])
        if size / steps[i] > _STAYS:
            shifted.append(_Shift(float(series.t_s[label == i + 1].min()), size))
    return shifted


def slips(series: Series) -> dict[str, list[_Shift]]:
    """Return the steps of sensors that stepped alone between two readings and stayed: what heats a machine steps no sensor so, or
    several.
    """
    slipped: dict[str, list[_Shift]] = {}
    for channel, values in series.temperatures_c.items():
        for step in shifts(replace(series, moved_um=values)):
            at = int(np.flatnonzero(series.t_s == step.at_s)[0])
            others = [np.abs(v[at] - v[at - 1]) for name, v in series.temperatures_c.items() if name != channel]
            if _SLIP_C <= abs(step.size) <= _OTHER_UNIT_C and max(others, default=0.0) < 0.5 * abs(step.size):
                slipped.setdefault(channel, []).append(step)
    return slipped


def sense(condition: Mapping[str, Any], where: str) -> float:
    """Return 1 for displacements of the tool, -1 for positions at which a probe triggers: the tool has moved the other way.

    Raises ``InputError`` when ``reads`` of the condition is neither.
    """
    reads = condition.get("reads", "displacement")
    if reads not in ("displacement", "position"):
        raise InputError(
            "what the log reads is not known",
            code="drift.reads",
            where=where,
            got=f"reads = {reads!r}"[:60],
            allowed='condition = { reads = "displacement" }: of the tool along its axis; "position": of the machine when a probe triggers',
        )
    return -1.0 if reads == "position" else 1.0


def moved_um(run: Run) -> Floats:
    """Return the tool's displacement of each reading, (n,)."""
    return sense(run.meta.condition, run.meta.run_id) * run.samples["displacement_um"]
