"""Measurements for a twin, and how it compares with them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtwin.acquire.amending import AMENDED, amendment_findings
from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.features.encoder_split import Cutoff
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics import localise
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import Twin, by_condition
from dtwin.physics.whitening import PureError, pure_error, to_harmonics
from dtwin.schema import Campaign, Floats, of_one_way
from dtwin.twins._reduced_runs import keep_reduced, read_reduced, stamp_of
from dtwin.twins.encoder_comparison import DEFAULT_CUTOFF, controller_rows_um, encoder_split


@dataclass(frozen=True)
class Loaded:
    """Runs of a campaign, ready to look at.

    ``data``: table versions, a hash of what was used, ``left_out``: runs and why, and ``amended``: what was stated
    anew.
    ``controller_um``, shape (rows, n): following error that the controller saw; None when it was not logged.
    """

    obs: Observations
    data: Mapping[str, Any]
    controller_um: Floats | None = None


@dataclass(frozen=True)
class Comparison:
    """Measured against predicted.

    ``residual_um``, shape (rows, n): measured minus predicted.
    ``before_um``, shape (rows, n): measured, set-ups taken out.
    ``warnings``: what a reader must know: another machine, outside the box.
    ``controller_um``, shape (rows, n): following error that the controller saw; None when it was not logged.
    """

    twin: Twin
    obs: Observations
    residual_um: Floats
    before_um: Floats
    warnings: tuple[str, ...]
    controller_um: Floats | None = None

    def as_dict(self, cutoff: Cutoff = DEFAULT_CUTOFF) -> dict[str, Any]:
        """Return a JSON-ready mapping.

        ``cutoff``: where quasi-static ends and dynamic begins, when the controller was logged.
        """
        obs = self.obs
        parts = encoder_split(obs, self.controller_um, cutoff)
        floor = _pure_error(obs, self.residual_um)
        return {
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": obs.campaign.name,
            "runs": len(set(obs.run_of.tolist())),
            "rms_before_um": obs.rms(self.before_um),
            "residual_rms_um": obs.rms(self.residual_um),
            "systematic_rms_um": localise.systematic_rms_um(obs, self.residual_um),
            "noise_floor_um": float("nan") if floor is None else floor.floor_um,
            "noise_floor_dof": 0 if floor is None else floor.dof,
            "conditions": list(by_condition(obs, self.before_um, self.residual_um)),
            "where": [dict(w) for w in localise.worst_places(obs, self.residual_um)],
            "headline": localise.headline(obs, self.residual_um),
            "encoder_split": None if parts is None else parts.as_dict(),
            "warnings": list(self.warnings),
        }


def pure_rms_um(obs: Observations, residual_um: Floats) -> float:
    """Return the RMS of one run about the mean of its condition; NaN without repeats."""
    pure = _pure_error(obs, residual_um)
    return float("nan") if pure is None else pure.floor_um


def _pure_error(obs: Observations, residual_um: Floats) -> PureError | None:
    return pure_error(to_harmonics(residual_um), obs.condition_of, float(obs.mask.mean()))


def load(home: Home, campaign: str) -> Loaded:
    """Return the usable runs of a campaign.

    ``campaign``: name in the lake, or a file or folder, which is ingested first.
    Raises ``InputError`` when there is no such campaign, or no usable run in it.
    """
    lake = Lake(home.lake)
    name = in_lake(home, campaign)
    found = lake.campaign(name)
    rows = lake.runs(name, left_out=True)
    left_out = {str(row["run_id"]): why for row in rows if (why := row["left_out"] or _error_in(row))}
    sound = [row for row in rows if str(row["run_id"]) not in left_out]
    usable = of_one_way(sound)
    if corrected := [str(row["run_id"]) for row in sound if row not in usable]:
        left_out[", ".join(corrected)] = "measured with a correction"
    if not usable:
        why = "; ".join(f"{k}: {v}" for k, v in list(left_out.items())[:3])
        raise InputError(
            "the campaign has no usable run",
            code="twin.no_runs",
            where=name,
            got=why or "no runs",
            hint=f"dtwin check {name}",
        )
    kind_named(found.kind).require("rows")
    data = lake.provenance(usable, len(usable)) | {
        "left_out": left_out,
        "amended": [f.message for f in amendment_findings(rows) if f.code == AMENDED],
    }
    obs, controller_um = _reduced(home, lake, found, usable)
    return Loaded(obs, data, controller_um)


def _error_in(row: Mapping[str, Any]) -> str:
    """Return the first error that was found in a run, empty when there is none."""
    findings = json.loads(row["findings_json"])
    return next((str(f["message"]) for f in findings if f["severity"] == "error"), "")


def _reduced(
    home: Home, lake: Lake, campaign: Campaign, rows: Sequence[Mapping[str, Any]]
) -> tuple[Observations, Floats | None]:
    stamp = stamp_of(rows)
    kept = read_reduced(home, campaign.name, stamp)
    if kept is not None:
        return kept
    runs = [lake.load(row, signals=False) for row in rows]
    obs = observe(campaign, runs)
    made = obs, controller_rows_um(runs) if obs.grid is CIRCLE else None
    keep_reduced(home, campaign.name, stamp, made)
    return made
