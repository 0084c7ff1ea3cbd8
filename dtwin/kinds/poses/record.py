"""Robot poses measured by a tracker: ISO 9283, and a twin of the arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

from dtwin.kinds.kind import FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.config import Home
    from dtwin.kinds.twin_report import TwinReport
    from dtwin.lifecycle.export import Export
    from dtwin.physics.effect import Effect
    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances
    from dtwin.schema import Campaign, Finding, Run
    from dtwin.twins.verbs import Twins


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
    figures = ("AP", "AP mean", "AD", "AD rms", "RP", "dAP", "dRP")
    read_with = (*Kind.read_with, "instrument.columns", "condition.joints_log", "condition.leave_out")
    settings = ("machine_geometry.urdf", "machine_geometry.urdf_tip", "condition.joints_log", "condition.leave_out")
    export_forms = ("urdf", "dh", "python", "matlab")
    always_fitted = "The instrument's frame and the tool are always fitted."
    instead: ClassVar[Mapping[str, str]] = {
        "rows": "dtwin twin fit CAMPAIGN --effects joint_zero,link_geometry --name NAME fits a twin of the arm"
    }

    @property
    def readers(self) -> Mapping[str, FileReader]:
        from dtwin.acquire.spreadsheet import SUFFIXES
        from dtwin.kinds.poses._read import read_poses

        return dict.fromkeys((".csv", *SUFFIXES), read_poses)

    def takes_alone(self, path: Path) -> bool:
        from dtwin.kinds.poses._read import is_pose_table

        return is_pose_table(path)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.kinds.poses._data import with_chain

        return with_chain(run, campaign)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.poses._check import judge_poses

        return judge_poses(run)

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.poses._sheet import pose_sheet

        return pose_sheet(runs, under)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.kinds.poses._sheet import pose_figure

        return pose_figure(runs)

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.poses._check import problem_of
        from dtwin.kinds.poses._iso9283 import figures

        told = {run.meta.run_id: figures(run, problem_of(run)) for run in runs}
        return {"iso9283": told}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.poses._iso9283 import lines

        return [line for run, found in result["iso9283"].items() for line in lines(run, found)]

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> Twins:
        from dtwin.kinds.poses._twins import PoseTwins

        # The same verbs, for a twin of an arm.
        return cast("Twins", PoseTwins(home))

    def export_twin(self, home: Home, name: str, form: str) -> Export:
        from dtwin.kinds.poses._export import export_twin

        return export_twin(home, name, form)

    @property
    def twin_report(self) -> TwinReport:
        from dtwin.kinds.poses import _twin_report as twin_report

        return twin_report


KIND = _Poses()
