"""Positioning tests of rotary axes, after ISO 230-2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Drawing, FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances
    from dtwin.schema import Campaign, Finding, Run


class _Rotary(Kind):
    name = "rotary"
    columns = ("t_s", "angle_deg", "direction", "error_arcsec")
    stated = ("axis",)
    examples: ClassVar[Mapping[str, str]] = {"axis": "C"}
    campaign_columns = columns
    sheet_columns = columns
    measured_by = ("autocollim", "autokollim", "xr20", "polygon")
    figures = ("A", "A↑", "A↓", "R", "R↑", "R↓", "E", "E↑", "E↓", "B", "B̄", "M")
    unit = "arcsec"
    told_as = "positioning"
    places: ClassVar[Mapping[str, str]] = {
        "judge_campaign": "_sheet:judge_campaign",
        "campaign_figures": "_sheet:positioning_result",
        "figure_lines": "_sheet:positioning_lines",
    }
    prefixed = figures
    read_with = (*Kind.read_with, "condition.instrument")
    instead: ClassVar[Mapping[str, str]] = {
        "twins": "dtwin check tells play, and what comes once and twice a turn",
        "variation": "a drift test tells displacements, and no angle follows from one",
        **dict.fromkeys(
            ("plan", "usual_plan", "draft", "proposals"),
            "eight targets or more on a turn, five runs, both directions: docs/how-to/positioning-table.md",
        ),
    }

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.rotary._scale import ANGLES
        from dtwin.positioning.position_table import is_position_table, read_position_runs

        return partial(read_position_runs, scale=ANGLES) if is_position_table(path) else super().reader_of(path)

    def takes_alone(self, path: Path) -> bool:
        from dtwin.positioning.position_table import axis_turns

        return axis_turns(path) is True

    def require_condition(self, condition: Mapping[str, Any], where: str) -> None:
        from dtwin.kinds.rotary._scale import require_turning

        require_turning(str(condition.get("axis", "")), where)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.positioning.ways import with_ways

        return with_ways(run)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.rotary._scale import ANGLES
        from dtwin.positioning.check import judge_positioning_run

        return list(judge_positioning_run(run, ANGLES))

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.rotary._scale import ANGLES
        from dtwin.kinds.rotary._sheet import contributions, noted
        from dtwin.positioning.positioning_sheet import positioning_sheet

        return positioning_sheet(runs, noted, partial(contributions, under), ANGLES)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.kinds.rotary._scale import ANGLES
        from dtwin.positioning.positioning_sheet import positioning_figure

        return positioning_figure(runs, ANGLES)

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.kinds.rotary._scale import ANGLES
        from dtwin.positioning.drawings import drawings

        return drawings(ANGLES)


KIND = _Rotary()
