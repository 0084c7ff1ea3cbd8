"""Provisional effects of what happens at one place of an axis: a step, a bump, and what grows towards an end."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.state import State
from dtwin.schema import Floats

LEARNED = "learned"
PLACE, LATE, REACH = "place_of_travel", "late_of_travel", "reach_of_travel"
_Form = Callable[[Floats, Floats, Shape], Floats]


def _step(share: Floats, velocity_mm_s: Floats, shape: Shape) -> Floats:
    late = 0.5 * shape[LATE] * (1.0 - np.sign(velocity_mm_s))
    return np.asarray(0.5 * (1.0 + np.sign(share - shape[PLACE] + late)))


def _bump(share: Floats, velocity_mm_s: Floats, shape: Shape) -> Floats:
    off = np.abs(share - shape[PLACE]) / shape[REACH]
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.clip(off, 0.0, 1.0))))


def _growth(share: Floats, velocity_mm_s: Floats, shape: Shape) -> Floats:
    return np.asarray(np.exp(-np.abs(share - shape[PLACE]) / shape[REACH]))


def _along_travel(form: _Form) -> Callable[[State, str, Shape], Floats]:
    def columns(state: State, axis: str, shape: Shape) -> Floats:
        if not moves(state, axis):
            return np.zeros((state.n, 1))
        position_mm = state.position_mm[axis]
        share = (position_mm - position_mm.min()) / max(float(np.ptp(position_mm)), 1e-9)
        return np.asarray((form(share, state.velocity_mm_s[axis], shape) * state.sensitivity[axis])[:, None])

    return columns


def _effect(
    name: str, title: str, form: _Form, law: Law, formula: str, looks_like: str, shape: ShapeParameter, *, placed: bool
) -> Effect:
    """Return an effect at a place, which a diagnosis finds among the targets.

    ``shape``: what else it has; ``placed``: its place is refined between them.
    """
    return Effect(
        name=name,
        title=f"Learned: {title}",
        parameters=(Parameter("size", "um", 5.0),),
        regressors=_along_travel(form),
        law=law,
        meaning="Found in the residual, not understood: a description, no cause.",
        formula=formula,
        looks_like=looks_like,
        separate_by="Measure with targets closer together about that place.",
        remedy="Look for what is there: a joint of scale or rack, dirt, a dent, a cover or a door that catches.",
        reference="Learned from the residual of this twin; provisional.",
        kinds=("linear",),
        # What is at an end by its law is not at a limit of a fit.
        shapes=(ShapeParameter(PLACE, "1", 0.5, (0.5,), (0.0, 1.0) if placed else (-1.0, 2.0), refined=placed), shape),
        source=LEARNED,
    )


STEP = _effect(
    "learned_step",
    "step at one place",
    _step,
    Law(0.0, None, "mixed"),
    "A beyond x0, on the way back beyond x0 - l",
    "The error jumps where the axis passes one place, on the way back perhaps at another one.",
    ShapeParameter(LATE, "1", 0.0, (0.0,), (0.0, 1.0), refined=False),
    placed=False,
)
BUMP = _effect(
    "learned_bump",
    "bump at one place",
    _bump,
    Law(0.0, None, "even"),
    "A (1 + cos(pi (x - x0) / w)) / 2 within w of x0",
    "The error is off about one place, the same both ways.",
    ShapeParameter(REACH, "1", 0.1, (0.1,), (0.001, 1.0)),
    placed=True,
)
END = _effect(
    "learned_end",
    "growth towards an end",
    _growth,
    Law(0.0, None, "even"),
    "A exp(-abs(x - x0) / w), x0 one end of the travel",
    "The error grows towards one end of the travel, the same both ways: a hose that tightens, a cover that is pushed together.",
    ShapeParameter(REACH, "1", 0.1, (0.1,), (0.001, 1.0), ends=True),
    placed=False,
)
PLACES: Mapping[str, Effect] = {effect.name: effect for effect in (STEP, BUMP, END)}
