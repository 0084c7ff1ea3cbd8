"""The grid on which turns are compared, and an equation of the error over the angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.physics.grid import Grid, Row
from dtwin.physics.state import State
from dtwin.schema import Floats, Run, RunMeta
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits
from dtwin.statistics import rms
from dtwin.train.champion_error import RunError
from dtwin.train.latency import bundle_latency
from dtwin.train.results import Candidate, Scores, Training, TrainingReport
from sixth_kind.effects import TEETH
from sixth_kind.kind import Turn
from sixth_kind.machine import RIM_MM

POINTS_DEG = np.arange(0.0, 360.0, 2.5)
WAVES = (1, TEETH, 3 * TEETH)


def rows(runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
    out = []
    for run, time_h in zip(runs, times_h, strict=True):
        condition = Turn(float(run.meta.condition["speed_deg_s"]))
        y_um = np.interp(POINTS_DEG, run.samples["angle_deg"], run.samples["error_um"])
        here = np.ones(len(POINTS_DEG), dtype=bool)
        out.append(Row(run, condition, y_um, here, {"time_h": time_h}, condition.feed_mm_min / 60.0))
    return GRID, out


def _state(meta: RunMeta, condition: Any, feed_mm_s: float, geometry: Mapping[str, Any]) -> State:
    angle = np.radians(POINTS_DEG)
    n, axis = len(angle), "C"

    def all_of(value: float) -> dict[str, Floats]:
        return {axis: np.full(n, value)}

    return State(
        kind="turntable",
        axes=(axis,),
        plane="",
        position_mm={axis: angle * RIM_MM},
        velocity_mm_s=all_of(feed_mm_s),
        acceleration_mm_s2=all_of(0.0),
        sensitivity=all_of(1.0),
        since_reversal_s={axis: angle * RIM_MM / feed_mm_s},
        last_end=all_of(-1.0),
        angle_rad=angle,
        radius_mm=RIM_MM,
        feed_mm_s=feed_mm_s,
        direction=1.0,
        geometry=geometry,
    )


GRID = Grid(
    kind="turntable",
    coordinate="angle_deg",
    points=POINTS_DEG,
    setup=np.ones((len(POINTS_DEG), 1)),
    setup_names=("datum_um",),
    fine=1,
    averaged=lambda values: values,
    state=_state,
    described=len(POINTS_DEG) // 2,
    wave=lambda n: f"{n} waves a turn",
)


def run_errors(runs: Sequence[Run]) -> list[RunError]:
    out = []
    for number, run in enumerate(runs):
        error = np.asarray(run.samples["error_um"]) - float(np.mean(run.samples["error_um"]))
        speed = float(run.meta.condition["speed_deg_s"])
        condition = {"axis": "C", "approached": f"at {speed:g} deg/s"}
        out.append(RunError(number, condition, "up", rms(error), error))
    return out


def _design(angle_deg: Floats) -> Floats:
    phase = np.outer(np.radians(angle_deg), WAVES)
    return np.hstack([np.ones((len(angle_deg), 1)), np.cos(phase), np.sin(phase)])


def _fit(runs: Sequence[Run]) -> Floats:
    angle = np.concatenate([run.samples["angle_deg"] for run in runs])
    error = np.concatenate([run.samples["error_um"] for run in runs])
    return np.linalg.lstsq(_design(angle), error, rcond=None)[0]


def _bundle(found: Floats, machine: str) -> Bundle:
    g, n = GraphBuilder(), len(WAVES)
    angle = g.input("angle_deg") * float(np.pi / 180.0)
    terms: list[Any] = []
    for i, times in enumerate(WAVES):
        terms.append(g.apply("cos", angle * float(times)) * float(found[1 + i]))
        terms.append(g.apply("sin", angle * float(times)) * float(found[1 + n + i]))
    return create_bundle(
        corrects="turntable",
        name="waves",
        machine=machine,
        model_version=1,
        inputs=(Input("angle_deg", "deg", "none", 100.0, "controller", 0.0, 360.0),),
        outputs=(Output("error_um", "path_radial"),),
        tick_graph=g.graph({"error_um": g.total(terms)}),
        safety=SafetyLimits(clamp_um=100.0, slew_um_s=1e5, stale_s=0.1),
        provenance=Provenance(code_version="0", evidence="none"),
    )


def train(lake: Lake, name: str, *, seed: int = 1, engine: Any = None, progress: Any = None) -> Training:
    runs = list(lake.iterate(name))
    if len(runs) < 2:
        raise InputError("one turn cannot be left out", code="train.grid", got=str(len(runs)))
    left = [
        r.samples["error_um"] - _design(r.samples["angle_deg"]) @ _fit([o for o in runs if o is not r]) for r in runs
    ]
    before = [r.samples["error_um"] - np.mean(r.samples["error_um"]) for r in runs]
    bundle, machine = _bundle(_fit(runs), lake.campaign(name).machine), lake.campaign(name).machine
    out = [_candidate("waves", left, before, bundle), _candidate("zero", before, before, None)]
    report = TrainingReport(
        machine=machine,
        campaign=name,
        table_versions=lake.versions(),
        noise_floor_um=float("nan"),
        rms_before_um=rms(np.concatenate(before)),
        n_runs=len(runs),
        n_rows=sum(map(len, left)),
        candidates=tuple(out),
        proposed="waves",
        seed=seed,
    )
    return Training(report, lake.campaign(name).machine_geometry, (("C", 0.0, 360.0),))


def _candidate(name: str, left: list[Floats], before: list[Floats], bundle: Bundle | None) -> Candidate:
    own, whole = rms(np.concatenate(left)), rms(np.concatenate(before))
    scores = Scores("run", 1.0 - (own / whole) ** 2, own, own, own / whole, "C", len(left), len(left))
    return Candidate(
        name=name,
        family="symbolic" if bundle else "baseline",
        promotable=bundle is not None,
        complexity=1,
        scores={"run": scores},
        train_rms_um=own,
        latency=None if bundle is None else bundle_latency(bundle, 2000),
        equation="A cos(n a) + B sin(n a)",
        bundle=None if bundle is None else bundle.to_dict(),
    )
