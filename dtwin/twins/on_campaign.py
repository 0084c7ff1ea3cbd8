"""What the twins of a machine say of a campaign: the diagnosis of theirs, the error on a new one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.report.twin_of_kind import report_of
from dtwin.twins.of_kind import every_shelf


@dataclass(frozen=True)
class TwinView:
    """One twin on one campaign.

    ``diagnosed``: whether the campaign is the one that it was fitted to; otherwise it was compared.
    ``result``: diagnosis or comparison, as ``--json`` prints it.
    """

    name: str
    version: int
    diagnosed: bool
    result: dict[str, Any]
    text: str

    @property
    def headline(self) -> str:
        """One line."""
        if self.diagnosed:
            return f"{self.result['verdict']}: {self.result['headline']}"
        return (
            f"residual {self.result['residual_rms_um']:z.2f} µm RMS, noise floor "
            f"{self.result['noise_floor_um']:z.2f} µm"
        )


def look_at(home: Home, machine: str, campaign: str) -> list[TwinView]:
    """Diagnose or compare every twin of a machine that is of the kind of a campaign, which is in the lake."""
    views = []
    lake = Lake(home.lake)
    kind = lake.campaign(campaign).kind
    for twins in every_shelf(home):
        for name in twins.names():
            twin = twins.newest(name)
            of_twin = twin.campaigns
            if twin.machine != machine or all(lake.campaign(own).kind != kind for own in of_twin):
                continue
            if campaign in of_twin:
                _, diagnosis = twins.diagnose(name)
                result = diagnosis.as_dict()
                text = report_of(result).diagnosis_text(name, result)
            else:
                result = twins.compare(name, campaign).as_dict()
                text = report_of(result).comparison_text(result)
            views.append(TwinView(name, twin.version, campaign in of_twin, result, text))
    return views
