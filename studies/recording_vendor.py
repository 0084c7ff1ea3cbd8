"""What a ball-bar program's own model leaves on a recording: the same kinds of terms, refitted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dtwin.physics.effect import Effect
from dtwin.physics.library import instances
from dtwin.physics.problem import Term
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.statistics import rms
from studies import recording_models as models
from studies.recording_passes import Aligned

_KINDS = (
    "scale_mismatch",
    "squareness",
    "straightness",
    "backlash",
    "backlash_taper",
    "lateral_play",
    "lateral_play_taper",
    "reversal_spike",
    "servo_mismatch",
)
_CYCLIC = "cyclic_error_by_direction"
_PITCH = "AF_CYCLIC_PITCH_"
_RANK = 1e-6


def vendor_figures(
    passes: models.Passes, library: Mapping[str, Effect], diagnostics: Mapping[str, float]
) -> dict[str, Any]:
    """Return what the vendor states, and what its kinds of terms leave when refitted.

    ``passes``: both passes of what repeats.
    """
    state = passes.aligned[0].state
    terms = models.setup_terms(library, state)
    for name in _KINDS:
        places = instances(library[name], [state.plane], state.axes, joints=False)
        terms += [Term(place, library[name].start_shape) for place in places]
    for axis, letter in zip(state.axes, "AB", strict=True):
        if _PITCH + letter in diagnostics:
            (place,) = instances(library[_CYCLIC], [], (axis,), joints=False)
            terms.append(Term(place, place.effect.start_shape | {"pitch_mm": diagnostics[_PITCH + letter]}))
    figures: dict[str, Any] = {"stated_um": diagnostics.get("RMS")}
    for key, by_file in (("file_angles", True), ("aligned_angles", False)):
        whole = [_columns(a.file_state if by_file else a.state, terms) for a in passes.aligned]
        columns = passes.both(whole)
        figures[key] = {
            "parameters": int(np.linalg.matrix_rank(columns[0], _RANK)),
            "marked_window_um": _window_um(passes.aligned, whole),
            "held_out_um": models.judge(passes.y_um, columns)[1],
        }
    return figures


def _columns(state: State, terms: list[Term]) -> Floats:
    """Return the terms, the fourth harmonic, and a centre and radius that turn with direction."""
    theta, sign = state.angle_rad, state.direction
    extra = np.stack(
        [np.sin(4.0 * theta), sign * np.ones_like(theta), sign * np.cos(theta), sign * np.sin(theta)], axis=1
    )
    own = [t.instance.effect.columns(state, t.instance.axis, t.shape) for t in terms]
    return np.hstack([*own, extra])


def _window_um(aligned: tuple[Aligned, ...], whole: list[Floats]) -> float:
    rows, values = [], []
    for one, columns in zip(aligned, whole, strict=True):
        rows.append(columns[one.run.marked])
        values.append(one.run.arc[1])
    x, y = np.concatenate(rows), np.concatenate(values)
    left = y - x @ np.linalg.lstsq(x, y, rcond=_RANK)[0]
    return rms(left)
