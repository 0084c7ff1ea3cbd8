"""Circular tests: a ball bar or a robot's path round a circle, after ISO 230-4."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dtwin.kinds.kind import Drawing, Planned
from dtwin.kinds.path_kind import PathKind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.kinds.kind import FileReader
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.lake.store import Lake
    from dtwin.physics.grid import Grid, Row
    from dtwin.physics.observations import Observations
    from dtwin.progress import Progress
    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances
    from dtwin.schema import Campaign, Finding, Run
    from dtwin.serve.bundle import Bundle
    from dtwin.train.champion_error import ChampionError, HeldOut
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training
    from dtwin.train.run_errors import RunError
    from dtwin.twins.correct import TwinWay


class _Circular(PathKind):
    name = "circular"
    settings = (
        "instrument.nominal_mm",
        "instrument.calibrated_mm",
        "instrument.calibration_um",
        "instrument.height_difference_mm",
        "machine_geometry.centre_mm",
        "machine_geometry.centre_small_mm",
        "machine_geometry.centre_large_mm",
        "machine_geometry.large_radius_from_mm",
        "machine_geometry.joint_branch",
        "machine_geometry.screw_pitch_mm",
    )
    columns = ("t_s", "angle_deg", "deviation_um")
    stated = ("plane", "radius_mm", "feed_mm_min")
    goes_round = True
    campaign_columns = ("angle_deg", "deviation_um")
    sheet_columns = campaign_columns
    figures = ("G(CCW)", "Fmax(CCW)", "Fmin(CCW)", "G(CW)", "Fmax(CW)", "Fmin(CW)", "G(b)", "H", "D")
    laws = True
    always_fitted = "Centre and radius of every set-up are always fitted."

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.circular._machines import MACHINES

        return MACHINES

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.circular._circle_table import is_circle_table, read_circle_runs

        return read_circle_runs if is_circle_table(path) else None

    def takes_alone(self, path: Path) -> bool:
        from dtwin.kinds.circular._circle_table import is_circle_table

        return is_circle_table(path)

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        from dtwin.kinds.circular._planned import planned
        from dtwin.plan import expand

        return planned(expand(document, where))

    def usual_plan(self) -> Planned:
        from dtwin.kinds.circular._planned import planned
        from dtwin.plan import training_plan

        return planned(training_plan())

    def draft(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Mapping[str, Any]:
        from dtwin.kinds.circular._planned import draft

        return draft(machine, axes)

    def programs(self, planned: Planned, control: str) -> Mapping[str, str]:
        from dtwin.kinds.circular._planned import programs

        return programs(planned.plan)

    def foreseen(self, planned: Planned) -> Observations:
        from dtwin.physics.experiment import planned_observations

        return planned_observations(planned.plan)

    def proposals(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Sequence[Mapping[str, Any]]:
        from dtwin.kinds.circular._planned import proposals

        return proposals(machine, axes)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.kinds.circular._check import with_whole_angle

        return with_whole_angle(run)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.circular._check import judge_circular_run

        return judge_circular_run(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.circular._check import judge_circular_campaign

        return judge_circular_campaign(runs)

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.circular._sheet import circular_sheet

        return circular_sheet(runs, under)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.kinds.circular._sheet import both_ways_figure

        return both_ways_figure(runs)

    def run_figures(self, run: Run) -> Mapping[str, Any]:
        from dtwin.kinds.circular._report import circular_result

        lost = any(f.severity == "error" and f.code in ("angle.jump", "angle.short") for f in run.findings)
        return circular_result(run) if run.meta.radius_mm and not lost else {}

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.kinds.circular._drawings import DRAWINGS

        return DRAWINGS

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        from dtwin.physics.gridding import CIRCLE, rows_of

        pairs = zip(runs, times_h, strict=True)
        return CIRCLE, [row for run, time_h in pairs for row in rows_of(run, time_h)]

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        from dtwin.kinds.circular._run_errors import circle_errors

        return circle_errors(runs)

    def training(self) -> Callable[..., Training]:
        from dtwin.kinds.circular._training import train_campaign

        return train_campaign

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.train.gates import offline_gates

        return offline_gates(bundle, metrics)

    def twin_correction(self) -> TwinWay:
        from dtwin.kinds.circular._correction import freeze_circles, judge_circles
        from dtwin.twins.correct import BY_LAW, TwinWay

        return TwinWay(freeze_circles, judge_circles, BY_LAW, ("nothing_missing",), 0.0)

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        if not all(map(_has_controller, rows)):
            return "no controller signals, so it cannot train a correction"
        feeds = {row["feed_mm_min"] for row in rows}
        return "" if len(feeds) > 1 else "one feed only, so a model could not be judged"

    def drift_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        return "" if all(map(_has_controller, rows)) else "no controller signals, so it cannot judge a champion"

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress | None = None,
    ) -> ChampionError:
        from dtwin.kinds.circular._drift import circles_error

        return circles_error(lake, rows, bundle, metrics, progress)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        from dtwin.kinds.circular._drift import circles_held_out

        return circles_held_out(known, fresh)


def _has_controller(row: Mapping[str, Any]) -> bool:
    return any(group["group"] == "controller" for group in json.loads(row["signals_json"]))


KIND = _Circular()
