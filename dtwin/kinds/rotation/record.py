"""Turning axes: error motion at a speed, and run-out over speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    from dtwin.schema import Run


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
    places: ClassVar[Mapping[str, str]] = {
        "machines": "_machines:MACHINES",
        "takes_alone": "_files:is_rotation_file",
        "judge_run": "_check:judge_rotation",
        "judge_campaign": "_campaign:judge_speeds",
        "sheet": "_sheet:rotation_sheet",
        "sheet_figure": "_sheet:rotation_figure",
        "drawings": "_sheet:DRAWINGS",
        "run_figures": "_campaign:run_figures",
    }

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.rotation._files import SUFFIXES
        from dtwin.kinds.rotation._read import read_rotation

        return read_rotation if path.suffix.lower() in SUFFIXES else None

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.rotation._campaign import rotation_figures

        return {"rotation": rotation_figures(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.rotation._campaign import rotation_lines

        return rotation_lines(result["rotation"], result["runs"])


KIND = _Rotation()
