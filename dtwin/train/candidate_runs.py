"""The candidates of a training, read back from the registry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.train.registry import RegisteredVersion, Registry

_PARENT = "mlflow.parentRunId"


def training_metrics(registry: Registry, version: RegisteredVersion) -> dict[str, float]:
    """Return the metrics of the training that a version comes from."""
    client = registry.client
    parent = _parent_of(client.get_run(version.run_id).data.tags)
    return dict(client.get_run(parent).data.metrics) if parent else {}


def training_candidates(registry: Registry, version: RegisteredVersion) -> list[dict[str, Any]]:
    """Return every candidate of the training that a version comes from.

    Returns ``name``, ``params`` and ``metrics`` of each, as they were logged.
    """
    run = registry.client.get_run(version.run_id)
    parent = _parent_of(run.data.tags)
    if not parent:
        return []
    siblings = registry.client.search_runs([run.info.experiment_id], f"tags.`{_PARENT}` = '{parent}'")
    return [
        {
            "name": sibling.data.tags.get("dtwin.candidate", sibling.info.run_name),
            "params": dict(sibling.data.params),
            "metrics": dict(sibling.data.metrics),
        }
        for sibling in siblings
    ]


def _parent_of(tags: Mapping[str, str]) -> str:
    """Return which run is the training; nothing where the tag is no name of a run: anybody may change it on MLflow's page, and MLflow reads it as a part of a question."""
    told = tags.get(_PARENT, "")
    return told if told.isalnum() else ""
