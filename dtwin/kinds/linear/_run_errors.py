"""The errors of strokes along an axis, as evidence compares them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.schema import Run
from dtwin.statistics import rms
from dtwin.train.run_errors import Condition, RunError


def stroke_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of strokes along an axis.

    The zero of a laser is arbitrary: the mean over both directions is no error.
    """
    errors = []
    for number, run in enumerate(runs):
        middle = float(np.mean(run.samples["error_um"]))
        axis = str(run.meta.condition.get("axis", ""))
        for way in sorted({str(d) for d in run.samples["direction"]}):
            chosen = run.samples["direction"] == way
            place, error = run.samples["position_mm"][chosen], run.samples["error_um"][chosen]
            rest = error[np.argsort(place)] - middle
            condition: Condition = {
                "axis": axis,
                "approached": way,
                "targets": float(len(place)),
                "from_mm": round(float(place.min()), 2),
                "to_mm": round(float(place.max()), 2),
            }
            errors.append(RunError(number, condition, way, rms(rest), rest))
    return errors
