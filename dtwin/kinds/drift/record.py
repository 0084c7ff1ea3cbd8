"""Drift: one displacement against logged temperatures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from dtwin.kinds.kind import Kind


class _Drift(Kind):
    name = "drift"
    columns = ("t_s", "displacement_um")
    stated = ()
    campaign_columns = ("t_s", "displacement_um", "sample_1", "temperature_*")
    sheet_columns = campaign_columns
    measured_by = ("probe", "taster", "displacement", "wegaufnehmer", "capacit", "kapazitiv", "eddy", "wirbelstrom")
    figures = ("d", "d(1 h)")
    read_with = (*Kind.read_with, "instrument.columns", "instrument.step_mm", "condition.step_mm")
    settings = ("instrument.step_mm", "condition.reads", "condition.step_mm")
    export_forms = ("klipper",)
    always_fitted = "Where the zero of the log lies."
    search_from = ("follows",)
    instead: ClassVar[Mapping[str, str]] = {
        "rows": "dtwin twin fit CAMPAIGN --effects follows --name NAME fits a twin of drift",
        "laws": "dtwin twin discover TWIN adds every sensor that the log follows; dtwin train CAMPAIGN makes an equation",
    }
    places: ClassVar[Mapping[str, str]] = {
        "machines": "_machines:MACHINES",
        "takes_alone": "_read:is_drift_log",
        "readers": "_read:READERS",
        "judge_run": "_check:judge_drift",
        "judge_campaign": "_check:judge_campaign_drift",
        "campaign_figures": "_check:drift_figures",
        "figure_lines": "_check:drift_lines",
        "effects": "_diagnosis:EFFECTS",
        "twins": "_twins:DriftTwins",
        "sheet": "_sheet:drift_sheet",
        "sheet_figure": "_sheet:drift_figure",
        "drawings": "_sheet:DRAWINGS",
        "variation": "_sheet:variation",
        "training": "_training:train_drift",
        "training_obstacle": "_training:obstacle",
        "gates": "_training:drift_gates",
        "twin_correction": "_correction:WAY",
        "run_errors": "_evidence:drift_errors",
        "champion_error": "_training:logs_error",
        "held_out": "_training:logs_held_out",
        "export_twin": "_export:export_twin",
        "twin_report": "_twin_report:REPORT",
    }


KIND = _Drift()
