"""What a positioning bundle says along its axis, for the tables of controls."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dtwin.kinds.linear._bundle import MEMORY, POSITION, ROOM_MM, axis_number, told
from dtwin.kinds.linear._models import MM_PER_IN
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.train.twin_axes import AXES, AxisErrors

# Beyond every axis: the slide rests on the flank of its direction.
_FAR_MM = 1e6


def axis_errors(bundle: Bundle) -> AxisErrors:
    """Return the errors that a positioning bundle takes away, by direction; beyond the map its ends are held."""
    remembers = MEMORY in bundle.initial_state
    (position,) = (i for i in bundle.inputs if i.name.startswith("position_"))
    unit_mm = 1.0 if position.name == POSITION else MM_PER_IN
    room_mm = ROOM_MM if remembers else 0.0
    low, high = position.low * unit_mm + room_mm, position.high * unit_mm - room_mm

    def um(position_mm: Floats) -> tuple[Floats, Floats]:
        places = np.clip(position_mm, low, high)
        forward, reverse = (
            np.array([_told_um(bundle, row, state) for row in _rows(told(places, np.full(places.shape, flag)))])
            for flag, state in ((0.0, {MEMORY: -_FAR_MM}), (1.0, {MEMORY: _FAR_MM}))
        )
        return forward, reverse

    return AxisErrors(AXES[axis_number(bundle)], (low, high), um)


def _rows(columns: Mapping[str, Floats]) -> list[dict[str, float]]:
    return [dict(zip(columns, row, strict=True)) for row in np.column_stack(list(columns.values())).tolist()]


def _told_um(bundle: Bundle, inputs: Mapping[str, float], state: Mapping[str, float]) -> float:
    (output,) = bundle.outputs
    return bundle.tick_graph.evaluate(inputs, state)[0][output.name]
