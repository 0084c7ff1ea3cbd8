"""Drift: one displacement against logged temperatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

from dtwin.kinds.kind import FileReader, Kind

if TYPE_CHECKING:
    from pathlib import Path

    from dtwin.config import Home
    from dtwin.physics.effect import Effect
    from dtwin.schema import Finding, Run
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
        "laws": "dtwin twin discover TWIN adds every sensor that the log follows; dtwin train CAMPAIGN makes an equation",
    }
    places: ClassVar[Mapping[str, str]] = {
        "machines": "_machines:MACHINES",
        "takes_alone": "_read:is_drift_log",
        "judge_run": "_check:judge_drift",
        "sheet": "_sheet:drift_sheet",
        "sheet_figure": "_sheet:drift_figure",
        "drawings": "_sheet:DRAWINGS",
        "variation": "_sheet:variation",
        "training": "_training:train_drift",
        "training_obstacle": "_training:obstacle",
        "gates": "_training:drift_gates",
        "twin_correction": "_correction:WAY",
        "run_errors": "_evidence:drift_errors",
        "champion_error": "_champion:logs_error",
        "held_out": "_champion:logs_held_out",
        "export_twin": "_export:export_twin",
        "twin_report": "_twin_report",
    }

    def reader_of(self, path: Path) -> FileReader | None:
        from dtwin.kinds.drift._read import SUFFIXES, read_drift

        return read_drift if path.suffix.lower() in SUFFIXES else None

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.drift._check import judge_campaign_drift

        whole = [run for run in runs if run.samples]
        return judge_campaign_drift(whole) if len(whole) > 1 else []

    def twins(self, home: Home, library: Mapping[str, Effect] | None) -> Twins:
        from dtwin.kinds.drift._twins import DriftTwins

        # The same verbs, for a twin of a log.
        return cast("Twins", DriftTwins(home))

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.drift._check import drift_figures

        return {"drift": drift_figures(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.drift._check import drift_lines

        return drift_lines(result["drift"])


KIND = _Drift()
