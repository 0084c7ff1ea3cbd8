"""Columns of effects that depend on nothing but the condition, kept between fits."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

from dtwin.physics.effect import Instance, Shape
from dtwin.physics.state import State
from dtwin.schema import Floats

# Enough for the shapes of a campaign in three planes; with each what is told beside the columns.
_MOST_BYTES, _BESIDE_BYTES = 250_000_000, 1000
_lock = threading.Lock()
_kept: OrderedDict[Hashable, Floats] = OrderedDict()
_held_bytes = 0


def kept_columns(instance: Instance, shape: Shape, condition: Hashable, make: Callable[[], Floats]) -> Floats:
    """Return columns of an effect under a condition, computed when they were not yet.

    A diagnosis asks for the same few hundred shapes of every effect each time; machines are
    measured under the same conditions again and again.

    ``condition``: all that the columns depend on besides; as ``condition_key`` gives it.
    Returns (n, parameters): read-only.
    """
    key = (instance.effect.regressors, instance.label, tuple(sorted(shape.items())), condition)
    with _lock:
        columns = _kept.get(key)
        if columns is not None:
            _kept.move_to_end(key)
            return columns
    made = make()
    made.setflags(write=False)
    global _held_bytes
    with _lock:
        if key not in _kept:
            _held_bytes += made.nbytes + _BESIDE_BYTES
        _kept[key] = made
        while _held_bytes > _MOST_BYTES:
            _held_bytes -= _kept.popitem(last=False)[1].nbytes + _BESIDE_BYTES
    return made


def condition_key(state: State) -> Hashable:
    """Return all that tells a condition from another, as something that can be looked up."""
    geometry = json.dumps(dict(state.geometry), sort_keys=True, default=repr)
    condition = state.plane, state.radius_mm, state.feed_mm_s, state.direction, geometry
    if state.plane:
        return condition
    # On a circle the points are always the same; along an axis every test chooses its own.
    where = tuple((a, state.position_mm[a].tobytes()) for a in state.axes)
    return state.kind, condition, where
