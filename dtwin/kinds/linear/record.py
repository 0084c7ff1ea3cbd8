"""Positioning tests along an axis, after ISO 230-2."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Drawing, FileReader, Kind, Planned
from dtwin.kinds.path_kind import PathKind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

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
    from dtwin.train.twin_axes import AxisErrors
    from dtwin.twins.correct import TwinWay


class _Linear(PathKind):
    name = "linear"
    columns = ("t_s", "position_mm", "direction", "error_um")
    stated = ("axis",)
    campaign_columns = columns
    sheet_columns = columns
    figures = ("A", "A↑", "A↓", "R", "R↑", "R↓", "E", "E↑", "E↓", "B", "B̄", "M")
    read_with = (*Kind.read_with, "instrument.length_unit", "instrument.reading_period_s", "condition.instrument")
    settings = (
        "instrument.length_unit",
        "instrument.reading_period_s",
        "instrument.step_mm",
        "instrument.alignment_mm",
        "machine_geometry.screw_pitch_mm",
        "condition.screw_pitch_mm",
        "condition.step_mm",
    )
    always_fitted = "The zero of every set-up is always fitted."
    controls = ("opencnc", "iso")
    instead: ClassVar[Mapping[str, str]] = {
        "laws": "dtwin twin correct serves the effects of the twin; dtwin lathe fit fits an equation"
    }

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.linear._machines import MACHINES

        return MACHINES

    @property
    def readers(self) -> Mapping[str, FileReader]:
        from dtwin.kinds.linear._read import read_laser_runs
        from dtwin.kinds.linear._rtl_file import SUFFIXES, read_rtl_runs

        return {".txt": read_laser_runs, ".las": read_laser_runs, **dict.fromkeys(SUFFIXES, read_rtl_runs)}

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.positioning.position_table import is_position_table, read_position_runs

        return read_position_runs if is_position_table(path) else super().reader_of(path)

    def takes_alone(self, path: Path) -> bool:
        from dtwin.kinds.linear._rtl_file import SUFFIXES
        from dtwin.positioning.position_table import axis_turns

        return path.suffix.lower() in SUFFIXES or axis_turns(path) is False

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        from dtwin.kinds.linear._planned import planned

        return planned(document, where)

    def draft(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Mapping[str, Any]:
        from dtwin.kinds.linear._planned import draft

        return draft(machine, axes)

    def programs(self, planned: Planned, control: str) -> Mapping[str, str]:
        from dtwin.kinds.linear._planned import programs

        return programs(planned.plan, control)

    def foreseen(self, planned: Planned) -> Observations:
        from dtwin.kinds.linear._planned import foreseen

        return foreseen(planned.plan)

    def proposals(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Sequence[Mapping[str, Any]]:
        from dtwin.kinds.linear._planned import proposals

        return proposals(machine, axes)

    def require_condition(self, condition: Mapping[str, Any], where: str) -> None:
        from dtwin.kinds.linear._read import require_pitch

        require_pitch(condition.get("screw_pitch_mm"), where)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.kinds.linear._read import with_pitch

        return with_pitch(run, campaign)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.positioning.check import judge_positioning_run

        return judge_positioning_run(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.positioning.check import judge_positioning_campaign

        whole = [run for run in runs if run.samples]
        return judge_positioning_campaign(whole) if whole else []

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.linear._sheet import asked, contributions
        from dtwin.positioning.sheet import positioning_sheet

        return positioning_sheet(runs, asked, partial(contributions, under))

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.positioning.sheet import positioning_figure

        return positioning_figure(runs)

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.linear._report import positioning_result

        return {"positioning": positioning_result(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.linear._report import positioning_lines

        return positioning_lines(result["positioning"])

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.positioning.drawings import drawings

        return drawings()

    def axis_errors(self, bundle: Bundle) -> AxisErrors:
        from dtwin.kinds.linear._served_axis import axis_errors

        return axis_errors(bundle)

    def rows(self, runs: Sequence[Run], times_h: Sequence[float]) -> tuple[Grid, list[Row]]:
        from dtwin.kinds.linear._grid import stroke_rows

        return stroke_rows(runs, times_h)

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        from dtwin.kinds.linear._run_errors import stroke_errors

        return stroke_errors(runs)

    def training(self) -> Callable[..., Training]:
        from dtwin.kinds.linear._training import train_positioning

        return train_positioning

    def recognises(self, bundle: Bundle) -> bool:
        from dtwin.kinds.linear._bundle import is_positioning_bundle

        return is_positioning_bundle(bundle)

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.kinds.linear._gates import registered_positioning_gates

        return registered_positioning_gates(bundle, metrics)

    def twin_correction(self) -> TwinWay:
        from dtwin.kinds.linear._correction import freeze_axis, judge_axis
        from dtwin.twins.correct import BY_SHAPE, LITTLE, MEAN_IS_TOLD, TwinWay

        return TwinWay(freeze_axis, judge_axis, BY_SHAPE, MEAN_IS_TOLD, LITTLE, {"type": "lathe"})

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress | None = None,
    ) -> ChampionError:
        from dtwin.kinds.linear._drift import strokes_error

        return strokes_error(lake, rows, bundle)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        from dtwin.kinds.linear._drift import strokes_held_out

        return strokes_held_out(known, fresh)


KIND = _Linear()
