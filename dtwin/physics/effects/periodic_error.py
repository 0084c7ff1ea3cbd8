"""A wave along an axis whose length nobody stated."""

from __future__ import annotations

from dtwin.physics.effect import Effect, Law, Parameter, ShapeParameter
from dtwin.physics.effects.cyclic_error import columns

EFFECT = Effect(
    name="periodic_error",
    title="Periodic error of a length that is not stated",
    group="drive",
    parameters=(Parameter("cosine", "um", 2.0), Parameter("sine", "um", 2.0)),
    regressors=columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "Screw or bearing run out, or the graduation of the scale is read unevenly: a short wave along the axis. Its "
        "length is found by what targets that stand at uneven distances read."
    ),
    formula="C cos(2 pi x / p) + S sin(2 pi x / p)",
    looks_like="Targets scatter about the mean curve, the same in every run and in both directions.",
    separate_by="State the pitch of the screw, or measure ten targets within some millimetres.",
    remedy="Align bearing and screw, clean and adjust the reading head; a compensation with ten or more values in a wave.",
    reference="ISO 230-2; ISO 230-1:2012, periodic errors of linear axes",
    kinds=("linear",),
    shapes=(ShapeParameter("pitch_mm", "mm", 10.0, (), (0.5, 300.0)),),
    confusables=("screw_error", "pitch_error"),
    correctable="A table or function of the position with steps well below the wave.",
)
