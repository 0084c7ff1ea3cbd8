"""Directions of positioning runs, and which figures of ISO 230-2 a test tells that has less than both, or than two runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dtwin.errors import InputError
from dtwin.positioning.way_words import way_of
from dtwin.schema import Run

Ways = tuple[str, str]
BOTH: Ways = ("forward", "reverse")
_NO_SCATTER = "EBM"


def ways_of(run: Run) -> Ways:
    """Return the directions of a run; twice the same of one that has one only."""
    there = sorted(set(map(str, run.samples["direction"])))
    return (there[0], there[-1])


def can_be_told(symbol: str, ways: Ways, runs: int) -> bool:
    """Tell whether runs in these directions have a figure: one run has no repeatability, one direction no reversal."""
    if ways != BOTH and not symbol.endswith("↑" if ways[0] == "forward" else "↓"):
        return False
    return runs > 1 or symbol[0] in _NO_SCATTER


def with_ways(run: Run) -> Run:
    """Return a run whose directions are called ``forward`` and ``reverse``; refuse others."""
    ways = {d: way_of(str(d), ones=True) for d in set(run.samples["direction"])}
    unknown = sorted(str(d) for d, way in ways.items() if way is None)
    if unknown:
        raise InputError(
            "a reading does not say from which side its target was approached",
            code=f"{run.meta.kind}.direction",
            where=f"{run.source} direction",
            got=", ".join(unknown)[:80],
            allowed=", ".join(BOTH),
        )
    if any(d != way for d, way in ways.items()):
        told = np.array([ways[d] for d in run.samples["direction"]], dtype=object)
        run = replace(run, samples={**run.samples, "direction": told})
    return run
