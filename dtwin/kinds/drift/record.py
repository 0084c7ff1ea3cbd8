"""Drift: one displacement against logged temperatures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

from dtwin.kinds.kind import FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    import plotly.graph_objects as go

    from dtwin.config import Home
    from dtwin.kinds.machine import VirtualMachine
    from dtwin.kinds.twin_report import TwinReport
    from dtwin.lake.store import Lake
    from dtwin.lifecycle.export import Export
    from dtwin.physics.effect import Effect
    from dtwin.progress import Progress
    from dtwin.report.sheet import Sheet
    from dtwin.report.uncertainty import Circumstances, Variation
    from dtwin.schema import Finding, Run
    from dtwin.serve.bundle import Bundle
    from dtwin.train.champion_error import ChampionError, HeldOut
    from dtwin.train.gates import Verdict
    from dtwin.train.results import Training
    from dtwin.train.run_errors import RunError
    from dtwin.twins.verbs import Twins


class _Drift(Kind):
    name = "drift"
    columns = ("t_s", "displacement_um")
    stated = ()
    campaign_columns = ("t_s", "displacement_um", "sample_1", "temperature_*")
    sheet_columns = campaign_columns
    figures = ("d", "d(1 h)")
    read_with = (*Kind.read_with, "instrument.columns", "instrument.step_mm", "condition.step_mm")
    settings = ("instrument.step_mm", "condition.reads", "condition.step_mm")
    export_forms = ("klipper",)
    always_fitted = "Where the zero of the log lies."
    instead: ClassVar[Mapping[str, str]] = {
        "rows": "dtwin twin fit CAMPAIGN --effects follows --name NAME fits a twin of drift",
        "twin_correction": "dtwin train CAMPAIGN makes the same terms an equation",
    }

    @property
    def machines(self) -> Sequence[VirtualMachine]:
        from dtwin.kinds.drift._machines import MACHINES

        return MACHINES

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.drift._read import SUFFIXES, read_drift

        return read_drift if path.suffix.lower() in SUFFIXES else None

    def takes_alone(self, path: Path) -> bool:
        from dtwin.kinds.drift._read import is_drift_log

        return is_drift_log(path)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.drift._check import judge_drift

        return judge_drift(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.drift._check import judge_campaign_drift

        whole = [run for run in runs if run.samples]
        return judge_campaign_drift(whole) if len(whole) > 1 else []

    def sheet(self, runs: Sequence[Run], under: Circumstances) -> Sheet:
        from dtwin.kinds.drift._sheet import drift_sheet

        return drift_sheet(runs, under)

    def sheet_figure(self, runs: Sequence[Run]) -> go.Figure:
        from dtwin.kinds.drift._sheet import drift_figure

        return drift_figure(runs)

    def variation(self, runs: Sequence[Run], campaign: str) -> Variation | None:
        from dtwin.kinds.drift._sheet import variation

        return variation(runs, campaign)

    def training(self) -> Callable[..., Training]:
        from dtwin.kinds.drift._training import train_drift

        return train_drift

    def training_obstacle(self, rows: Sequence[Mapping[str, Any]]) -> str:
        from dtwin.kinds.drift._training import obstacle

        return obstacle(rows)

    def gates(self, bundle: Bundle, metrics: Mapping[str, float]) -> list[Verdict]:
        from dtwin.kinds.drift._training import drift_gates

        return drift_gates(bundle, metrics)

    def run_errors(self, runs: Sequence[Run]) -> list[RunError]:
        from dtwin.kinds.drift._evidence import drift_errors

        return drift_errors(runs)

    def champion_error(
        self,
        lake: Lake,
        rows: Sequence[dict[str, Any]],
        bundle: Bundle,
        metrics: Mapping[str, float],
        progress: Progress | None = None,
    ) -> ChampionError:
        from dtwin.kinds.drift._champion import logs_error

        return logs_error(lake, rows, bundle)

    def held_out(self, known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
        from dtwin.kinds.drift._champion import logs_held_out

        return logs_held_out(known, fresh)

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> Twins:
        from dtwin.kinds.drift._twins import DriftTwins

        # The same verbs, for a twin of a log.
        return cast("Twins", DriftTwins(home))

    def export_twin(self, home: Home, name: str, form: str) -> Export:
        from dtwin.kinds.drift._export import export_twin

        return export_twin(home, name, form)

    @property
    def twin_report(self) -> TwinReport:
        from dtwin.kinds.drift import _twin_report as twin_report

        return twin_report

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.drift._check import drift_figures

        return {"drift": drift_figures(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.drift._check import drift_lines

        return drift_lines(result["drift"])


KIND = _Drift()
