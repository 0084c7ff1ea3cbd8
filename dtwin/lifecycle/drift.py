"""What new runs say of the champion, without fitting anything to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.features.motion import PATH_INPUTS
from dtwin.lake.store import TABLES, Lake
from dtwin.progress import Progress
from dtwin.schema import Finding, Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.candidates import score
from dtwin.train.dataset import TICK_HZ, TickRun, load_ticks
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import FRESH_RUN
from dtwin.train.rows import gather, noise_floor_um

_DRIFT = "champion.drift"


@dataclass(frozen=True)
class ChampionError:
    """The champion's error on runs, as if it had been served to them.

    ``rms_um``, ``before_um``: set-up-corrected error with the champion, and without any model.
    ``noise_floor_um``: what repeats disagree by; NaN without repeats.
    ``outside_box_share``: share of the rows at which serving would have sent no correction.
    """

    rms_um: float
    before_um: float
    noise_floor_um: float
    outside_box_share: float
    n_runs: int


@dataclass(frozen=True)
class DriftCheck:
    """Whether the champion's error has grown.

    Attributes
    ----------
    version, campaign : str
        The champion, and the campaign it was judged on.
    error : ChampionError or None
        On runs it was never trained on; None without any.
    expected_um : float
        Held-out error that was registered with it; NaN when none fits the campaign.
    expected_from : str
        Which of the registered errors.
    excess_um : float
        By how much the error has grown, in quadrature; NaN when not judged.
    drifted : bool
        Whether that is more than the noise floor.
    reason : str
        The verdict in words, or why there is none.
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
        found = self.finding
        return _plain(vars(self)) | {
            "error": _plain(vars(self.error)) if self.error else None,
            "finding": found.as_dict() if found else None,
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


def usable(row: Any) -> bool:
    """Tell whether training would use a run: complete, without a data-quality error."""
    return bool(row["n_errors"] == 0 and row["status"] == "complete")


def check_drift(home: Home, champion: RegisteredVersion, campaign: str, progress: Progress | None = None) -> DriftCheck:
    """Judge the champion on those runs of a campaign that it was never trained on.

    Mean squares add: what the champion's error has grown by is the root of the difference of
    squares of its error now and of the error that was registered as to be expected: on a fresh run
    of a trained condition, or, for radii or feeds that it was never trained on, with these left
    out. It has drifted when that exceeds what repeats of the same condition disagree by. Planes
    that it was never trained on say nothing about drift.
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
    strange = {r["plane"] for r in fresh} - {r["plane"] for r in known}
    if strange:
        return silent(f"the champion was never trained on {', '.join(sorted(strange))}")
    error = champion_error(registry, champion, lake, fresh, progress)
    new = [g for g in ("radius_mm", "feed_mm_min") if {r[g] for r in fresh} - {r[g] for r in known}]
    left_out = new[0] if new else "run"
    expected = registry.metrics(champion).get(f"leave_{left_out}_out.rms_um" if new else FRESH_RUN, float("nan"))
    if np.isnan(expected):
        return silent("no held-out error was registered with the champion", error)
    if np.isnan(error.noise_floor_um):
        return silent("without repeats of a condition the noise floor is not known", error)
    excess = float(np.sqrt(max(0.0, error.rms_um**2 - expected**2)))
    drifted = excess > error.noise_floor_um
    reason = (
        f"champion {champion.version} leaves {error.rms_um:z.1f} µm on {error.n_runs} runs of "
        f"{campaign} that it never saw, {expected:z.1f} µm were registered with it "
        f"({left_out} left out): grown by {excess:z.1f} µm in quadrature, "
        f"{'more' if drifted else 'not more'} than the noise floor of "
        f"{error.noise_floor_um:z.1f} µm"
    )
    return DriftCheck(champion.version, campaign, error, expected, left_out, excess, drifted, reason)


def champion_error(
    registry: Registry,
    champion: RegisteredVersion,
    lake: Lake,
    rows: Sequence[dict[str, Any]],
    progress: Progress | None = None,
) -> ChampionError:
    """Return a version's error on runs in the lake, with its frozen bundle.

    ``rows``: rows of the table ``runs``, of one campaign.
    Raises ``InputError`` when the bundle needs more than the path says, or predicts no radial error.
    """
    bundle = Bundle.from_dict(registry.bundle(champion))
    _require_path_only(bundle)
    horizon_s = registry.metrics(champion).get("horizon_ms", 0.0) / 1000.0
    campaign = lake.campaign(rows[0]["campaign"])
    found = gather(load_ticks(lake, campaign, rows, progress))
    parts = [_predicted_um(bundle, run, horizon_s) for run in found.runs]
    predicted = np.concatenate([values for values, _ in parts])
    return ChampionError(
        rms_um=score(found, predicted, "run_id").rms_um,
        before_um=found.rms_um(found.target_um),
        noise_floor_um=noise_floor_um(found)[0],
        outside_box_share=float(np.mean(np.concatenate([outside for _, outside in parts]))),
        n_runs=len(found.runs),
    )


def _predicted_um(bundle: Bundle, run: TickRun, horizon_s: float) -> tuple[Floats, Any]:
    """Return a bundle's radial error at the rows of a run, and where it lies outside its box.

    ``bundle``: a bundle over path inputs.
    ``horizon_s``: how far the equation looks ahead: its output at a tick is for that much later.
    Returns (rows,): clamped, and zero outside the validity box, as served.
    """
    columns = [PATH_INPUTS.index(name) for name in bundle.tick_inputs]
    inputs = run.inputs[:, columns].astype(float)
    values = CompiledBundle(bundle).run(inputs)[:, 0]
    low, high = (np.array([getattr(i, end) for i in bundle.inputs]) for end in ("low", "high"))
    outside = ((inputs < low) | (inputs > high)).any(axis=1) | ~np.isfinite(values)
    limit = bundle.safety.clamp_um
    sign = 1.0 if bundle.outputs[0].role == "error" else -1.0
    served = np.where(outside, 0.0, sign * np.clip(np.nan_to_num(values), -limit, limit))
    ticks = np.clip(run.arc - round(horizon_s * TICK_HZ), 0, None)
    return served[ticks], outside[ticks]


def _plain(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields with NaN as None, which JSON knows."""
    return {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in fields.items()}


def _require_path_only(bundle: Bundle) -> None:
    missing = [name for name in bundle.tick_inputs if name not in PATH_INPUTS]
    missing += bundle.feature_inputs
    frames = [output.frame for output in bundle.outputs]
    if missing or frames != ["path_radial"]:
        raise InputError(
            "this champion cannot be judged on recorded runs",
            code="drift.bundle",
            where=f"machine {bundle.machine} version {bundle.model_version}",
            got=", ".join(missing + [f for f in frames if f != "path_radial"]),
            allowed="inputs of the path, one radial output",
        )
