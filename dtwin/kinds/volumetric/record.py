"""Ball arrays probed while a machine warms: geometric and thermal errors of a volume."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import Kind, Planned

if TYPE_CHECKING:
    from dtwin.config import Home
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.kinds.twin_report import TwinReport
    from dtwin.kinds.volumetric._twins import HeatTwins
    from dtwin.lake.store import Lake
    from dtwin.physics.effect import Effect
    from dtwin.progress import Progress
    from dtwin.schema import Campaign, Finding, Run
    from dtwin.serve.bundle import Bundle
    from dtwin.train.champion_error import ChampionError, HeldOut
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training


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
        "rows": "dtwin twin fit CAMPAIGN --effects rigid_shift,axis_expansion --name NAME fits a twin of heat"
    }

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.volumetric._machines import MACHINES

        return MACHINES

    def plan(self, document: Mapping[str, Any], where: str) -> Planned:
        from dtwin.kinds.volumetric._planned import planned

        return planned(document, where)

    def draft(self, machine: str, axes: Mapping[str, Mapping[str, float]]) -> Mapping[str, Any]:
        from dtwin.kinds.volumetric._planned import draft

        return draft(machine)

    def completed(self, run: Run, campaign: Campaign) -> Run:
        from dtwin.kinds.volumetric._check import with_strokes

        return with_strokes(run, campaign)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.volumetric._check import judge_volumetric_run

        return judge_volumetric_run(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.volumetric._check import judge_volumetric_campaign

        return judge_volumetric_campaign(runs)

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> HeatTwins:
        from dtwin.kinds.volumetric._twins import HeatTwins

        return HeatTwins(home)

    @property
    def twin_report(self) -> TwinReport:
        from dtwin.kinds.volumetric import _twin_report as twin_report

        return twin_report

    def training(self) -> Callable[..., Training]:
        from dtwin.kinds.volumetric._training import train_volumetric

        return train_volumetric

    def recognises(self, bundle: Bundle) -> bool:
        from dtwin.kinds.volumetric._bundle import is_volumetric_bundle

        return is_volumetric_bundle(bundle)

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.kinds.volumetric._gates import volumetric_gates

        return volumetric_gates(bundle, metrics)

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress | None = None,
    ) -> ChampionError:
        from dtwin.kinds.volumetric._drift import heat_error

        return heat_error(lake, rows, bundle, progress)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        from dtwin.kinds.volumetric._drift import heat_held_out

        return heat_held_out(known, fresh)


KIND = _Volumetric()
