"""What thermal models of error motions are worth in a campaign that they never saw: distances, jobs, slots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import coefficient, design
from dtwin.kinds.volumetric._evidence import changes_left_um, distance_changes_um, predicted
from dtwin.kinds.volumetric._session import REFERENCE_CYCLES, Session, Strokes
from dtwin.kinds.volumetric._thermal_model import ThermalModel, fit_thermal, inflation
from dtwin.kinds.volumetric._training import serving_bundle
from dtwin.lake.store import Lake
from dtwin.schema import Floats
from dtwin.serve.bundle_file import save_bundle
from dtwin.statistics import rms
from studies.thermal_memory import fit_remembering

# An error motion is unexplained when a model takes away less than this of what can be seen.
_UNEXPLAINED_PCT = 40.0
_HALVED = 0.5
_SEEN = 4.0
_SLOTS = 16


def with_offered(measured: Session, offered: Sequence[str]) -> Session:
    """Return a session whose models may use other logged temperatures, too.

    Raises ``InputError`` when one was not logged.
    """
    absent = [name for name in offered if name not in measured.offered_c]
    if absent:
        raise InputError(
            "no such temperature was logged beside the thermocouples",
            code="volumetric.offered",
            where=measured.campaign,
            got=", ".join(absent)[:120],
            allowed=", ".join(measured.offered_c) or "none was",
        )
    rises = [measured.offered_rise(name) for name in offered]
    more = np.column_stack([measured.rise_c, *rises])
    read = [measured.offered_c[name][:REFERENCE_CYCLES].mean() for name in offered]
    begun = np.concatenate([measured.begun_c, np.asarray(read, dtype=np.float64)])
    return replace(measured, sensors=(*measured.sensors, *offered), rise_c=more, begun_c=begun)


def models_of(
    training: Session, *, offered: Sequence[str] = (), static: bool = False
) -> tuple[list[ThermalModel], Session]:
    """Fit a thermal model to every error motion; return them and the session with what was offered.

    ``offered``: other logged temperatures that may be used, too.
    ``static``: without memory.
    """
    whole = with_offered(training, offered)
    names = whole.artefact.names
    fit = fit_thermal if static else fit_remembering
    made = [fit(name, whole.values[:, i], whole.rise_c, whole.sensors) for i, name in enumerate(names)]
    return made, whole


def judged(models: Sequence[ThermalModel], measured: Session, training: Session | None = None) -> dict[str, Any]:
    """Compare the models with a campaign.

    ``measured``: another campaign than that of the fit, when the figures shall say anything.
    ``training``: the campaign of the fit: causes of what is unexplained are fitted there, and judged here.
    Returns ``distances`` between balls, ``coefficients``, ``lines`` (how much an error changes in how long), ``slots``,
    ``unexplained`` and ``worse``.
    """
    expected = predicted(models, measured)
    left = measured.values - expected
    rows = [_row(model, measured, i, left[:, i]) for i, model in enumerate(models)]
    lines = _lines(measured, left)
    return {
        "campaign": measured.campaign,
        "cycles": len(measured.hour),
        "sensors": len(measured.sensors),
        "dropped": list(measured.dropped),
        "identified_um": _mean([found.left_um for found in measured.found]),
        "held_out_poses_um": _mean([found.held_out_um for found in measured.found]),
        "distances": _distances(measured, expected),
        "coefficients": rows,
        "lines": lines,
        "slots": _slots(measured, left),
        "unexplained": [
            _unexplained(models[i], i, training, measured, row["rms_left_um"])
            for i, row in enumerate(rows)
            if _is_unexplained(row)
        ],
        "worse": [row["name"] for row in rows if row["rms_reduction_pct"] < 0.0],
    }


def _is_unexplained(row: Mapping[str, Any]) -> bool:
    return bool(row["rms_reduction_pct"] < _UNEXPLAINED_PCT and row["rms_um"] > _SEEN * row["uncertainty_um"])


def _unexplained(
    model: ThermalModel, column: int, training: Session | None, measured: Session, left_um: float
) -> dict[str, Any]:
    """Name the logged temperature that, fitted in one campaign, halves what is left in the other."""
    out: dict[str, Any] = {"name": model.name, "cause": None, "tried": []}
    if training is None:
        return out
    own = training.rise_of(model.sensors)
    for channel in training.offered_c:
        if channel not in measured.offered_c:
            continue
        with_it = np.column_stack([own, training.offered_rise(channel)])
        per_k = np.linalg.lstsq(with_it, training.values[:, column], rcond=None)[0]
        there = np.column_stack([measured.rise_of(model.sensors), measured.offered_rise(channel)])
        after = rms(measured.values[:, column] - there @ per_k)
        out["tried"].append({"channel": channel, "left_um": after})
    best = min(out["tried"], key=lambda t: t["left_um"], default=None)
    if best is not None and best["left_um"] < _HALVED * left_um:
        out["cause"] = best["channel"]
    return out


def _row(model: ThermalModel, measured: Session, column: int, left: Floats) -> dict[str, Any]:
    values = measured.values[:, column]
    before, after = rms(values), rms(left)
    used = measured.rise_of(model.sensors)
    return {
        "name": model.name,
        "unit": coefficient(model.name).unit,
        "p2p_um": float(np.ptp(values)),
        "p2p_left_um": float(np.ptp(left)),
        "rms_um": before,
        "rms_left_um": after,
        "rms_reduction_pct": reduction_pct(before, after),
        "uncertainty_um": _mean([found.uncertainty[column] for found in measured.found]),
        "sensors": list(model.sensors),
        "memory": getattr(model, "memory", 0.0),
        "largest_inflation": float(inflation(used).max(initial=1.0)),
    }


def _distances(measured: Session, expected: Floats) -> dict[str, float]:
    """Return how distances between balls change, before and after; fitted and held-out poses."""
    was = np.concatenate([distance_changes_um(where, moved) for where, moved in measured.moved])
    is_now = np.concatenate(changes_left_um(measured, expected))
    return {
        "p2p_um": float(np.ptp(was)),
        "p2p_left_um": float(np.ptp(is_now)),
        "p2p_reduction_pct": reduction_pct(float(np.ptp(was)), float(np.ptp(is_now))),
        "rms_um": rms(was),
        "rms_left_um": rms(is_now),
        "rms_reduction_pct": reduction_pct(rms(was), rms(is_now)),
    }


def _lines(measured: Session, left: Floats) -> list[dict[str, Any]]:
    """Return how much the error along a line of each axis changes within jobs of every length."""
    step_h = float(np.median(np.diff(measured.hour)))
    steps = sorted({s for s in (1, 2, 3, 5, 8, 12, 16, 20, 30, 40, 60, 100, len(left) - 1) if s < len(left)})
    out = []
    for axis in "xzy":
        place = _line_mm(dict(measured.artefact.strokes_mm), axis)
        unit = design(place, measured.artefact.strokes_mm, measured.artefact.names)
        for number, direction in enumerate("xyz"):
            series = [v @ unit[:, number].T for v in (measured.values, left)]
            before, after = (interval_curve(s, steps) for s in series)
            worse = [step_h * s for s in worse_steps(before, after)]
            out.append(
                {
                    "line": axis.upper(),
                    "direction": direction.upper(),
                    "hours": [step_h * s for s in steps],
                    "p95_um": _spread(before),
                    "p95_left_um": _spread(after),
                    "worse_h": worse,
                }
            )
    return out


def _line_mm(strokes: Strokes, axis: str) -> Floats:
    """Return eleven points along an axis through the middle of the others."""
    out = np.tile([float(np.mean(strokes[a])) for a in "xyz"], (11, 1))
    out[:, "xyz".index(axis)] = np.linspace(*strokes[axis], 11)
    return out


def _slots(measured: Session, left: Floats) -> dict[str, float] | None:
    """Return the slot test for every hour at which it may start; None when cycles are not hourly."""
    if len(left) < _SLOTS or not np.allclose(np.diff(measured.hour), 1.0):
        return None
    places = slot_places_mm(dict(measured.artefact.strokes_mm))
    unit = design(places, measured.artefact.strokes_mm, measured.artefact.names)[:, 2]
    before, after = (slot_ranges_um(v @ unit.T) for v in (measured.values, left))
    return {
        "mean_range_um": float(before.mean()),
        "mean_range_left_um": float(after.mean()),
        "mean_reduction_pct": reduction_pct(float(before.mean()), float(after.mean())),
        "max_range_um": float(before.max()),
        "max_range_left_um": float(after.max()),
        "max_reduction_pct": reduction_pct(float(before.max()), float(after.max())),
    }


def _spread(curve: _IntervalCurve) -> list[float]:
    return [float(v) for v in curve.p95_spread]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def slot_places_mm(strokes_mm: dict[str, tuple[float, float]]) -> Floats:
    """Return where the slots are milled: a four by four grid in the lower middle of the volume.

    Returns (16, 3): the grid is ours: the source's drawing cannot be read.
    """
    low = {axis: reach[0] + 0.25 * (reach[1] - reach[0]) for axis, reach in strokes_mm.items()}
    high = {axis: reach[0] + 0.75 * (reach[1] - reach[0]) for axis, reach in strokes_mm.items()}
    grid = [(x, y) for y in np.linspace(low["y"], high["y"], 4) for x in np.linspace(low["x"], high["x"], 4)]
    return np.array([(x, y, low["z"]) for x, y in grid])


def slot_errors_um(depth_um: Floats, start: int) -> Floats:
    """Return the depth error of the slots against the first one.

    ``depth_um``, (hours, 16): error along the tool at every slot's place, hour by hour.
    ``start``: hour of the first slot.
    """
    if not 0 <= start <= len(depth_um) - _SLOTS:
        raise InputError(
            "the slots do not fit into the campaign",
            code="volumetric.slots",
            got=f"start {start} h",
            allowed=f"0 to {len(depth_um) - _SLOTS} h",
        )
    milled = np.array([depth_um[start + k, k] for k in range(_SLOTS)])
    return np.asarray(milled - milled[0])


def slot_ranges_um(depth_um: Floats) -> Floats:
    """Return the range of the slots' errors for every hour at which the test may start."""
    starts = range(len(depth_um) - _SLOTS + 1)
    return np.array([np.ptp(slot_errors_um(depth_um, start)) for start in starts])


@dataclass(frozen=True)
class _IntervalCurve:
    """Statistics of an error over windows of growing length.

    ``steps``, (k,): length of the windows in time steps; a window has one sample more.
    ``worst``, ``mean``, (k,): of the range inside a window.
    ``p95_spread``, (k,): 95th percentile of the standard deviation inside a window: in 95 % of the jobs of that length
    the error varies less.
    """

    steps: Floats
    worst: Floats
    mean: Floats
    p95_spread: Floats


def interval_curve(series: Floats, steps: Sequence[int]) -> _IntervalCurve:
    """Return the statistics of a series over sliding windows.

    ``series``, (n,) or (n, points): an error at equal time steps; of several points the pooled windows count.
    ``steps``: lengths from 1 to n - 1: n - length windows of length + 1 samples each.
    """
    values = series.reshape(len(series), -1)
    bad = [s for s in steps if not 1 <= s <= len(values) - 1]
    if bad:
        raise InputError(
            "a window is longer than the series",
            code="volumetric.window",
            got=str(bad[0]),
            allowed=f"1 to {len(values) - 1} steps",
        )
    rows = []
    for step in steps:
        windows = sliding_window_view(values, step + 1, axis=0)
        spans = np.ptp(windows, axis=2)
        spread = np.percentile(windows.std(axis=2), 95)
        rows.append((spans.max(), spans.mean(), spread))
    worst, mean, spread_95 = np.array(rows).T
    return _IntervalCurve(np.array(steps), worst, mean, spread_95)


def worse_steps(before: _IntervalCurve, after: _IntervalCurve) -> list[int]:
    """Return the window lengths at which a correction makes the error vary more.

    ``before``, ``after``: without and with the correction, over the same windows.
    """
    more = after.p95_spread > before.p95_spread
    return [int(s) for s in before.steps[more]]


def reduction_pct(before: float, after: float) -> float:
    """Return by how many per cent an error got smaller; NaN when there was none."""
    return 100.0 * (1.0 - after / before) if before > 0.0 else float("nan")


def write_bundle(home: Home, out: Path, training: Session, other: Session) -> list[str]:
    """Write models without memory as a bundle; return what is switched off in it."""
    models = models_of(training, static=True)[0]
    worse: list[str] = judged(models, other)["worse"]
    machine = Lake(home.lake).campaign(training.campaign).machine
    save_bundle(serving_bundle(models, training, machine, worse), out)
    return worse
