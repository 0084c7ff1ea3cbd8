"""From days of ball arrays and thermocouples to error motions, their thermal models and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.physics.volumetric.chain import coefficient, design
from dtwin.physics.volumetric.identify import Artefact, Balls, Identified, averaged_balls
from dtwin.physics.volumetric.intervals import (
    IntervalCurve,
    interval_curve,
    reduction_pct,
    worse_steps,
)
from dtwin.physics.volumetric.slots import SLOTS, slot_places_mm, slot_ranges_um
from dtwin.physics.volumetric.thermal_model import ThermalModel, fit_thermal, inflation
from dtwin.pipeline.measuring import ingest
from dtwin.schema import Floats, Run
from dtwin.store import Lake

SENSORS = "thermocouples"
REFERENCE_CYCLES = 3
# An error motion is unexplained when a model takes away less than this of what can be seen.
UNEXPLAINED_PCT = 40.0
_HALVED = 0.5
_SEEN = 4.0
Strokes = dict[str, tuple[float, float]]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Session:
    """A campaign, cycle by cycle, as differences to its first cycles.

    Attributes
    ----------
    campaign : str
        Name.
    hour : ndarray, shape (cycles,)
        Begin of each cycle.
    artefact : Artefact
        How readings become error motions.
    moved : tuple of (Balls, ndarray)
        Where each cycle measured, and how the tool point moved there.
    found : tuple of Identified
        Error motions of each cycle.
    sensors : tuple of str
        Thermocouples without gaps.
    rise_c : ndarray, shape (cycles, sensors)
        Their means over the cycle.
    begun_c : ndarray, shape (sensors,)
        What they read in the reference.
    offered : dict of str to ndarray, shape (cycles,)
        Other temperatures that were logged, likewise.
    """

    campaign: str
    hour: Floats
    artefact: Artefact
    moved: tuple[tuple[Balls, Floats], ...]
    found: tuple[Identified, ...]
    sensors: tuple[str, ...]
    rise_c: Floats
    begun_c: Floats
    offered: Mapping[str, Floats]

    @property
    def values(self) -> Floats:
        """Error motions, shape (cycles, coefficients)."""
        return np.array([found.values for found in self.found])

    def rise_of(self, names: Sequence[str]) -> Floats:
        """Return temperatures by name, shape (cycles, names).

        Raises
        ------
        InputError
            When one was not measured here, or has gaps.
        """
        absent = [name for name in names if name not in self.sensors]
        if absent:
            raise InputError(
                "the model needs temperatures that this campaign does not have without gaps",
                code="volumetric.sensors", where=self.campaign, got=", ".join(absent)[:160],
            )  # fmt: skip
        return self.rise_c[:, [self.sensors.index(name) for name in names]]


def session(home: Home, campaign: str, progress: Progress) -> Session:
    """Identify the error motions of every cycle of a campaign.

    Parameters
    ----------
    home : Home
        Of the lake.
    campaign : str
        Name in the lake, or a folder, which is ingested first.
    progress : callable
        Called with (done, total, what).

    Raises
    ------
    InputError
        When it is of another kind, or its balls cannot tell the error motions.
    """
    lake = Lake(home.lake)
    name = campaign
    if campaign not in lake.campaigns() and Path(campaign).exists():
        name = ingest(Path(campaign), home).campaign
    known = lake.campaign(name)
    if known.kind != "volumetric":
        raise InputError(
            "not a ball-array campaign", code="volumetric.kind", where=name, got=known.kind,
            allowed="volumetric",
        )  # fmt: skip
    runs = [
        run for run in lake.iterate(name) if not any(f.severity == "error" for f in run.findings)
    ]
    runs.sort(key=lambda run: float(run.meta.condition.get("time_h", 0.0)))
    if len(runs) <= REFERENCE_CYCLES:
        raise InputError(
            "too few usable cycles", code="volumetric.cycles", where=name, got=str(len(runs)),
            allowed=f"more than {REFERENCE_CYCLES}", hint=f"dtwin check: what is wrong with {name}",
        )  # fmt: skip
    artefact = _artefact(known.machine_geometry, name)
    balls = [_balls(run) for run in runs]
    reference = averaged_balls(balls[:REFERENCE_CYCLES])
    moved = tuple(artefact.variation_um(cycle, reference) for cycle in balls)
    found = []
    for number, (where, by) in enumerate(moved):
        found.append(artefact.identify(where, by))
        progress(number + 1, len(moved), f"identify {runs[number].meta.run_id}")
    table = _temperatures(runs)
    inside = {n: t for n, (group, t) in table.items() if group == SENSORS}
    if not inside:
        raise InputError(
            "no thermocouple has readings in every cycle", code="volumetric.sensors", where=name,
            hint=f'a signal group "{SENSORS}" with columns that end in _c',
        )  # fmt: skip
    absolute = np.column_stack(list(inside.values()))
    begun = absolute[:REFERENCE_CYCLES].mean(axis=0)
    return Session(
        name, np.array([float(run.meta.condition.get("time_h", i)) for i, run in enumerate(runs)]),
        artefact, moved, tuple(found), tuple(inside), absolute - begun, begun,
        {n: t - t[:REFERENCE_CYCLES].mean() for n, (group, t) in table.items() if group != SENSORS},
    )  # fmt: skip


def models_of(
    training: Session, *, offered: Sequence[str] = (), static: bool = False
) -> tuple[list[ThermalModel], Session]:
    """Fit a thermal model to every error motion; return them and the session with what was offered.

    Parameters
    ----------
    training : Session
        Where they are fitted.
    offered : sequence of str
        Other logged temperatures that may be used, too.
    static : bool
        Without memory.
    """
    whole = with_offered(training, offered)
    names = whole.artefact.names
    made = [
        fit_thermal(name, whole.values[:, i], whole.rise_c, whole.sensors, static=static)
        for i, name in enumerate(names)
    ]
    return made, whole


def with_offered(measured: Session, offered: Sequence[str]) -> Session:
    """Return a session whose models may use other logged temperatures, too.

    Raises
    ------
    InputError
        When one was not logged.
    """
    absent = [name for name in offered if name not in measured.offered]
    if absent:
        raise InputError(
            "no such temperature was logged beside the thermocouples", code="volumetric.offered",
            where=measured.campaign, got=", ".join(absent)[:120],
            allowed=", ".join(measured.offered) or "none was",
        )  # fmt: skip
    more = np.column_stack([measured.rise_c, *(measured.offered[name] for name in offered)])
    begun = np.concatenate([measured.begun_c, np.zeros(len(offered))])
    return replace(measured, sensors=(*measured.sensors, *offered), rise_c=more, begun_c=begun)


def predicted(models: Sequence[ThermalModel], measured: Session) -> Floats:
    """Return the error motions that the models expect, in free run, shape (cycles, coefficients)."""
    return np.column_stack([model.run(measured.rise_of(model.sensors)) for model in models])


def judged(
    models: Sequence[ThermalModel], measured: Session, training: Session | None = None
) -> dict[str, Any]:
    """Compare the models with a campaign.

    Parameters
    ----------
    models : sequence of ThermalModel
        One for each coefficient.
    measured : Session
        Another campaign than that of the fit, when the figures shall say anything.
    training : Session, optional
        The campaign of the fit: causes of what is unexplained are fitted there, and judged here.

    Returns
    -------
    dict
        ``distances`` between balls, ``coefficients``, ``lines`` (how much an error changes in how
        long), ``slots``, ``unexplained`` and ``worse``.
    """
    expected = predicted(models, measured)
    left = measured.values - expected
    rows = [_row(model, measured, i, left[:, i]) for i, model in enumerate(models)]
    lines = _lines(measured, left)
    return {
        "campaign": measured.campaign,
        "cycles": len(measured.hour),
        "sensors": len(measured.sensors),
        "identified_um": _mean([found.left_um for found in measured.found]),
        "held_out_poses_um": _mean([found.held_out_um for found in measured.found]),
        "distances": _distances(measured, expected),
        "coefficients": rows,
        "lines": lines,
        "slots": _slots(measured, left),
        "unexplained": [
            _unexplained(models[i], i, training, measured, row["rms_left_um"])
            for i, row in enumerate(rows) if _is_unexplained(row)
        ],
        "worse": [row["name"] for row in rows if row["rms_reduction_pct"] < 0.0],
    }  # fmt: skip


def _is_unexplained(row: Mapping[str, Any]) -> bool:
    return bool(
        row["rms_reduction_pct"] < UNEXPLAINED_PCT and row["rms_um"] > _SEEN * row["uncertainty_um"]
    )


def _unexplained(
    model: ThermalModel, column: int, training: Session | None, measured: Session, left_um: float
) -> dict[str, Any]:
    """Name the logged temperature that, fitted in one campaign, halves what is left in the other."""
    out: dict[str, Any] = {"name": model.name, "cause": None, "tried": []}
    if training is None:
        return out
    own = training.rise_of(model.sensors)
    for channel, rise in training.offered.items():
        if channel not in measured.offered:
            continue
        with_it = np.column_stack([own, rise])
        per_k = np.linalg.lstsq(with_it, training.values[:, column], rcond=None)[0]
        there = np.column_stack([measured.rise_of(model.sensors), measured.offered[channel]])
        after = _rms(measured.values[:, column] - there @ per_k)
        out["tried"].append({"channel": channel, "left_um": after})
    best = min(out["tried"], key=lambda t: t["left_um"], default=None)
    if best is not None and best["left_um"] < _HALVED * left_um:
        out["cause"] = best["channel"]
    return out


def _row(model: ThermalModel, measured: Session, column: int, left: Floats) -> dict[str, Any]:
    values = measured.values[:, column]
    before, after = _rms(values), _rms(left)
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
        "memory": model.memory,
        "largest_inflation": float(inflation(used).max()),
    }


def _distances(measured: Session, expected: Floats) -> dict[str, float]:
    """Return how distances between balls change, before and after; fitted and held-out poses."""
    before: list[Floats] = []
    after: list[Floats] = []
    for (where, moved), values in zip(measured.moved, expected, strict=True):
        rest = moved - measured.artefact.predicted_um(where, values)
        for pose in sorted(set(where.pose.tolist()) - {0}):
            rows = np.flatnonzero(where.pose == pose)
            one, other = np.triu_indices(len(rows), 1)
            apart = where.position_mm[rows][one] - where.position_mm[rows][other]
            unit = apart / np.linalg.norm(apart, axis=1)[:, None]
            for kept, values_um in ((before, moved), (after, rest)):
                kept.append(((values_um[rows][one] - values_um[rows][other]) * unit).sum(axis=1))
    was, is_now = np.concatenate(before), np.concatenate(after)
    return {
        "p2p_um": float(np.ptp(was)),
        "p2p_left_um": float(np.ptp(is_now)),
        "p2p_reduction_pct": reduction_pct(float(np.ptp(was)), float(np.ptp(is_now))),
        "rms_um": _rms(was),
        "rms_left_um": _rms(is_now),
        "rms_reduction_pct": reduction_pct(_rms(was), _rms(is_now)),
    }


def _lines(measured: Session, left: Floats) -> list[dict[str, Any]]:
    """Return how much the error along a line of each axis changes within jobs of every length."""
    step_h = float(np.median(np.diff(measured.hour)))
    steps = sorted(
        {s for s in (1, 2, 3, 5, 8, 12, 16, 20, 30, 40, 60, 100, len(left) - 1) if s < len(left)}
    )
    out = []
    for axis in "xzy":
        place = _line_mm(dict(measured.artefact.strokes_mm), axis)
        unit = design(place, measured.artefact.strokes_mm, measured.artefact.names)
        for number, direction in enumerate("xyz"):
            series = [v @ unit[:, number].T for v in (measured.values, left)]
            before, after = (interval_curve(s, steps) for s in series)
            worse = [step_h * s for s in worse_steps(before, after)]
            out.append({
                "line": axis.upper(), "direction": direction.upper(),
                "hours": [step_h * s for s in steps],
                "p95_um": _spread(before), "p95_left_um": _spread(after), "worse_h": worse,
            })  # fmt: skip
    return out


def _line_mm(strokes: Strokes, axis: str) -> Floats:
    """Return eleven points along an axis through the middle of the others."""
    out = np.tile([float(np.mean(strokes[a])) for a in "xyz"], (11, 1))
    out[:, "xyz".index(axis)] = np.linspace(*strokes[axis], 11)
    return out


def _slots(measured: Session, left: Floats) -> dict[str, float] | None:
    """Return the slot test for every hour at which it may start; None when cycles are not hourly."""
    if len(left) < SLOTS or not np.allclose(np.diff(measured.hour), 1.0):
        return None
    places = slot_places_mm(dict(measured.artefact.strokes_mm))
    unit = design(places, measured.artefact.strokes_mm, measured.artefact.names)[:, 2]
    before, after = (slot_ranges_um(v @ unit.T) for v in (measured.values, left))
    return {
        "mean_range_um": float(before.mean()), "mean_range_left_um": float(after.mean()),
        "mean_reduction_pct": reduction_pct(float(before.mean()), float(after.mean())),
        "max_range_um": float(before.max()), "max_range_left_um": float(after.max()),
        "max_reduction_pct": reduction_pct(float(before.max()), float(after.max())),
    }  # fmt: skip


def _artefact(geometry: Mapping[str, Any], where: str) -> Artefact:
    if str(geometry.get("chain", "XZY")) != "XZY":
        raise InputError(
            "only machines that carry Y on Z on X can be identified", code="volumetric.chain",
            where=where, got=str(geometry.get("chain"))[:20], allowed="XZY",
        )  # fmt: skip
    strokes: Strokes = {}
    for axis in "xyz":
        reach = geometry.get(f"stroke_{axis}_mm")
        if not (isinstance(reach, list) and len(reach) == 2 and reach[0] < reach[1]):
            raise InputError(
                "the stroke of an axis is needed", code="volumetric.stroke",
                where=f"{where} machine_geometry.stroke_{axis}_mm", got=str(reach)[:60],
                allowed="two positions in mm, ascending",
            )  # fmt: skip
        strokes[axis] = (float(reach[0]), float(reach[1]))
    held_out = tuple(int(pose) for pose in geometry.get("held_out_poses", ()))
    repeat = float(geometry.get("pose_repeat_um", np.inf))
    return Artefact(strokes, held_out, repeat)


def _balls(run: Run) -> Balls:
    place, error = (
        np.stack([run.samples[name.format(axis)] for axis in "xyz"], axis=1).astype(float)
        for name in ("{}_mm", "error_{}_um")
    )
    pose, ball = (np.rint(run.samples[name]).astype(np.int64) for name in ("pose_1", "ball_1"))
    return Balls(place, error, pose, ball)


def _temperatures(runs: Sequence[Run]) -> dict[str, tuple[str, Floats]]:
    """Return group and mean over each cycle of every temperature that has no gap."""
    means: dict[str, list[float]] = {}
    groups: dict[str, str] = {}
    for run in runs:
        for group in run.signals:
            for name, values in group.columns.items():
                if name.endswith("_c"):
                    groups.setdefault(name, group.name)
                    means.setdefault(name, []).append(float(np.mean(values)))
    return {
        name: (groups[name], np.array(values))
        for name, values in means.items()
        if len(values) == len(runs) and np.isfinite(values).all()
    }


def _spread(curve: IntervalCurve) -> list[float]:
    return [float(v) for v in curve.p95_spread]


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))
