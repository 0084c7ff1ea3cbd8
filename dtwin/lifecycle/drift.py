"""What new runs say of the champion, without fitting anything to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.registry import kind_named, kind_of
from dtwin.lake.store import TABLES, Lake
from dtwin.progress import Progress, silent
from dtwin.schema import Finding
from dtwin.serve.bundle import Bundle
from dtwin.train.champion_error import ChampionError, um_text
from dtwin.train.registry import RegisteredVersion, Registry

_DRIFT = "champion.drift"


@dataclass(frozen=True)
class DriftCheck:
    """Whether the champion's error has grown.

    ``error``: on runs it was never trained on; None without any.
    ``expected_um``: held-out error that was registered with it; NaN when none fits the campaign.
    ``excess_um``: by how much the error has grown, in quadrature; NaN when not judged.
    ``drifted``: whether that is more than the noise floor.
    ``reason``: the verdict in words, or why there is none.
    """

    version: str
    campaign: str
    error: ChampionError | None
    expected_um: float
    expected_from: str
    excess_um: float
    drifted: bool
    reason: str

    @property
    def finding(self) -> Finding | None:
        """The diagnosis, None without drift."""
        if not self.drifted or self.error is None:
            return None
        numbers = {
            "rms_um": self.error.rms_um,
            "expected_um": self.expected_um,
            "excess_um": self.excess_um,
            "noise_floor_um": self.error.noise_floor_um,
        }
        return Finding(_DRIFT, "warning", self.reason, numbers)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        finding = self.finding
        return _plain(vars(self)) | {
            "error": _plain(vars(self.error)) if self.error else None,
            "finding": finding.as_dict() if finding else None,
        }


def campaign_of(registry: Registry, version: RegisteredVersion) -> str:
    """Return the campaign that a version was trained on."""
    return str(registry.client.get_run(version.run_id).data.params.get("campaign", ""))


def trained_rows(registry: Registry, lake: Lake, version: RegisteredVersion) -> list[dict[str, Any]]:
    """Return the rows of ``runs`` that a version was trained on, by its table version.

    ``lake``: says what the campaign held then.
    """
    params = registry.client.get_run(version.run_id).data.params
    at = {name: int(params.get(f"table_version.{name}", -1)) for name in TABLES}
    rows = lake.runs(str(params.get("campaign", "")), at=at)
    return [row for row in rows if usable(row)]


def left_out_since(registry: Registry, lake: Lake, version: RegisteredVersion) -> list[str]:
    """Return the runs that a version was trained on and that are left out now."""
    trained = {row["run_id"] for row in trained_rows(registry, lake, version)}
    now = lake.runs(campaign_of(registry, version), left_out=True)
    return [row["run_id"] for row in now if row["left_out"] is not None and row["run_id"] in trained]


def require_training(home: Home, version: RegisteredVersion) -> None:
    """Refuse a version that was trained on runs that are left out now.

    Raises ``GateRefusal``.
    """
    registry = Registry(home)
    if out := left_out_since(registry, Lake(home.lake), version):
        campaign = campaign_of(registry, version)
        raise GateRefusal(
            f"version {version.version} was trained on runs that are left out now",
            code="promote.trained",
            where=f"campaign {campaign}",
            got=", ".join(out)[:200],
            hint=f"dtwin train {campaign} makes a version without them; dtwin restore takes them in again",
        )


def usable(row: Any) -> bool:
    """Tell whether training would use a run: complete, without a data-quality error."""
    return bool(row["n_errors"] == 0 and row["status"] == "complete")


def check_drift(home: Home, champion: RegisteredVersion, campaign: str, progress: Progress = silent) -> DriftCheck:
    """Judge the champion on those runs of a campaign that it was never trained on.

    Mean squares add: what the champion's error has grown by is the root of the difference of
    squares of its error now and of the error that was registered as to be expected, which the kind of
    campaign names: with runs left out, or with what the new runs have and the trained ones had not. It has
    drifted when that exceeds what repeats of the same condition disagree by.
    """
    lake, registry = Lake(home.lake), Registry(home)
    known = trained_rows(registry, lake, champion)
    seen = {row["content_sha256"] for row in known}
    fresh = [r for r in lake.runs(campaign) if usable(r) and r["content_sha256"] not in seen]

    def silent(reason: str, error: ChampionError | None = None) -> DriftCheck:
        nan = float("nan")
        return DriftCheck(champion.version, campaign, error, nan, "", nan, False, reason)

    if not fresh:
        return silent("the champion was trained on every usable run of this campaign")
    try:
        fitting = kind_named(fresh[0]["kind"]).held_out(known, fresh)
        error = champion_error(registry, champion, lake, fresh, progress)
    except InputError as refused:
        return silent(refused.message)
    left_out = fitting.left_out
    expected = registry.metrics(champion).get(fitting.metric, float("nan"))
    if np.isnan(expected):
        return silent("no held-out error was registered with the champion", error)
    if np.isnan(error.noise_floor_um):
        return silent("without repeats of a condition the noise floor is not known", error)
    excess = float(np.sqrt(max(0.0, error.rms_um**2 - expected**2)))
    drifted = excess > error.noise_floor_um
    reason = (
        f"champion {champion.version} leaves {um_text(error.rms_um)} µm on {error.n_runs} runs of "
        f"{campaign} that it never saw, {um_text(expected)} µm were registered with it "
        f"({left_out} left out): grown by {um_text(excess)} µm in quadrature, "
        f"{'more' if drifted else 'not more'} than the noise floor of "
        f"{um_text(error.noise_floor_um)} µm"
    )
    return DriftCheck(champion.version, campaign, error, expected, left_out, excess, drifted, reason)


def champion_error(
    registry: Registry,
    champion: RegisteredVersion,
    lake: Lake,
    rows: Sequence[dict[str, Any]],
    progress: Progress = silent,
) -> ChampionError:
    """Return a version's error on runs in the lake, with its frozen bundle.

    ``rows``: rows of the table ``runs``, of one campaign.
    Raises ``InputError`` when the bundle corrects another kind, or needs more than recorded runs tell.
    """
    bundle = Bundle.from_dict(registry.bundle(champion))
    own, asked = kind_of(bundle), kind_named(rows[0]["kind"])
    if own.name != asked.name:
        raise InputError(
            f"the champion corrects {own.name} campaigns",
            code="drift.kind",
            where=f"machine {champion.machine} version {champion.version}",
            got=asked.name,
            allowed=own.name,
        )
    return asked.champion_error(lake, rows, bundle, registry.metrics(champion), progress)


def _plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields with NaN as None, which JSON knows."""
    return {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in fields.items()}
