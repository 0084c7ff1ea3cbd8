"""What the registry keeps of a training and its candidates, by the names that gates and pages read."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from dtwin import __version__
from dtwin.train.results import Candidate, TrainingReport

_PACKAGES = ("numpy", "scipy", "scikit-learn", "pyoperon", "numba", "mlflow", "deltalake")


def environment() -> dict[str, str]:
    """Return the versions that a result depends on."""
    versions = {"python": platform.python_version(), "dtwin": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "absent"
    return versions


def report_params(report: TrainingReport) -> dict[str, Any]:
    """Return what is logged of a training: what it was made from, and with which versions."""
    return {
        "machine": report.machine,
        "campaign": report.campaign,
        "seed": report.seed,
        "n_runs": report.n_runs,
        "n_rows": report.n_rows,
        **{f"table_version.{k}": v for k, v in report.table_versions.items()},
        **{f"version.{k}": v for k, v in environment().items()},
    }


def report_metrics(report: TrainingReport) -> dict[str, float]:
    """Return the figures of a training that belong to no candidate."""
    return {
        "noise_floor_um": report.noise_floor_um,
        "noise_floor_dof": float(report.noise_floor_dof),
        "rms_before_um": report.rms_before_um,
    }


def candidate_metrics(candidate: Candidate) -> dict[str, float]:
    """Return what is logged of a candidate, by the names that the gates read."""
    metrics = {"train_rms_um": candidate.train_rms_um, "complexity": float(candidate.complexity)}
    for group, scores in candidate.scores.items():
        for name in ("r2", "rms_um", "mae_um", "worst_slice_ratio"):
            metrics[f"leave_{group}_out.{name}"] = float(getattr(scores, name))
    if candidate.latency is not None:
        metrics["latency_p50_us"] = candidate.latency.p50_us
        metrics["latency_p99_us"] = candidate.latency.p99_us
    return metrics | {k: float(v) for k, v in candidate.numbers.items()}
