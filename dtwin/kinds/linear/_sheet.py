"""What ISO 230-2 asks of a test along an axis, and what makes its figures uncertain."""

from __future__ import annotations

import math

import numpy as np

from dtwin.positioning.matrix import LinearTest
from dtwin.report.uncertainty import Circumstances, Contribution, off_line_um

_READING_UM = 0.2
_SCALE_UM_PER_M = 0.5
_ASLANT_MM = 1.0
# A beam that leans by more does not come back into the instrument: on a short axis the millimetre is not the limit.
_MOST_ASLANT = 0.004
_RUNS, _TARGETS, _PER_METRE = 5, 5, 5
_LONG_MM = 2000.0
_LONG_STEP_MM = 250.0


def asked(test: LinearTest) -> list[str]:
    """Return what the standard asks for and the test has not."""
    targets, runs = test.forward_um.shape
    travel_mm = float(np.ptp(test.position_mm))
    said = []
    # Targets in inches are rounded.
    if travel_mm > 1.001 * _LONG_MM:
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


def contributions(under: Circumstances, symbol: str, test: LinearTest) -> tuple[Contribution, ...]:
    """Say what makes a figure uncertain: R and B compare readings of one target, the others readings along the axis."""
    found = [under.reading(_READING_UM), *under.environment(test.forward_um.shape[1])]
    if symbol[0] in "AEM":
        travel_mm = float(np.ptp(test.position_mm))
        scale = under.stated("uncertainty_um_per_m", _SCALE_UM_PER_M)
        aslant = under.stated("alignment_mm", min(_ASLANT_MM, _MOST_ASLANT * travel_mm))
        found += [
            Contribution(
                "instrument's scale",
                scale.value / 2 * travel_mm / 1000.0,
                scale.basis("µm/m (k = 2)"),
                assumed=scale.assumed,
            ),
            Contribution(
                "set-up",
                off_line_um(aslant.value, travel_mm),
                f"beam off the axis by {aslant.basis('mm at most')}",
                assumed=aslant.assumed,
            ),
            *under.length(travel_mm / 1000.0),
        ]
    return tuple(found)
