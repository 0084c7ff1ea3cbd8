"""The next experiment as files: plans for ``dtwin plan`` and programs for the machine."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from itertools import product
from typing import Any

from dtwin.acquire.programs import gcode, urscript
from dtwin.errors import InputError
from dtwin.plan import expand

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


def plan_toml(name: str, machine: str, grid: Grid) -> str:
    """Return a plan file.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``grid``: one of ``grids_of``.
    """
    head = f"[plan]\nname = {json.dumps(name)}\nmachine = {json.dumps(machine)}\nseed = 1\n"
    body = "\n".join(f"{key} = {json.dumps(value)}" for key, value in grid.items())
    return f"{head}\n[grid]\n{body}\n"


def experiment_zip(name: str, machine: str, experiment: Mapping[str, Any] | None) -> bytes:
    """Return plans and programs of an experiment as one archive.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``experiment``: ``next_experiment`` of a diagnosis.
    """
    out = io.BytesIO()
    grids = grids_of(experiment)
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, grid in enumerate(grids, start=1):
            stem = name if len(grids) == 1 else f"{name}-{number}"
            document = {"plan": {"name": stem, "machine": machine, "seed": 1}, "grid": grid}
            plan = expand(document, stem)
            archive.writestr(f"{stem}.toml", plan_toml(stem, machine, grid))
            for test in plan.tests:
                for suffix, program in ((".nc", gcode), (".script", urscript)):
                    text = program(test, plan.directions)
                    archive.writestr(f"{stem}/{test.test_id}{suffix}", text)
    return out.getvalue()


def _products(here: list[tuple[str, float]]) -> list[tuple[list[str], list[float]]]:
    planes = sorted({plane for plane, _ in here})
    radii = sorted({radius for _, radius in here})
    if set(here) == set(product(planes, radii)):
        return [(planes, radii)]
    return [([plane], sorted(r for p, r in here if p == plane)) for plane in planes]
