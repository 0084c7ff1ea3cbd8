"""What the registry says of learned models, in the form that pages show."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.schema import require_name
from dtwin.statistics import deviation_interval
from flows.reach import running

if TYPE_CHECKING:
    from dtwin.train.gates import Verdict
    from dtwin.train.registry import RegisteredVersion, Registry

_FEED = "leave_feed_mm_min_out"
_RADIUS = "leave_radius_mm_out"


@dataclass(frozen=True)
class Judged:
    """A version with everything that a reviewer asks for.

    ``candidates``: candidates of its training, best first: ``name``, ``promotable``, ``complexity``, ``r2``,
    ``r2_text``, ``rms_um``, ``radius_rms_um``, ``worst``, ``p50_us``, ``p99_us``.
    ``front``: accuracy over complexity; empty when it was not kept.
    ``floor_um``, ``floor_dof``, ``before_um``: noise floor, its degrees of freedom, 0 when not counted, and error
    without a model; NaN when not logged.
    ``verdicts``: offline gates, as they judge now.
    ``evidence``: circles with and without correction.
    """

    version: RegisteredVersion
    candidates: tuple[Mapping[str, Any], ...]
    front: tuple[Mapping[str, Any], ...]
    floor_um: float
    floor_dof: float
    before_um: float
    verdicts: tuple[Verdict, ...]
    evidence: Mapping[str, Any] | None

    @property
    def floor_band_um(self) -> tuple[float, float] | None:
        """95 % interval of the noise floor, None while its degrees of freedom are not known."""
        return deviation_interval(self.floor_um, self.floor_dof) if self.floor_dof else None


def registry_of(home: Home) -> Registry | None:
    """Return the registry, None while there is none: asking must not make one."""
    if home.no_registry_yet:
        return None
    from dtwin.train.registry import Registry

    return Registry(home)


def require_registry(home: Home, machine: str) -> Registry:
    """Return the registry, to ask it for versions of a machine: the name becomes a part of its question."""
    require_name(machine, "the machine")
    registry = registry_of(home)
    if registry is None:
        raise InputError("no model is registered yet", code="model.unknown", hint="dtwin train CAMPAIGN")
    return registry


def judged(registry: Registry, machine: str, wanted: str) -> Judged:
    """Return a version with everything that a reviewer asks for."""
    from dtwin.train.candidate_runs import training_candidates, training_metrics
    from dtwin.train.evidence_record import newest
    from dtwin.train.promotion import check_version

    version = registry.version(machine, wanted)
    _, verdicts = check_version(registry, version)
    logged = training_candidates(registry, version)
    training = training_metrics(registry, version)
    record = newest(registry, version)
    scored = {c["name"]: c for c in logged if f"{_FEED}.rms_um" in c["metrics"]}
    zero_um = scored["zero"]["metrics"][f"{_FEED}.rms_um"] if "zero" in scored else None
    rows = [_row(c, zero_um) for c in scored.values()]
    return Judged(
        version=version,
        candidates=tuple(sorted(rows, key=lambda row: row["rms_um"])),
        front=_front(registry, version),
        floor_um=training.get("noise_floor_um", math.nan),
        floor_dof=training.get("noise_floor_dof", 0.0),
        before_um=training.get("rms_before_um", math.nan),
        verdicts=tuple(verdicts),
        evidence=record.content if record else None,
    )


def mlflow_page(home: Home, model: str, version: str) -> str | None:
    """Return the address of a version's MLflow page, None while ``dtwin up`` does not run."""
    address = running(home).get("mlflow")
    return f"{address}/#/models/{model}/versions/{version}" if address else None


def _row(logged: Mapping[str, Any], zero_um: float | None) -> dict[str, Any]:
    from dtwin.train.results import r2_text

    metrics: Mapping[str, float] = logged["metrics"]
    r2, rms_um = metrics[f"{_FEED}.r2"], metrics[f"{_FEED}.rms_um"]
    return {
        "name": logged["name"],
        "promotable": logged["params"].get("promotable") == "True",
        "complexity": metrics.get("complexity"),
        "r2": r2,
        "r2_text": r2_text(r2, rms_um, zero_um),
        "rms_um": rms_um,
        "radius_rms_um": metrics.get(f"{_RADIUS}.rms_um"),
        "worst": metrics.get(f"{_FEED}.worst_slice_ratio"),
        "p50_us": metrics.get("latency_p50_us"),
        "p99_us": metrics.get("latency_p99_us"),
    }


def _front(registry: Registry, version: RegisteredVersion) -> tuple[Mapping[str, Any], ...]:
    try:
        front: Sequence[Mapping[str, Any]] = registry.read_json(version, "front.json")
    except InputError:
        return ()
    return tuple(point for point in front if "terms" in point)
