"""A wave of one axis that is longer than a circle is to it a smooth shape of the guideway of the other: both are told."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from dtwin.physics._rivals import Found, adds_nothing
from dtwin.physics.candidates import Candidate
from dtwin.physics.effect import Instance
from dtwin.physics.problem import Term

_SHAPE, _WAVE, _PITCH = "guideway_shape", "cyclic_error", "pitch_mm"
# In radii. A shorter wave turns back often enough to be seen; a longer one is a bow.
_SHORTEST, _LONGEST, _STEPS = 1.0, 4.0, 12


def with_long_waves(found: Found, labels: Collection[str]) -> Found:
    """Return what was found, in its group the waves of the other axis that leave it nothing to explain.

    ``labels``: of all effects that were found; an axis has one wave.
    """
    if found.top.term.instance.effect.name != _SHAPE:
        return found
    waves = [
        wave
        for instance in found.candidates.instances
        if instance.effect.name == _WAVE
        and instance.axis != found.top.term.instance.axis
        and instance.label not in labels
        and (wave := _best_wave(found, instance)) is not None
        and adds_nothing(found.problem, found.top, wave, found.candidates, found.level)
    ]
    return replace(found, group=(*found.group, *waves))


def _best_wave(found: Found, instance: Instance) -> Candidate | None:
    """Return the long wave that explains most in the place of what was found; None where an axis does not move."""
    radius_mm = max(condition.radius_mm for condition in found.problem.obs.conditions)

    def at(log_pitch: float) -> Candidate | None:
        term = Term(instance, instance.effect.start_shape | {_PITCH: float(np.exp(log_pitch))})
        return found.candidates.tested_term(found.problem, term, found.level)

    grid = np.log(radius_mm * np.geomspace(_SHORTEST, _LONGEST, _STEPS))
    gains = [-np.inf if (tried := at(pitch)) is None else tried.score.gain for pitch in grid]
    best = int(np.argmax(gains))
    if not np.isfinite(gains[best]):
        return None
    around = grid[max(best - 1, 0)], grid[min(best + 1, _STEPS - 1)]

    def misses(log_pitch: float) -> float:
        tried = at(log_pitch)
        return 0.0 if tried is None else -tried.score.gain

    return at(float(minimize_scalar(misses, bounds=around, method="bounded", options={"xatol": 1e-3}).x))
