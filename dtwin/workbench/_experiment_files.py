"""Tests to make as files: plans for ``dtwin plan`` and programs for the machine."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any

import tomli_w

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.plan_file import planned_document

Grid = dict[str, Any]


def grids_of(experiment: Mapping[str, Any] | None) -> list[Grid]:
    """Return the fewest grids that hold exactly the proposed conditions.

    ``experiment``: ``next_experiment`` of a diagnosis.
    """
    if not experiment or not experiment["conditions"]:
        raise InputError(
            "no run is proposed that could be planned",
            code="experiment.none",
            hint="diagnose the twin; a plan is offered when runs would separate candidates",
        )
    directions: dict[tuple[str, float, float], list[str]] = {}
    for c in experiment["conditions"]:
        place = (c["plane"], c["radius_mm"], c["feed_mm_min"])
        directions.setdefault(place, []).append(c["direction"])
    feeds: dict[tuple[str, float, tuple[str, ...]], list[float]] = {}
    for (plane, radius, feed), ways in directions.items():
        feeds.setdefault((plane, radius, tuple(sorted(ways))), []).append(feed)
    places: dict[tuple[tuple[float, ...], tuple[str, ...]], list[tuple[str, float]]] = {}
    for (plane, radius, ways_), speeds in feeds.items():
        places.setdefault((tuple(sorted(speeds)), ways_), []).append((plane, radius))
    grids: list[Grid] = []
    for (speeds_, ways_), here in places.items():
        grids += [
            {
                "plane": planes,
                "radius_mm": radii,
                "feed_mm_min": list(speeds_),
                "repeats": int(experiment["repeats"]),
                "directions": list(ways_),
            }
            for planes, radii in _products(here)
        ]
    return grids


def experiment_documents(name: str, machine: str, experiment: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return the content of the plan files of an experiment.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``experiment``: ``next_experiment`` of a diagnosis.
    """
    grids = grids_of(experiment)
    stems = [name] if len(grids) == 1 else [f"{name}-{number}" for number in range(1, len(grids) + 1)]
    return [
        {"plan": {"name": stem, "machine": machine, "seed": 1}, "grid": grid}
        for stem, grid in zip(stems, grids, strict=True)
    ]


def plans_zip(documents: Iterable[Mapping[str, Any]]) -> bytes:
    """Return plan files and the motion programs of each as one archive; ``documents``: what they hold."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for document in documents:
            stem = str(document["plan"]["name"])
            planned = planned_document(document, stem)
            kind = kind_named(planned.kind)
            archive.writestr(f"{stem}.toml", tomli_w.dumps(document))
            control = kind.controls[0] if kind.controls else ""
            for file, text in kind.programs(planned, control).items():
                archive.writestr(f"{stem}/{file}", text)
    return out.getvalue()


def _products(here: list[tuple[str, float]]) -> list[tuple[list[str], list[float]]]:
    planes = sorted({plane for plane, _ in here})
    radii = sorted({radius for _, radius in here})
    if set(here) == set(product(planes, radii)):
        return [(planes, radii)]
    return [([plane], sorted(r for p, r in here if p == plane)) for plane in planes]
