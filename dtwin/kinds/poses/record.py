"""Robot poses measured by a tracker: ISO 9283, and a twin of the arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Kind
from dtwin.progress import Progress, silent

if TYPE_CHECKING:
    from dtwin.schema import Run


class _Poses(Kind):
    name = "poses"
    columns = ("t_s", "joint_1_deg")
    stated = ()
    # Those of arms of up to nine joints, and of both ways to write a measurement.
    campaign_columns = (
        *(f"joint_{j}_deg" for j in range(1, 10)),
        *(f"{what}_{a}_mm" for what in ("measured", "target", "error") for a in "xyz"),
        *(f"target_q{a}_1" for a in "xyzw"),
        "ambient_c",
    )
    sheet_columns = campaign_columns
    measured_by = ("tracker", "photogram", "fotogram", "measuring arm", "messarm")
    figures = ("AP", "AP mean", "AD", "AD rms", "RP", "dAP", "dRP")
    read_with = (*Kind.read_with, "instrument.columns", "condition.joints_log", "condition.leave_out")
    settings = ("machine_geometry.urdf", "machine_geometry.urdf_tip", "condition.joints_log", "condition.leave_out")
    export_forms = ("urdf", "dh", "python", "matlab")
    always_fitted = "The instrument's frame and the tool are always fitted."
    instead: ClassVar[Mapping[str, str]] = {
        "rows": "dtwin twin fit CAMPAIGN --effects joint_zero,link_geometry --name NAME fits a twin of the arm",
        "laws": "dtwin twin discover TWIN adds every effect that the poses tell",
        "training": "dtwin twin discover TWIN finds what is wrong with the arm, dtwin export TWIN --as dh writes it",
        "twin_correction": "an arm takes corrected geometry, and no offset while it moves: dtwin export TWIN --as dh; measure "
        "again, then dtwin twin confirm TWIN EFFECT --after CAMPAIGN",
    }
    places: ClassVar[Mapping[str, str]] = {
        "takes_alone": "_read:is_pose_table",
        "readers": "_read:READERS",
        "completed": "_data:with_chain",
        "judge_run": "_check:judge_poses",
        "sheet": "_sheet:pose_sheet",
        "sheet_figure": "_sheet:pose_figure",
        "drawings": "_sheet:DRAWINGS",
        "export_twin": "_export:export_twin",
        "effects": "_effects:EFFECTS",
        "twins": "_twins:PoseTwins",
        "twin_report": "_twin_report:REPORT",
    }

    def campaign_figures(self, runs: Sequence[Run], progress: Progress = silent) -> Mapping[str, Any]:
        from dtwin.kinds.poses._check import problem_of
        from dtwin.kinds.poses._iso9283 import figures

        told = {run.meta.run_id: figures(run, problem_of(run)) for run in runs}
        return {"iso9283": told}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.poses._iso9283 import lines

        return [line for run, figures in result["iso9283"].items() for line in lines(run, figures)]


KIND = _Poses()
