"""Versions of twins in MLflow: a child run and a registered version for every rung."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import Any

from mlflow.exceptions import MlflowException

from dtwin.train.registry import NOTE, Registry
from dtwin.train.results import environment

_DOCUMENT, _OPENED_FOR = "dtwin.document", "dtwin.opened_for"


def log_twin(
    registry: Registry, document: Mapping[str, Any], digest: str, *, description: str, parent: str | None
) -> dict[str, str]:
    """Log a version of a twin as a child run and register it; what a kill left of that is finished.

    ``digest``: tells the version from every other; a tag of its run.
    ``description``: what a reviewer reads first, in Markdown.
    ``parent``: run of the twin; a new one is opened without.
    Returns ``parent_run_id``, ``run_id``, ``model``, ``model_version``.
    """
    client = registry.client
    name = f"twin-{document['twin']}"
    if parent is None:
        parent = _finished(registry, _OPENED_FOR, digest)
    if parent is None:
        with registry.open_run(name, {"dtwin.twin": name, _OPENED_FOR: digest}) as parent:
            pass
    run_id = _finished(registry, _DOCUMENT, digest)
    if run_id is None:
        tags = {"mlflow.parentRunId": parent, NOTE: description, _DOCUMENT: digest}
        with registry.open_run(f"{name} v{document['version']}: {document['action']}", tags) as run_id:
            registry.log(run_id, _params(document), _figures(document), {})
            registry.log_files(run_id, {"twin.json": json.dumps(document, indent=1)})
            # The twin's own run shows them over its versions, unless somebody deleted it.
            with contextlib.suppress(MlflowException):
                registry.log(parent, {}, _figures(document), {}, document["version"])
                about = f"The twin {document['twin']} of {document['machine']}. Each version is a step of the metrics, and a run below."
                registry.note(parent, f"{about}\n\nThe newest, version {document['version']}: {description}")
    about = f"Versions of the twin {document['twin']}, one for each rung."
    registry.ensure_model(name, about, machine=document["machine"], holds="twin")
    versions = client.search_model_versions(f"run_id='{run_id}'")
    created = next(iter(versions), None) or client.create_model_version(
        name,
        source=f"runs:/{run_id}/twin.json",
        run_id=run_id,
        description=description,
        tags={"twin_version": str(document["version"]), "action": str(document["action"])},
    )
    return {"parent_run_id": parent, "run_id": run_id, "model": name, "model_version": str(created.version)}


def _finished(registry: Registry, tag: str, digest: str) -> str | None:
    """Return the finished run with a digest as tag, None without; unfinished ones are deleted."""
    runs = registry.client.search_runs([registry.experiment()], f"tags.`{tag}` = '{digest}'")
    for run in runs:
        if run.info.status == "FINISHED":
            return str(run.info.run_id)
        registry.client.delete_run(run.info.run_id)
    return None


def _figures(document: Mapping[str, Any]) -> dict[str, float]:
    return {k: v for k, v in document["figures"].items() if isinstance(v, int | float)}


def _params(document: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "effects": ", ".join(map(_label, document["effects"])),
        "machine": document["machine"],
        "campaign": document["campaign"],
        "action": document["action"],
        **{f"data.{k}": v for k, v in document["data"].items() if k != "left_out"},
        "data.n_left_out": len(document["data"].get("left_out", {})),
        **{f"version.{k}": v for k, v in environment().items()},
    }


def note_diagnosis(registry: Registry, model: str, model_version: str, diagnosis: Mapping[str, Any]) -> None:
    """Set the verdict of a diagnosis as tags of a twin's version; nothing happens when somebody deleted it in MLflow.

    ``model``, ``model_version``: as ``log_twin`` returned them.
    ``diagnosis``: as it was stored: what is not a number is None.
    """
    p_value = diagnosis["lack_of_fit_p"]
    group = [_label(c) for c in diagnosis["candidates"] if c["in_group"]]
    tags = {
        "verdict": str(diagnosis["verdict"]),
        "group": ", ".join(group) or "none",
        "lack_of_fit_p": "nan" if p_value is None else f"{p_value:.3g}",
    }
    try:
        for key, value in tags.items():
            registry.client.set_model_version_tag(model, model_version, key, value)
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise


def _label(entry: Mapping[str, Any]) -> str:
    """Return an effect as people write it; that of heat says itself which axis it is of."""
    return str(entry.get("label", f"{entry['effect']} {entry['axis']}".strip()))
