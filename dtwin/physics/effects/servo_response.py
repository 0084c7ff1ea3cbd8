"""A position loop answers a tone by its bandwidth."""

from __future__ import annotations

from dtwin.physics._second_order import mode_columns
from dtwin.physics.effect import Effect, Law, Parameter, ShapeParameter

# From heavy stages to fast tools.
_FREQUENCIES_HZ = (10.0, 18.0, 30.0, 50.0, 80.0, 130.0, 210.0, 350.0, 600.0)

EFFECT = Effect(
    name="servo_response",
    title="Response of the servo loop",
    group="dynamics",
    parameters=(Parameter("with_acceleration", "1", 0.2), Parameter("with_velocity", "1", 0.05)),
    regressors=mode_columns,
    law=Law(None, None, "even"),
    meaning=(
        "The closed position loop is a system of second order: towards its bandwidth it overshoots, "
        "then falls behind. Encoders see it."
    ),
    formula="a s^2 / D + b s w / D, D = s^2 + 2 z w s + w^2, at s = i 2 pi f",
    looks_like="An error in proportion to the amplitude that grows steeply with the frequency.",
    separate_by="Compare encoder and command: what the encoder shows is the servo, the rest structure.",
    remedy="Higher bandwidth, feed forward of velocity and acceleration, or an inverse model.",
    reference="[D] second-order transfer function at the frequency of the tone",
    kinds=("sinusoidal",),
    shapes=(
        ShapeParameter("frequency_hz", "Hz", 80.0, _FREQUENCIES_HZ),
        ShapeParameter("damping", "1", 0.3, (0.15, 0.3, 0.6, 1.0)),
    ),
    confusables=("structural_mode", "tracking_delay", "inertial_compliance"),
    correctable="Divide the command by the response.",
)
