"""The tool swings on its structure, outside of the loop."""

from __future__ import annotations

from dtwin.physics._second_order import mode_columns
from dtwin.physics.effect import Effect, Law, Parameter, ShapeParameter

# From heavy stages to fast tools.
_FREQUENCIES_HZ = (10.0, 15.0, 22.0, 33.0, 50.0, 70.0, 100.0, 140.0, 200.0, 300.0, 450.0, 700.0)

EFFECT = Effect(
    name="structural_mode",
    title="Structural mode",
    group="dynamics",
    parameters=(Parameter("with_acceleration", "1", 0.2), Parameter("with_velocity", "1", 0.05)),
    regressors=mode_columns,
    law=Law(None, None, "even"),
    meaning=(
        "Between slide and tool there is a spring with little damping: the tool moves further than "
        "the encoder says. No gain of the controller takes it away."
    ),
    formula="a s^2 / D + b s w / D, D = s^2 + 2 z w s + w^2, at s = i 2 pi f, lightly damped",
    looks_like="An error in proportion to the amplitude that grows steeply towards the mode.",
    separate_by=(
        "Compare encoder and tool: a mode is seen by the tool only. Tones close to the mode show its damping."
    ),
    remedy="Stiffen or damp the structure; an inverse model of the mode in the command.",
    reference="[D] second-order transfer function at the frequency of the tone",
    kinds=("sinusoidal",),
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 80.0, _FREQUENCIES_HZ),
        ShapeParameter("damping", "1", 0.05, (0.02, 0.05, 0.1)),
    ),
    confusables=("servo_response", "inertial_compliance", "stiffening_joint", "tracking_delay"),
    correctable="Divide the command by the response.",
)
