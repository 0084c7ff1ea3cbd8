"""What is unknown along an axis, as laws without a name: a step, late on the way back, a bump, or growth towards an end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.physics._learned_places import BUMP, END, LATE, PLACE, REACH, STEP
from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Instance
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Problem, Term
from dtwin.units import shown_number

# Reaches of a bump as shares of the travel; it falls to nothing there.
_REACHES = (0.04, 0.08, 0.15, 0.3)
# What grows towards an end, as shares in which it falls to a third; beyond them it would be a bow.
_TO_AN_END = (0.04, 0.07, 0.12)
# A step is late on the way back by so much of the travel at most.
_LATEST = 0.25
# Of more targets not every one is tried on the way back.
_EVERY = 60
# Waves and half waves say enough of more.
MOST_TARGETS = 150


def local_laws(obs: Observations) -> list[Instance]:
    """Return the laws that an axis may follow, those of a place at every one among its targets."""
    at_mm = np.unique(obs.grid.points)
    shares = (at_mm - at_mm[0]) / float(np.ptp(at_mm))
    between = (0.5 * (shares[1:] + shares[:-1])).tolist()
    gap = float(np.diff(shares).mean())
    stride = 1 + len(between) // _EVERY
    pairs = [(one, other) for n, one in enumerate(between) for other in between[n::-stride]]
    latest = _LATEST if len({c.sense for c in obs.conditions}) > 1 else 0.0
    steps = tuple({PLACE: a, LATE: a - b} for a, b in pairs if a - b <= latest)
    place, late = STEP.shapes
    step = replace(STEP, shapes=(replace(place, grid=(between[0],)), late), also_tried=steps)
    middle, reach = BUMP.shapes
    reaches = tuple(max(r, 1.5 * gap) for r in _REACHES)
    everywhere = replace(middle, grid=tuple(shares.tolist()))
    bump = replace(BUMP, shapes=(everywhere, replace(reach, grid=reaches, limits=(gap, 1.0))))
    at, within = END.shapes
    end = replace(END, shapes=(replace(at, grid=(0.0, 1.0)), replace(within, grid=_TO_AN_END, limits=(gap / 2.0, 1.0))))
    return [Instance(law, obs.axes[0]) for law in (step, bump, end)]


def material_laws(
    laws: Sequence[Term], bare: Problem, believed: Sequence[Term], candidates: Candidates, least_um: float
) -> list[Term]:
    """Return the laws that do at least so much beside all others; the effects that were searched beside them may leave less.

    ``bare``: the campaign without weights, with what the twin knows.
    """
    besides = [candidates.given(bare, [*believed, *(o for o in laws if o is not law)]) for law in laws]
    sizes_um = [candidates.size_um(beside, law) for beside, law in zip(besides, laws, strict=True)]
    return [law for law, size_um in zip(laws, sizes_um, strict=True) if size_um >= least_um]


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
    return float(np.sqrt(does @ does / bare.obs.mask.sum())), "; ".join(said)


def _said(law: Term, size_um: float, start_mm: float, travel_mm: float) -> str:
    place, late = law.shape[PLACE], law.shape.get(LATE, 0.0)
    at = f"{shown_number(size_um, 2)} µm at {start_mm + place * travel_mm:z.0f} mm"
    if law.instance.effect.name == END.name:
        return f"a growth towards an end of {at}, which falls to a third within {law.shape[REACH] * travel_mm:z.0f} mm"
    if wide := law.shape.get(REACH):
        return f"a bump of {at}, {wide * travel_mm:z.0f} mm wide at half its height"
    back = f", on the way back at {start_mm + (place - late) * travel_mm:z.0f} mm"
    return f"a step of {at}" + back * (late > 0.0)
