"""Versions of a twin in MLflow; a twin also works where MLflow is not installed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtwin.config import Home
from dtwin.pipeline.twin_files import finite


def registered(home: Home, document: Mapping[str, Any], parent: str | None) -> dict[str, str]:
    """Log a version and return where it is; empty without MLflow.

    Parameters
    ----------
    home : Home
        Where the registry is.
    document : mapping
        ``Twin.as_dict`` of the version.
    parent : str or None
        Run that holds the earlier versions.
    """
    try:
        from dtwin.train.registry import Registry
        from dtwin.train.twin_registry import log_twin
    except ModuleNotFoundError:
        return {}
    figures = document["figures"]
    description = (
        f"**{document['action']}** on {document['campaign']}: RMS "
        f"{figures['rms_before_um']:z.2f} -> {figures['rms_after_um']:z.2f} um, "
        f"noise floor {figures['noise_floor_um']:z.2f} um (unit of replication: the {document.get('replication', 'run')})."
    )
    return log_twin(Registry(home), finite(document), description=description, parent=parent)


def note(home: Home, stored: Mapping[str, str], diagnosis: Mapping[str, Any]) -> None:
    """Write a diagnosis to the version that it is of, when that was logged.

    Parameters
    ----------
    home : Home
        Where the registry is.
    stored : mapping
        What :func:`registered` returned for the version.
    diagnosis : mapping
        As the command prints it.
    """
    if not stored:
        return
    from dtwin.train.registry import Registry
    from dtwin.train.twin_registry import note_diagnosis

    note_diagnosis(Registry(home), stored["model"], stored["model_version"], diagnosis)
