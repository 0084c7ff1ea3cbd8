"""A wave along an axis whose length nobody stated."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter
from dtwin.physics.effects.cyclic_error import columns
from dtwin.physics.state import State
from dtwin.schema import Floats

# Leads of ball screws, ISO 3408-2; scales are graduated in some of them, too.
_LEADS_MM = (1.0, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0)
# Steps between targets that differ by less, as a share of their mean, are equal: below two steps a wave is another as well.
_EVEN, _RESOLVED = 0.2, 2.0
# Six targets for each of cosine, sine and length: of fewer, one of the leads fits any error.
_FEWEST = 18


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    found = columns(state, axis, shape)
    if not found.any():
        return found
    places_mm = np.unique(state.position_mm[axis])
    steps_mm = np.diff(places_mm)
    told = len(places_mm) >= _FEWEST and np.ptp(steps_mm) >= _EVEN * steps_mm.mean()
    return found if told or shape["pitch_mm"] >= _RESOLVED * steps_mm.mean() else np.zeros_like(found)


EFFECT = Effect(
    name="periodic_error",
    title="Periodic error of a length that is not stated",
    group="drive",
    parameters=(Parameter("cosine", "um", 2.0), Parameter("sine", "um", 2.0)),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "Screw or bearing run out, or the graduation of the scale is read unevenly: a short wave along the axis. Its "
        "length is found by what targets that stand at uneven distances read; usual leads of screws are tried first."
    ),
    formula="C cos(2 pi x / p) + S sin(2 pi x / p)",
    looks_like="Targets scatter about the mean curve, the same in every run and in both directions.",
    separate_by="State the pitch of the screw, or measure ten targets within some millimetres.",
    remedy="Align bearing and screw, clean and adjust the reading head; a compensation with ten or more values in a wave.",
    reference="ISO 230-2; ISO 230-1:2012, periodic errors of linear axes",
    kinds=("linear",),
    shapes=(ShapeParameter("pitch_mm", "mm", 10.0, (), (0.5, 300.0)),),
    also_tried=tuple({"pitch_mm": mm} for mm in _LEADS_MM),
    confusables=("screw_error", "pitch_error"),
    correctable="A table or function of the position with steps well below the wave.",
)
