"""Ball arrays probed while a machine warms: geometric and thermal errors of a volume."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from dtwin.kinds.kind import Kind


class _Volumetric(Kind):
    name = "volumetric"
    settings = (
        "machine_geometry.held_out_poses",
        "machine_geometry.pose_repeat_um",
        "machine_geometry.stroke_x_mm",
        "machine_geometry.stroke_y_mm",
        "machine_geometry.stroke_z_mm",
        "condition.motion",
    )
    columns = ("t_s", "x_mm", "y_mm", "z_mm", "error_x_um", "error_y_um", "error_z_um")
    campaign_columns = (*columns, "pose_1", "ball_1")
    sheet_columns = campaign_columns
    always_fitted = "Error motions, each driven by a few temperatures."
    instead: ClassVar[Mapping[str, str]] = {
        "rows": "dtwin twin fit CAMPAIGN --effects rigid_shift,axis_expansion --name NAME fits a twin of heat",
        "laws": "dtwin twin discover TWIN adds every error motion that the balls tell; dtwin train CAMPAIGN makes an equation",
        "twin_correction": "dtwin train CAMPAIGN makes an equation of the temperatures",
    }
    places: ClassVar[Mapping[str, str]] = {
        "machines": "_machines:MACHINES",
        "plan": "_plan:planned",
        "draft": "_plan:draft",
        "completed": "_check:with_strokes",
        "judge_run": "_check:judge_volumetric_run",
        "judge_campaign": "_check:judge_volumetric_campaign",
        "drawings": "dtwin.kinds.volumetric.twin_report:DRAWINGS",
        "effects": "dtwin.kinds.volumetric.motions:FAMILIES",
        "twins": "dtwin.kinds.volumetric.heat_twins:HeatTwins",
        "twin_report": "dtwin.kinds.volumetric.twin_report:REPORT",
        "training": "_training:train_volumetric",
        "recognises": "_training:is_volumetric_bundle",
        "gates": "_training:volumetric_gates",
        "champion_error": "_training:heat_error",
        "held_out": "_training:heat_held_out",
    }


KIND = _Volumetric()
