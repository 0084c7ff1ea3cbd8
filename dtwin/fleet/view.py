"""What is kept of a fleet: the newest diagnosis of each campaign, worst first."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, get_args

from dtwin.config import Home
from dtwin.fleet.jobs import DIAGNOSES
from dtwin.physics.diagnosis import Verdict
from dtwin.pipeline.kept import kept_already


def fleet_view(home: Home, machines: Collection[str] = ()) -> list[dict[str, Any]]:
    """Return the newest diagnosis of these machines, or of all, the largest systematic error over its floor first."""
    newest: dict[str, dict[str, Any]] = {}
    folder = home.root / "kept" / DIAGNOSES
    for file in sorted(folder.glob("*.json")):
        diagnosed = kept_already(home, DIAGNOSES, file.stem)
        if diagnosed is None or (machines and diagnosed["machine"] not in machines):
            continue
        before = newest.get(diagnosed["machine"])
        if before is None or str(diagnosed["started"]) >= str(before["started"]):
            newest[diagnosed["machine"]] = diagnosed
    return sorted((line_of(diagnosed) for diagnosed in newest.values()), key=lambda line: -(line["over_floor"] or 0.0))


def line_of(diagnosed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is shown of a diagnosis.

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` for what is none.
    """
    if diagnosed["verdict"] not in get_args(Verdict) or not isinstance(diagnosed["headline"], str):
        raise ValueError(f"a verdict {str(diagnosed['verdict'])[:40]} is not known")
    floor, systematic = diagnosed["noise_floor_um"], diagnosed["systematic_rms_um"]
    names = ("machine", "campaign", "kind", "started", "verdict", "headline", "systematic_rms_um", "noise_floor_um")
    return {name: diagnosed[name] for name in names} | {
        "over_floor": systematic / floor if floor and systematic is not None else None,
        "found": [" or ".join(_label(s) for s in group) for group in diagnosed["found"]],
        "unresolved": diagnosed["unresolved"] is not None,
    }


def _label(suspect: dict[str, Any]) -> str:
    return f"{suspect['effect']} {suspect['axis']}".rstrip()
