"""The command about one recording."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._effects import Paths
from dtwin.commands._output import Json, Report, emit
from dtwin.commands._twins import app as twin_app
from dtwin.errors import InputError

File = Annotated[Path, typer.Argument(help="A ball-bar result, .b5r.")]
Centre = Annotated[
    tuple[float, float, float] | None, typer.Option(help="Centre of the circle in the base frame of a UR10e, mm.")
]
Zero = Annotated[float | None, typer.Option(help="Where the bar's 0 deg lies in that frame, deg; else 0.")]


@twin_app.command("recording")
def study(
    file: File,
    robot_centre_mm: Centre = None,
    bar_zero_deg: Zero = None,
    html: Report = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """Tell from one file what can be told: fitted on one pass, judged on the other."""
    from dtwin.physics.library import Library
    from studies.recording import study_recording, ur10e_geometry
    from studies.report.recording import recording_sections, recording_text

    told = [*(robot_centre_mm or ()), *([] if bar_zero_deg is None else [bar_zero_deg])]
    if not all(map(isfinite, told)) or (told and robot_centre_mm is None):
        raise InputError(
            "the place of the bar is not usable",
            code="recording.place",
            got=", ".join(map(str, told)),
            allowed="finite numbers; --bar-zero-deg beside --robot-centre-mm X Y Z only",
        )
    geometry = None if robot_centre_mm is None else ur10e_geometry(robot_centre_mm, bar_zero_deg or 0.0)
    study = study_recording(file, Library(effects_path or ()), geometry)
    if html is not None:
        from dtwin.atomic import write_text
        from dtwin.report.html import page

        write_text(html, page(f"Recording {file.name}", "dtwin", recording_sections(study)), "the report")
    emit(study.result, lambda: recording_text(study.result), as_json=as_json)
