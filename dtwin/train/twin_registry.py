"""Versions of twins in MLflow: a child run and a registered version for every rung."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from dtwin.train.registry import Registry, environment


def log_twin(
    registry: Registry, document: Mapping[str, Any], *, description: str, parent: str | None
) -> dict[str, str]:
    """Log a version of a twin as a child run and register it.

    Parameters
    ----------
    registry : Registry
        Where.
    document : dict
        The twin, as ``Twin.as_dict`` returns it.
    description : str
        What a reviewer reads first, in Markdown.
    parent : str, optional
        Run of the twin; a new one is opened without.

    Returns
    -------
    dict of str to str
        ``parent_run_id``, ``run_id``, ``model``, ``model_version``.
    """
    client = registry.client
    name = f"twin-{document['twin']}"
    if parent is None:
        with registry.open_run(name, {"dtwin.twin": name}) as parent:
            pass
    label = f"{name} v{document['version']}: {document['action']}"
    figures = {k: v for k, v in document["figures"].items() if isinstance(v, int | float)}
    params = {
        "effects": ", ".join(map(_label, document["effects"])),
        "machine": document["machine"],
        "campaign": document["campaign"],
        "action": document["action"],
        **{f"data.{k}": v for k, v in document["data"].items() if k != "left_out"},
        "data.n_left_out": len(document["data"].get("left_out", {})),
        **{f"version.{k}": v for k, v in environment().items()},
    }
    tags = {"mlflow.parentRunId": parent, "mlflow.note.content": description}
    with registry.open_run(label, tags) as run_id:
        registry.log(run_id, params, figures, {})
        registry.log_files(run_id, {"twin.json": json.dumps(document, indent=1)})
    registry.ensure_model(name, f"Versions of the twin {document['twin']}, one for each rung.")
    created = client.create_model_version(
        name,
        source=f"runs:/{run_id}/twin.json",
        run_id=run_id,
        description=description,
        tags={"twin_version": str(document["version"]), "action": str(document["action"])},
    )
    return {
        "parent_run_id": parent,
        "run_id": run_id,
        "model": name,
        "model_version": str(created.version),
    }


def note_diagnosis(
    registry: Registry, model: str, model_version: str, diagnosis: Mapping[str, Any]
) -> None:
    """Set the verdict of a diagnosis as tags of a twin's version.

    Parameters
    ----------
    registry : Registry
        Where.
    model, model_version : str
        As ``log_twin`` returned them.
    diagnosis : dict
        As ``Diagnosis.as_dict`` returned it.
    """
    group = [_label(c) for c in diagnosis["candidates"] if c["in_group"]]
    tags = {
        "verdict": str(diagnosis["verdict"]),
        "group": ", ".join(group),
        "lack_of_fit_p": f"{diagnosis['lack_of_fit_p']:.3g}",
    }
    for key, value in tags.items():
        registry.client.set_model_version_tag(model, model_version, key, value)


def _label(entry: Mapping[str, Any]) -> str:
    """Return an effect as people write it; that of heat says itself which axis it is of."""
    return str(entry.get("label", f"{entry['effect']} {entry['axis']}".strip()))
