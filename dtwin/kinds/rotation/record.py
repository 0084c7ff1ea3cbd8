"""Turning axes: error motion at a speed, and run-out over speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from dtwin.kinds.kind import Kind


class _Rotation(Kind):
    name = "rotation"
    columns = ("t_s", "angle_deg", "displacement_um")
    stated = ()
    in_one_table = True
    campaign_columns = (*columns, "speed_rpm", "runout_um")
    sheet_columns = campaign_columns
    measured_by = ("spindle", "spindel", "capacit", "kapazitiv", "eddy", "wirbelstrom")
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
        "readers": "_read:READERS",
        "judge_run": "_check:judge_rotation",
        "judge_campaign": "_campaign:judge_speeds",
        "sheet": "_sheet:rotation_sheet",
        "sheet_figure": "_sheet:rotation_figure",
        "drawings": "_sheet:DRAWINGS",
        "run_figures": "_campaign:run_figures",
        "campaign_figures": "_campaign:rotation_figures",
    }

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.rotation._campaign import rotation_lines

        return rotation_lines(result["rotation"], result["runs"])


KIND = _Rotation()
