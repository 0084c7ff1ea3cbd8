"""What ISO 230-2 asks of a positioning test, and which of its figures a test tells that is less."""

from __future__ import annotations

import math

import numpy as np

from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Run

Ways = tuple[str, str]
BOTH: Ways = ("forward", "reverse")
_RUNS, _TARGETS, _PER_METRE = 5, 5, 5
_LONG_MM = 2000.0
_LONG_STEP_MM = 250.0
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


def asked(test: LinearTest) -> list[str]:
    """Return what the standard asks for and the test has not."""
    targets, runs = test.forward_um.shape
    travel_mm = float(np.ptp(test.position_mm))
    said = []
    if travel_mm > _LONG_MM:
        if travel_mm / (targets - 1) > 1.001 * _LONG_STEP_MM:
            said.append(f"over 2 m ISO 230-2 asks for a target every 250 mm in the mean, these are {targets}")
        if runs > 1:
            said.append("ISO 230-2 tells R and A of 2 m at most; over it one run tells E, B and M")
    else:
        fewest = max(_TARGETS, math.ceil(_PER_METRE * travel_mm / 1000.0))
        if targets < fewest:
            said.append(f"ISO 230-2 asks for {fewest} targets on this travel, these are {targets}")
        if runs < _RUNS:
            runs_said = "this is one, and tells no repeatability" if runs == 1 else f"these are {runs}"
            said.append(f"ISO 230-2 asks for five runs, {runs_said}")
    return said
