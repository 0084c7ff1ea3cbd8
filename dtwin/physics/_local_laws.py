"""What is unknown along an axis, as laws without a name: a step, late on the way back, or a bump, at one place."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Effect, Instance, Law, Parameter, Shape, ShapeParameter, moves
from dtwin.physics.learned import LEARNED
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.units import shown_number

# Reaches of a bump as shares of the travel; it falls to nothing there.
_REACHES = (0.04, 0.08, 0.15, 0.3)
# A step is late on the way back by so much of the travel at most.
_LATEST = 0.25
# Of more targets not every one is tried on the way back.
_EVERY = 60
# Waves and half waves say enough of more.
MOST_TARGETS = 150


def local_laws(obs: Observations) -> list[Instance]:
    """Return the laws that an axis may follow, each at every place among its targets."""
    at_mm = np.unique(obs.grid.points)
    shares = (at_mm - at_mm[0]) / float(np.ptp(at_mm))
    between = (0.5 * (shares[1:] + shares[:-1])).tolist()
    gap = float(np.diff(shares).mean())
    stride = 1 + len(between) // _EVERY
    pairs = [(one, other) for n, one in enumerate(between) for other in between[n::-stride]]
    steps = [{"place_of_travel": a, "late_of_travel": a - b} for a, b in pairs if a - b <= _LATEST]
    place = ShapeParameter("place_of_travel", "1", 0.5, (between[0],), refined=False)
    late = ShapeParameter("late_of_travel", "1", 0.0, (0.0,), refined=False)
    middle = ShapeParameter("place_of_travel", "1", 0.5, tuple(shares.tolist()), (0.01, 1.0))
    reach = ShapeParameter("reach_of_travel", "1", 0.1, tuple(max(r, 1.5 * gap) for r in _REACHES), (gap, 1.0))
    laws = _law("step", (place, late), _step, steps), _law("bump", (middle, reach), _bump)
    return [Instance(law, obs.axes[0]) for law in laws]


def laws_in_words(
    laws: Sequence[Term], bare: Problem, believed: Sequence[Term], candidates: Candidates
) -> tuple[float, str]:
    """Return what laws do to an axis, as RMS in um, and what of it is where.

    ``bare``: the campaign without weights, with what the twin knows.
    """
    beside = candidates.given(bare, believed)
    columns = np.concatenate([candidates.whitened(bare, law) for law in laws], axis=1)
    alone = columns - beside.basis @ (beside.basis.T @ columns)
    sizes_um = np.linalg.lstsq(alone, beside.residual.ravel(), rcond=None)[0]
    does = columns @ sizes_um
    does -= bare.basis @ (bare.basis.T @ does)
    at_mm = bare.obs.grid.points
    ends = float(at_mm.min()), float(np.ptp(at_mm))
    said = [_said(law, size_um, *ends) for law, size_um in zip(laws, sizes_um.tolist(), strict=True)]
    return float(np.sqrt(does @ does / bare.obs.mask.sum())), " and ".join(said)


def _said(law: Term, size_um: float, start_mm: float, travel_mm: float) -> str:
    place, late = law.shape["place_of_travel"], law.shape.get("late_of_travel", 0.0)
    at = f"of {shown_number(size_um, 2)} µm at {start_mm + place * travel_mm:z.0f} mm"
    if wide := law.shape.get("reach_of_travel"):
        return f"a bump {at}, {wide * travel_mm:.0f} mm wide at half its height"
    back = f", on the way back at {start_mm + (place - late) * travel_mm:z.0f} mm"
    return f"a step {at}" + back * (late > 0.0)


def _step(share: Floats, sense: Floats, shape: Shape) -> Floats:
    return (share > shape["place_of_travel"] - shape["late_of_travel"] * (sense < 0.0)).astype(float)


def _bump(share: Floats, sense: Floats, shape: Shape) -> Floats:
    off = np.abs(share - shape["place_of_travel"]) / shape["reach_of_travel"]
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.minimum(off, 1.0))))


def _law(
    what: str,
    shapes: tuple[ShapeParameter, ...],
    form: Callable[[Floats, Floats, Shape], Floats],
    tried: Sequence[Shape] = (),
) -> Effect:
    def columns(state: State, axis: str, shape: Shape) -> Floats:
        if not moves(state, axis):
            return np.zeros((state.n, 1))
        position_mm = state.position_mm[axis]
        share = (position_mm - position_mm.min()) / max(float(np.ptp(position_mm)), 1e-9)
        return np.asarray((form(share, state.velocity_mm_s[axis], shape) * state.sensitivity[axis])[:, None])

    return Effect(
        name=f"learned_{what}",
        title=f"A {what} at one place",
        parameters=(Parameter("size", "um", 5.0),),
        regressors=columns,
        law=Law(0.0, None, "mixed" if what == "step" else "even"),
        meaning="Found in the residual, not understood: a description, no cause.",
        formula="",
        looks_like="",
        separate_by="",
        remedy="",
        reference="",
        kinds=("linear",),
        shapes=shapes,
        also_tried=tuple(tried),
        source=LEARNED,
    )
