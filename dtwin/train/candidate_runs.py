"""The candidates of a training, read back from the registry."""

from __future__ import annotations

from typing import Any

from dtwin.train.registry import RegisteredVersion, Registry

_PARENT = "mlflow.parentRunId"


def training_metrics(registry: Registry, version: RegisteredVersion) -> dict[str, float]:
    """Return the metrics of the training that a version comes from."""
    client = registry.client
    tags = client.get_run(version.run_id).data.tags
    return dict(client.get_run(tags[_PARENT]).data.metrics) if _PARENT in tags else {}


def training_candidates(registry: Registry, version: RegisteredVersion) -> list[dict[str, Any]]:
    """Return every candidate of the training that a version comes from.

    Returns ``name``, ``params`` and ``metrics`` of each, as they were logged.
    """
    run = registry.client.get_run(version.run_id)
    parent = run.data.tags.get(_PARENT, "")
    siblings = registry.client.search_runs([run.info.experiment_id], f"tags.`{_PARENT}` = '{parent}'")
    return [
        {
            "name": sibling.data.tags.get("dtwin.candidate", sibling.info.run_name),
            "params": dict(sibling.data.params),
            "metrics": dict(sibling.data.metrics),
        }
        for sibling in siblings
    ]
