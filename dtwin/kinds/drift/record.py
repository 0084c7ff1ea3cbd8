"""Drift: one displacement against logged temperatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from dtwin.kinds.kind import FileReader, Kind

if TYPE_CHECKING:
    from dtwin.schema import Finding, Run


class _Drift(Kind):
    name = "drift"
    columns = ("t_s", "displacement_um")
    campaign_columns = ("t_s", "displacement_um", "sample_1", "temperature_*")
    instead: ClassVar[Mapping[str, str]] = {
        "twins": "dtwin check CAMPAIGN tells what the displacement follows, and what that lacks",
        "rows": "dtwin check CAMPAIGN tells what the displacement follows, and what that lacks",
        "sheet": "dtwin check CAMPAIGN tells coefficients with their uncertainty",
    }

    @property
    def readers(self) -> Mapping[str, FileReader]:
        from dtwin.acquire.spreadsheet import SUFFIXES
        from dtwin.kinds.drift._read import read_drift

        return dict.fromkeys((".csv", *SUFFIXES), read_drift)

    def judge_run(self, run: Run) -> list[Finding]:
        from dtwin.kinds.drift._check import judge_drift

        return judge_drift(run)

    def judge_campaign(self, runs: Sequence[Run]) -> list[Finding]:
        from dtwin.kinds.drift._check import judge_campaign_drift

        whole = [run for run in runs if run.samples]
        return judge_campaign_drift(whole) if len(whole) > 1 else []

    def campaign_figures(self, runs: Sequence[Run]) -> Mapping[str, Any]:
        from dtwin.kinds.drift._check import drift_figures

        return {"drift": drift_figures(runs)}

    def figure_lines(self, result: Mapping[str, Any]) -> list[str]:
        from dtwin.kinds.drift._check import drift_lines

        return drift_lines(result["drift"])


KIND = _Drift()
