"""Train on a campaign and register the best equation."""

from __future__ import annotations

from typing import Any

from prefect import flow

from dtwin.lifecycle.train import Registered
from dtwin.report.campaign import comparison_table
from flows import _artifacts, _tasks


@flow(name="train", flow_run_name="train {campaign}")
def train_flow(campaign: str, seed: int = 1) -> dict[str, Any]:
    """Compute features, train every candidate, register the proposed one.

    Args:
        campaign: Campaign in the lake.
        seed: Seed of everything random.
    """
    features = _tasks.compute_features(campaign)
    registered = _tasks.train(campaign, seed)
    publish_training(registered)
    report = registered.training.report
    return {
        "campaign": campaign,
        "machine": report.machine,
        "version": registered.version.version,
        "proposed": report.proposed,
        "held_out_um": report.candidate(report.proposed).held_out.rms_um,
        "rms_before_um": report.rms_before_um,
        "noise_floor_um": report.noise_floor_um,
        "windows": features.windows,
        "table_versions": dict(report.table_versions),
        "gates_passed": all(verdict.passed for verdict in registered.verdicts),
    }


def publish_training(registered: Registered) -> None:
    """Leave comparison, plot and gates of a training.

    Args:
        registered: The training.
    """
    report = registered.training.report
    _artifacts.publish_table(
        f"comparison-{report.campaign}",
        *comparison_table(report.candidates),
        f"{report.rms_before_um:z.1f} µm RMS without a model, noise floor "
        f"{report.noise_floor_text}, {report.n_runs} runs; table versions: "
        + ", ".join(f"{name} {number}" for name, number in report.table_versions.items()),
    )
    _artifacts.publish_held_out_error(report)
    _artifacts.publish_version(report.machine, registered.version.version, registered.verdicts)
