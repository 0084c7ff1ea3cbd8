"""Positioning tests along an axis, after ISO 230-2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import TWINS_OF_PATHS, FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances
    from dtwin.schema import Run


class _Linear(Kind):
    name = "linear"
    columns = ("t_s", "position_mm", "direction", "error_um")
    told_as = "positioning"
    stated = ("axis",)
    campaign_columns = columns
    sheet_columns = columns
    measured_by = ("laser", "interferom", "xl80", "xm60", "step gauge", "stufenendma", "linear encoder", "vergleichsma")
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
    places: ClassVar[Mapping[str, str]] = {
        **TWINS_OF_PATHS,
        "machines": "_machines:MACHINES",
        "plan": "_planned:planned",
        "draft": "_planned:draft",
        "programs": "_planned:programs",
        "foreseen": "_planned:foreseen",
        "proposals": "_planned:proposals",
        "completed": "_read:with_pitch",
        "judge_run": "dtwin.positioning.check:judge_positioning_run",
        "judge_campaign": "dtwin.positioning.check:judge_positioning_campaign",
        "campaign_figures": "_report:positioning_result",
        "figure_lines": "_report:positioning_lines",
        "drawings": "dtwin.positioning.drawings:DRAWINGS",
        "sheet_figure": "dtwin.positioning.positioning_sheet:positioning_figure",
        "axis_errors": "_bundle:axis_errors",
        "rows": "_grid:stroke_rows",
        "run_errors": "_judging:stroke_errors",
        "training": "_training:train_positioning",
        "recognises": "_bundle:is_positioning_bundle",
        "gates": "_gates:registered_positioning_gates",
        "twin_correction": "_correction:WAY",
        "champion_error": "_judging:strokes_error",
        "held_out": "_judging:strokes_held_out",
    }

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

    def require_condition(self, condition: Mapping[str, Any], where: str) -> None:
        from dtwin.kinds.linear._read import require_pitch

        require_pitch(condition.get("screw_pitch_mm"), where)

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.linear._report import asked, contributions
        from dtwin.positioning.positioning_sheet import positioning_sheet

        return positioning_sheet(runs, asked, partial(contributions, under))


KIND = _Linear()
