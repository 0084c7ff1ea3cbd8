"""A wave or a smooth curve along an axis, the same both ways."""

from __future__ import annotations

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats

# Waves side by side are half a turn apart at the end of a metre: between them a fit finds its way.
_WAVES_MM = tuple(2000.0 / n for n in range(5, 41))
_START_MM = 200.0
_MOST = 0.75
# The first half wave is a straight line, but for its ends: that is the lead error.
_HALF_WAVES = tuple(range(2, 11))


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    nothing = np.zeros(state.n)
    wave, curve = [nothing] * 2, [nothing] * len(_HALF_WAVES)
    if not moves(state, axis):
        return stacked(*wave, *curve)
    position_mm, along = state.position_mm[axis], state.sensitivity[axis]
    if state.plane:
        # Half waves would follow any error of a circle, which is a small part of the travel.
        phase = 2.0 * np.pi * position_mm / shape["wave_mm"]
        return stacked(along * np.cos(phase), along * np.sin(phase), *curve)
    travel_mm, places = max(float(np.ptp(position_mm)), 1e-9), len(np.unique(position_mm))
    if shape["half_waves"] > 0.0:
        turn = np.pi * (position_mm - position_mm.min()) / travel_mm
        # Half of the targets: more numbers would follow any error.
        most = min(shape["half_waves"], places / 2)
        curve = [along * np.cos(k * turn) if k <= most else nothing for k in _HALF_WAVES]
    else:
        # What does not turn back within the travel is no wave but a bow, and targets show no wave below two steps.
        wave_mm = min(max(shape["wave_mm"], 2.0 * travel_mm / max(places - 1, 1)), _MOST * travel_mm)
        phase = 2.0 * np.pi * position_mm / wave_mm
        wave = [along * np.cos(phase), along * np.sin(phase)]
    return stacked(*wave, *curve)


EFFECT = Effect(
    name="pitch_error",
    title="Pitch error",
    group="geometry",
    parameters=tuple(
        Parameter(name, "um", 5.0) for name in ("cosine", "sine", *(f"half_wave_{k}" for k in _HALF_WAVES))
    ),
    regressors=_columns,
    law=Law(0.0, None, "even"),
    meaning=(
        "The position is off by a wave or a smooth curve along the travel: the lead of the screw wanders, or the slide "
        "tilts on its guideway and is measured at a distance from the scale (Abbe)."
    ),
    formula=(
        "C cos(2 pi x / w + f), on a circle times cos(t) for the X axis; along an axis also the sum over k = 2 to n of "
        "C_k cos(pi k x / L), x from the near end of the travel L"
    ),
    looks_like=(
        "A wave or a smooth curve along the travel, on a circle a few smooth lobes that follow the place on the axis; the "
        "same in both directions and at every feed."
    ),
    separate_by=(
        "On circles: other radii, on which a wave keeps its length, or a laser along the axis. Along an axis, run in both directions: backlash separates the curves, a pitch error does not. Measured at another height or "
        "with an angle optic, a tilt changes and a lead does not."
    ),
    remedy="Pitch error table of the control; where a tilt makes it, the guideway.",
    reference="ISO 230-2",
    kinds=("circular", "linear"),
    shapes=(
        ShapeParameter("wave_mm", "mm", _START_MM, _WAVES_MM, (20.0, 1000.0), step_on_circles=2),
        ShapeParameter("half_waves", "1", 0.0, (0.0,), (0.0, 20.0), refined=False),
    ),
    also_tried_on=("linear",),
    also_tried=tuple({"wave_mm": _START_MM, "half_waves": n} for n in (4.0, 7.0, 10.0)),
    confusables=("lead_error", "cyclic_error", "guideway_shape", "scale_mismatch"),
    special_cases=("lead_error", "scale_mismatch"),
    correctable="Pitch error table of the control.",
)
