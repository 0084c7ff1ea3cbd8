"""One training on a ball-array campaign: equations of temperatures, judged by hours left out, the bundle of the best, and what a champion leaves later."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from dtwin import __version__
from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import coefficient
from dtwin.kinds.volumetric._evidence import changes_left_um, corrections, distance_changes_um, predicted
from dtwin.kinds.volumetric._session import Session, session_in
from dtwin.kinds.volumetric._thermal_model import ThermalModel, fit_thermal
from dtwin.lake.store import Lake
from dtwin.progress import Progress, StageProgress, silent
from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, held_out
from dtwin.train.gates import Verdict, slow_gates
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Scores, Training, TrainingReport
from dtwin.train.symbolic import Engine

_HELD_OUT = "hours"
_SPANS = 5
_Fit = Callable[[str, Floats, Floats, Sequence[str]], ThermalModel]


def train_volumetric(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Training:
    """Train every candidate on a ball-array campaign.

    Heat lasts: neighbouring cycles are no replicates. Five spans of hours are left out in turn, each as
    a whole; another campaign of the machine, under another schedule, is the judge of a promotion.

    ``seed``: logged; nothing here is random.
    ``engine``: not used: no equation is searched for.
    """
    campaign, versions = lake.campaign(name), dict(lake.versions())
    measured = session_in(lake, name, lambda done, total, what: progress("identify", done, total, what))
    candidates = []
    for done, (title, fit) in enumerate(_FITS.items(), start=1):
        candidates.append(_candidate(title, fit, measured, campaign.machine))
        progress("candidates", done, len(_FITS), title)
    candidates.sort(key=lambda c: c.held_out.rms_um)
    before, floor = (changes_left_um(measured, values) for values in (np.zeros_like(measured.values), measured.values))
    equations = [c for c in candidates if c.promotable]
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=rms(np.concatenate(floor)),
        rms_before_um=rms(np.concatenate(before)),
        n_runs=len(measured.hour),
        n_rows=sum(len(part) for part in before),
        candidates=tuple(candidates),
        proposed=min(equations, key=lambda c: c.held_out.rms_um).name,
        seed=seed,
        told=tuple(_what_was_seen(measured, engine)),
        floor_is="what the identified error motions leave themselves",
    )
    geometry = {"type": "volumetric"} | dict(campaign.machine_geometry)
    hours = float(measured.hour[0]), float(measured.hour[-1])
    return Training(report, geometry, ((name, *hours),))


def serving_bundle(
    models: Sequence[ThermalModel], training: Session, machine: str, switched_off: Collection[str]
) -> Bundle:
    """Return models without memory as an equation.

    ``training``: gives what the thermocouples read, in the reference and in all.
    ``switched_off``: error motions that are worse than none.
    """
    begun = dict(zip(training.sensors, training.begun_c.tolist(), strict=True))
    absolute = training.rise_c + training.begun_c
    seen = {
        name: (float(column.min()), float(column.max()))
        for name, column in zip(training.sensors, absolute.T, strict=True)
    }
    return _volumetric_bundle(models, training.artefact.strokes_mm, begun, seen, "volumetric", machine, switched_off)


def _nothing(name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str]) -> ThermalModel:
    return ThermalModel(name, (), np.zeros(0))


def _every(name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str]) -> ThermalModel:
    per_k = np.linalg.lstsq(rise_c, motion, rcond=None)[0]
    return ThermalModel(name, tuple(sensors), np.asarray(per_k, float))


_FITS: Mapping[str, _Fit] = {
    "zero": _nothing,
    "one temperature": partial(fit_thermal, most=1),
    "few temperatures": fit_thermal,
    "all temperatures": _every,
}
_Family = Literal["baseline", "linear", "symbolic"]
_FAMILY: Mapping[str, _Family] = {"zero": "baseline", "all temperatures": "linear"}


def _candidate(title: str, fit: _Fit, measured: Session, machine: str) -> Candidate:
    expected, spans = _left_out(fit, measured)
    models = _models(fit, measured, np.ones(len(measured.hour), bool))
    fitted = predicted(models, measured)
    family = _FAMILY.get(title, "symbolic")
    bundle: Bundle | None = None
    worse: tuple[str, ...] = ()
    if family == "symbolic":
        worse = _worse(measured, expected)
        bundle = serving_bundle(models, measured, machine, worse)
    return Candidate(
        name=title,
        family=family,
        promotable=bundle is not None,
        complexity=sum(len(m.sensors) for m in models),
        scores={_HELD_OUT: _scores(measured, expected, spans)},
        train_rms_um=rms(np.concatenate(changes_left_um(measured, fitted))),
        latency=None if bundle is None else bundle_latency(bundle),
        equation="" if bundle is None else "\n".join(_readable(m) for m in models),
        bundle=None if bundle is None else bundle.to_dict(),
        findings=tuple(f"{name} is worse than nothing in hours left out: switched off" for name in worse)
        or (("needs every thermocouple: a comparison only",) if family == "linear" else ()),
    )


def _left_out(fit: _Fit, measured: Session) -> tuple[Floats, list[Any]]:
    """Return what is expected of cycles that were left out of the fit, and the spans of cycles."""
    expected = np.zeros_like(measured.values)
    spans = np.array_split(np.arange(len(measured.hour)), _SPANS)
    for span in spans:
        kept = np.ones(len(measured.hour), bool)
        kept[span] = False
        expected[span] = predicted(_models(fit, measured, kept), measured)[span]
    return expected, spans


def _models(fit: _Fit, measured: Session, kept: Any) -> list[ThermalModel]:
    return [
        fit(name, measured.values[kept, i], measured.rise_c[kept], measured.sensors)
        for i, name in enumerate(measured.artefact.names)
    ]


def _worse(measured: Session, expected: Floats) -> tuple[str, ...]:
    left = measured.values - expected
    return tuple(name for i, name in enumerate(measured.artefact.names) if rms(left[:, i]) > rms(measured.values[:, i]))


def _scores(measured: Session, expected: Floats, spans: Sequence[Any]) -> Scores:
    before = changes_left_um(measured, np.zeros_like(expected))
    after = changes_left_um(measured, expected)
    ratios = {}
    for span in spans:
        was, is_now = (np.concatenate([part[i] for i in span]) for part in (before, after))
        where = f"{measured.hour[span[0]]:g} to {measured.hour[span[-1]]:g} h"
        ratios[where] = rms(is_now) / rms(was)
    worst = max(ratios, key=lambda where: ratios[where])
    was, left = np.concatenate(before), np.concatenate(after)
    r2 = 1.0 - float(np.sum(left**2) / np.sum((was - was.mean()) ** 2))
    return Scores(
        _HELD_OUT, r2, rms(left), float(np.mean(np.abs(left))), ratios[worst], worst, len(spans), len(measured.hour)
    )


def _what_was_seen(measured: Session, engine: Engine | None) -> list[str]:
    told = [
        f"errors are changes of the distances between balls of an array; {_SPANS} spans of hours were left "
        "out in turn, each as a whole",
        "models with a memory are not candidates: serving does not know the cycle before; "
        "dtwin volumetric fit compares them",
    ]
    if engine is not None:
        told.append(f"no equation was searched for with {engine.name}")
    return told


def _readable(model: ThermalModel) -> str:
    terms = " ".join(f"{k:+.4g} {s}" for s, k in zip(model.sensors, model.per_k.tolist(), strict=True))
    return f"{model.name} = {terms or '0'} (rises since the reference)"


def volumetric_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle for heat by everything that needs no other campaign."""
    return slow_gates(bundle, metrics, _HELD_OUT, "hours")


_POSITION_HZ, _TEMPERATURE_HZ = 100.0, 1.0 / 30.0
# Heat moves slowly, axes at rapid traverse do not: 100 um over a second's way. Dropped at the edge of the
# box, the correction of a whole season would jump; it fades instead.
_SAFETY = SafetyLimits(clamp_um=250.0, slew_um_s=100.0, stale_s=0.1, outside="shrink", shrink_span=0.25)
_BEYOND_C = 2.0
_LINEAR = {"X": ("y", "z"), "Z": ("y",), "0": ("x", "y", "z"), "Y": ()}


def _volumetric_bundle(
    models: Sequence[ThermalModel],
    strokes_mm: Mapping[str, tuple[float, float]],
    begun_c: Mapping[str, float],
    seen_c: Mapping[str, tuple[float, float]],
    name: str,
    machine: str,
    switched_off: Collection[str] = (),
) -> Bundle:
    """Return the error of the tool point from what thermocouples and scales read.

    ``models``: one for each error motion.
    ``strokes_mm``: ends of the strokes, the validity box of the positions.
    ``begun_c``: what each thermocouple read in the reference: the correction is zero there.
    ``seen_c``: what each read in training; 2 degC more are allowed.
    ``switched_off``: error motions that are worse than none.
    """
    kept = [model for model in models if model.name not in switched_off]
    if not kept:
        raise InputError(
            "these models cannot be served",
            code="volumetric.bundle",
            got="all are switched off",
            allowed="at least one of them better than none",
        )
    builder = GraphBuilder()
    position = {axis: builder.input(f"{axis}_mm") for axis in "xyz"}
    sensors = sorted({sensor for model in kept for sensor in model.sensors})
    rise = {sensor: builder.input(sensor) - begun_c[sensor] for sensor in sensors}
    motions = {
        model.name: builder.total([rise[s] * float(k) for s, k in zip(model.sensors, model.per_k, strict=True)])
        for model in kept
    }
    parts: dict[str, list[Expression | float]] = {axis: [] for axis in "xyz"}
    for motion, value in motions.items():
        for axis, factor in _acts(builder, motion, position, strokes_mm).items():
            parts[axis].append(value * factor)
    graph = builder.graph({f"error_{axis}_um": builder.total(parts[axis] or [0.0]) for axis in "xyz"})
    inputs = [Input(f"{axis}_mm", "mm", "base", _POSITION_HZ, "controller", *strokes_mm[axis]) for axis in "xyz"]
    inputs += [
        Input(s, "degC", "none", _TEMPERATURE_HZ, "covariate", seen_c[s][0] - _BEYOND_C, seen_c[s][1] + _BEYOND_C)
        for s in sensors
    ]
    return create_bundle(
        corrects="volumetric",
        name=name,
        machine=machine,
        model_version=1,
        inputs=tuple(inputs),
        outputs=tuple(Output(f"error_{axis}_um", f"base_{axis}") for axis in "xyz"),
        tick_graph=graph,
        safety=_SAFETY,
        provenance=Provenance(code_version=__version__, evidence="none"),
    )


def is_volumetric_bundle(bundle: Bundle) -> bool:
    """Tell whether a bundle corrects the tool point by temperatures."""
    return any(i.source == "covariate" and i.unit == "degC" for i in bundle.inputs)


def _acts(
    builder: GraphBuilder, name: str, position: Mapping[str, Expression], strokes_mm: Mapping[str, tuple[float, float]]
) -> dict[str, Expression]:
    """Return the factor of an error motion in each coordinate that it changes."""
    what = coefficient(name)
    profile = _profile(builder, what.axis, what.order, position, strokes_mm)
    if what.letter in "XYZ":
        return {what.letter.lower(): profile}
    turn = np.zeros(3)
    turn["ABC".index(what.letter)] = 1.0
    out = {}
    for axis in _LINEAR[what.axis]:
        arm = np.zeros(3)
        arm["xyz".index(axis)] = 1e-3
        for number, share in enumerate(np.cross(turn, arm).tolist()):
            if share:
                out["xyz"[number]] = profile * position[axis] * share
    return out


def _profile(
    builder: GraphBuilder,
    axis: str,
    order: int,
    position: Mapping[str, Expression],
    strokes_mm: Mapping[str, tuple[float, float]],
) -> Expression:
    if order == 0:
        return builder.constant(1.0)
    low, high = strokes_mm[axis.lower()]
    travel = (position[axis.lower()] * 2.0 - (low + high)) / (high - low)
    powers = np.polynomial.legendre.leg2poly(np.eye(order + 1)[order]).tolist()
    terms: list[Expression | float] = [powers[0]]
    terms += [builder.power(travel, n) * powers[n] for n in range(1, order + 1) if powers[n]]
    return builder.total(terms)


def heat_error(
    lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, metrics: object, progress: Progress = silent
) -> ChampionError:
    """Return a bundle's error in the changes of distances since the first cycles, as training states it.

    The floor is what the identified error motions leave themselves.
    """
    name = str(rows[0]["campaign"])
    measured = session_in(lake, name, progress)
    if len(rows) != len(measured.hour):
        raise InputError(
            "the cycles of a campaign share their reference and are judged together",
            code="drift.cycles",
            where=f"campaign {name}",
            got=f"{len(rows)} of {len(measured.hour)} cycles",
            hint="new cycles go into a campaign of their own",
        )
    off, trusted = corrections(bundle, measured)
    was = [distance_changes_um(where, moved) for where, moved in measured.moved]
    left = [distance_changes_um(where, moved - by) for (where, moved), by in zip(measured.moved, off, strict=True)]
    seen = changes_left_um(measured, measured.values)
    return ChampionError(
        rms_um=rms(np.concatenate(left)),
        before_um=rms(np.concatenate(was)),
        noise_floor_um=rms(np.concatenate(seen)),
        outside_box_share=float(np.mean(np.array(trusted) < 1.0)),
        n_runs=len(rows),
    )


def heat_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with spans of hours left out."""
    return held_out(_HELD_OUT)
