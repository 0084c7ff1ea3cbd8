"""Turning axes: error motion at a speed, and run-out over speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Drawing, FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.kinds.machine import VirtualMachine
    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances
    from dtwin.schema import Finding, Run


class _Rotation(Kind):
    name = "rotation"
    columns = ("t_s", "angle_deg", "displacement_um")
    stated = ()
    in_one_table = True
    campaign_columns = (*columns, "speed_rpm", "runout_um")
    sheet_columns = campaign_columns
    figures = ("TIR", "T", "e", "S", "R", "A")
    read_with = (*Kind.read_with, "instrument.columns", "condition.angle_log", "condition.speed_rpm")
    settings = (
        "condition.speed_rpm",
        "condition.form",
        "condition.probe",
        "condition.sense",
        "condition.angle",
        "condition.angle_log",
        "condition.features",
    )
    prefixed = ("A", "R")
    instead: ClassVar[Mapping[str, str]] = {
        "twins": "dtwin check CAMPAIGN names what the run-out follows over speed",
        "training": "a turning axis is mended by centring, balancing or bearings, and no equation moves those",
        **dict.fromkeys(
            ("plan", "usual_plan", "draft", "proposals"),
            "20 turns or more at each of four speeds or more, the lowest again at the end: docs/how-to/rotation.md",
        ),
    }

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.rotation._machines import MACHINES

        return MACHINES

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.rotation._files import SUFFIXES
        from dtwin.kinds.rotation._read import read_rotation

        return read_rotation if path.suffix.lower() in SUFFIXES else None

    def takes_alone(self, path: Path) -> bool:
        from dtwin.kinds.rotation._files import is_rotation_file

        return is_rotation_file(path)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.rotation._check import judge_rotation

        return judge_rotation(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.rotation._campaign import judge_speeds

        return judge_speeds(runs)

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.rotation._sheet import rotation_sheet

        return rotation_sheet(runs, under)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.kinds.rotation._sheet import rotation_figure

        return rotation_figure(runs)

    @property
    def drawings(self) -> Sequence[Drawing]:
        from dtwin.kinds.rotation._sheet import DRAWINGS

        return DRAWINGS

    def run_figures(self, run: Run) -> Mapping[str, Any]:
        from dtwin.kinds.rotation._campaign import run_figures

        return run_figures(run)

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.rotation._campaign import rotation_figures

        return {"rotation": rotation_figures(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.rotation._campaign import rotation_lines

        return rotation_lines(result["rotation"], result["runs"])


KIND = _Rotation()
