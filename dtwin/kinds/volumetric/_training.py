"""One training on a ball-array campaign: equations of temperatures, judged by hours left out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from dtwin.kinds.volumetric._bundle import volumetric_bundle
from dtwin.kinds.volumetric._judging import changes_left_um, predicted
from dtwin.kinds.volumetric._thermal_model import ThermalModel, fit_thermal
from dtwin.kinds.volumetric.session import Session, session_in
from dtwin.lake.store import Lake
from dtwin.progress import StageProgress
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from dtwin.train.gates import Verdict, bounded_output, latency_gate, vectors_proved
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Scores, Training, TrainingReport
from dtwin.train.symbolic import Engine

HELD_OUT = "hours"
_SPANS = 5
_Fit = Callable[[str, Floats, Floats, Sequence[str]], ThermalModel]


def train_volumetric(
    lake: Lake, name: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress | None = None
) -> Training:
    """Train every candidate on a ball-array campaign.

    Heat lasts: neighbouring cycles are no replicates. Five spans of hours are left out in turn, each as
    a whole; another campaign of the machine, under another schedule, is the judge of a promotion.

    ``seed``: logged; nothing here is random.
    ``engine``: not used: no equation is searched for.
    """
    tell = progress or (lambda *_: None)
    campaign, versions = lake.campaign(name), dict(lake.versions())
    measured = session_in(lake, name, lambda done, total, what: tell("identify", done, total, what))
    found = []
    for done, (title, fit) in enumerate(_FITS.items(), start=1):
        found.append(_candidate(title, fit, measured, campaign.machine))
        tell("candidates", done, len(_FITS), title)
    found.sort(key=lambda c: c.held_out.rms_um)
    before, floor = (changes_left_um(measured, values) for values in (np.zeros_like(measured.values), measured.values))
    equations = [c for c in found if c.promotable]
    report = TrainingReport(
        machine=campaign.machine,
        campaign=name,
        table_versions=versions,
        noise_floor_um=rms(np.concatenate(floor)),
        rms_before_um=rms(np.concatenate(before)),
        n_runs=len(measured.hour),
        n_rows=sum(len(part) for part in before),
        candidates=tuple(found),
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
    return volumetric_bundle(models, training.artefact.strokes_mm, begun, seen, "volumetric", machine, switched_off)


def _nothing(name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str]) -> ThermalModel:
    return ThermalModel(name, (), np.zeros(0), 0.0, 0.0)


def _every(name: str, motion: Floats, rise_c: Floats, sensors: Sequence[str]) -> ThermalModel:
    per_k = np.linalg.lstsq(rise_c, motion, rcond=None)[0]
    return ThermalModel(name, tuple(sensors), np.asarray(per_k, float), 0.0, 0.0)


_FITS: Mapping[str, _Fit] = {
    "zero": _nothing,
    "one temperature": partial(fit_thermal, most=1, static=True),
    "few temperatures": partial(fit_thermal, static=True),
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
        scores={HELD_OUT: _scores(measured, expected, spans)},
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
        HELD_OUT, r2, rms(left), float(np.mean(np.abs(left))), ratios[worst], worst, len(spans), len(measured.hour)
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


_LEAST_R2 = 0.5


def volumetric_gates(bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
    """Judge a bundle for heat by everything that needs no other campaign.

    ``metrics``: what training logged: scores of hours left out, latency.
    """
    r2 = metrics.get("leave_hours_out.r2", float("nan"))
    worst = metrics.get("leave_hours_out.worst_slice_ratio", float("inf"))
    return [
        Verdict("held-out hours", r2 >= _LEAST_R2, f"R² {r2:z.3f}; at least {_LEAST_R2}"),
        Verdict(
            "no slice worse than no correction",
            worst < 1.0,
            f"the worst span of hours keeps {100 * worst:z.0f} % of its error",
        ),
        bounded_output(bundle),
        vectors_proved(bundle),
        latency_gate(metrics),
    ]
