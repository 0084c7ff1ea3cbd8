"""The drive lags by what it takes to overcome friction."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_POINTS = 2000


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    rate_rad_s = state.feed_mm_s / state.radius_mm
    turned_rad, lags = _turn(
        state.radius_mm, rate_rad_s, shape["presliding_um"], shape["stribeck_mm_s"], shape["response_ms"]
    )
    # What turned longer ago than a circle takes is long past: friction slides at full speed.
    since_rad = rate_rad_s * state.since_reversal_s[axis]
    since_rad = np.where(since_rad > 2.0 * np.pi, 0.5 * np.pi, since_rad)
    at_rad = since_rad + np.where(state.last_end[axis] > 0, 0.0, np.pi)
    return stacked(*(0.5 * np.interp(at_rad, turned_rad, lag) * state.sensitivity[axis] for lag in lags))


# Both directions, and both axes, turn alike.
@lru_cache(maxsize=64)
def _turn(
    radius_mm: float, rate_rad_s: float, presliding_um: float, stribeck_mm_s: float, response_ms: float
) -> tuple[Floats, Floats]:
    """Return angles from the reversal at the positive end, (n,), and the drive's answer to friction and to its slow part, (2, n)."""
    half_rad = 2.0 * np.pi * (np.arange(_POINTS // 2) + 0.5) / _POINTS
    # Before it slides, friction builds up over some micrometres of travel since the last reversal.
    travelled_um = UM_PER_MM * radius_mm * (1.0 - np.cos(half_rad))
    force = 1.0 - 2.0 * np.exp(-travelled_um / presliding_um)
    slow = np.exp(-((rate_rad_s * radius_mm * np.sin(half_rad) / stribeck_mm_s) ** 2))
    half = np.stack([force, force * slow])
    # The position loop answers with its time constant, harmonic by harmonic.
    late = 1.0 + 1j * np.arange(_POINTS // 2 + 1) * rate_rad_s * response_ms / 1e3
    answer = np.fft.irfft(np.fft.rfft(np.concatenate([half, -half], axis=1)) / late, _POINTS)
    return np.concatenate([half_rad, half_rad + np.pi]), answer


EFFECT = Effect(
    name="friction",
    title="Friction",
    group="drive",
    parameters=(Parameter("lag", "um", 3.0), Parameter("extra_lag_when_slow", "um", 3.0)),
    regressors=_columns,
    law=Law(None, None, "odd"),
    meaning=(
        "The drive lags by what it takes to overcome friction: like backlash once it slides, but "
        "built up over some travel, larger at low speed (Stribeck), and followed with the time constant of the position loop."
    ),
    formula="-(sgn(v) / 2) (1 - 2 exp(-s / sp)) (L + H exp(-(v / vs)^2)) for the X axis, through a first-order lag of time constant T, times cos(t)",
    looks_like="Rounded steps at the reversals, with humps at low feed.",
    separate_by=(
        "Lower the feed and measure with more samples: a step that is rounded over tens of "
        "micrometres of travel is friction, one within the play is backlash."
    ),
    remedy="Lubrication, loop gain, friction compensation.",
    reference="Canudas de Wit et al. 1995 (LuGre); JSME quadrant glitch measurements",
    shapes=(
        ShapeParameter("presliding_um", "um", 30.0, (15.0, 60.0, 300.0)),
        ShapeParameter("stribeck_mm_s", "mm/s", 5.0, (2.0, 8.0)),
        ShapeParameter("response_ms", "ms", 0.1, (3.0, 30.0), (0.0, 200.0), by_speed=True),
    ),
    confusables=("backlash", "reversal_spike"),
    correctable="Friction compensation of the control.",
)
