"""The axis sticks for a moment when it reverses."""

from __future__ import annotations

import numpy as np
from scipy.special import erfcx

from dtwin.physics.effect import Effect, Law, Parameter, Shape, ShapeParameter, moves, stacked
from dtwin.physics.state import State
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_APART = 0.97
_AT_ONCE_S = 1e-5
# Durations are stated at this speed of the path.
_STATED_AT_MM_S = 50.0
# After so many time constants nothing is left to within rounding.
_OVER = 40.0


def _columns(state: State, axis: str, shape: Shape) -> Floats:
    if not moves(state, axis):
        return np.zeros((state.n, 2))
    acceleration = state.feed_mm_s**2 / state.radius_mm
    build_up_s = float(np.sqrt(shape["presliding_um"] / UM_PER_MM / acceleration))
    exponent = shape["speed_exponent"]
    at_once = max(0.0, 1.0 - exponent)
    build_up_s = max(at_once * build_up_s, _AT_ONCE_S)
    duration_s = (_STATED_AT_MM_S / state.feed_mm_s) ** exponent * shape["duration_ms"] / 1e3
    rise_s = min(max(at_once * shape["rise_ms"] / 1e3, _AT_ONCE_S), _APART * duration_s)
    t_s = state.since_reversal_s[axis]
    there = t_s < _OVER * max(build_up_s, duration_s)
    spike = np.zeros(len(t_s))
    spike[there] = _fought(t_s[there], build_up_s, duration_s) - _fought(t_s[there], build_up_s, rise_s)
    end = state.last_end[axis]
    out = spike / _peak(duration_s, rise_s) * end * state.sensitivity[axis]
    return stacked(np.where(end > 0, out, 0.0), np.where(end < 0, out, 0.0))


def _fought(t_s: Floats, build_up_s: float, time_s: float) -> Floats:
    """Return what is left of friction that is fought with a time constant, shape (n,).

    Friction after a reversal is 1 - exp(-t^2 / (2 b^2)): it builds up over a travel that grows
    with the square of time. This is its convolution with the decay, in closed form.
    """
    w = build_up_s / (np.sqrt(2.0) * time_s)
    u = t_s / (np.sqrt(2.0) * build_up_s) - w
    built = np.exp(-0.5 * (t_s / build_up_s) ** 2)
    decay = np.exp(-t_s / time_s)
    early = built * erfcx(np.abs(u))
    late = 2.0 * np.exp(np.minimum(w**2 - t_s / time_s, 0.0)) - early
    area = np.where(u >= 0.0, late, early) - decay * erfcx(w)
    return np.asarray(decay - built + np.sqrt(np.pi) * w * area)


def _peak(slow_s: float, fast_s: float) -> float:
    """Return the largest value of exp(-t / slow) - exp(-t / fast)."""
    ratio = fast_s / slow_s
    return float(ratio ** (ratio / (1.0 - ratio)) - ratio ** (1.0 / (1.0 - ratio)))


EFFECT = Effect(
    name="reversal_spike",
    title="Reversal spike",
    group="drive",
    parameters=(Parameter("height_at_positive_end", "um", 5.0), Parameter("height_at_negative_end", "um", 5.0)),
    regressors=_columns,
    law=Law(None, None, "even"),
    meaning=(
        "Friction changes its sign at reversal and pushes the axis off its path until the drive "
        "has built up the force against it."
    ),
    formula=(
        "A (exp(-t / T) - exp(-t / Tr)) / peak after each reversal, smoothed by the time in which "
        "friction builds up over its travel: sqrt(s / a), a = F^2 / R. T is a time (p = 0), or stated at 50 mm/s for a "
        "spike that begins at once and lasts a travel (p = 1): T (50 mm/s / F)^p"
    ),
    looks_like=(
        "Short spike outwards or inwards just after the reversal, on the other side of the axis "
        "when the direction changes. It grows with F² / R until friction reverses at once."
    ),
    separate_by="Lower the feed: the spike shrinks and a backlash step stays.",
    remedy="Friction compensation of the control, lubrication, loop gain.",
    reference=(
        "JSME quadrant glitch measurements over radii and feeds; ISO 230-4:2022 annex B, "
        "influence of typical machine errors on circular paths"
    ),
    shapes=(
        ShapeParameter("duration_ms", "ms", 60.0, (10.0, 30.0, 80.0, 250.0), ends=True),
        ShapeParameter("rise_ms", "ms", 1.0, (1.0, 20.0), (0.0, 150.0), vanishes=True),
        ShapeParameter("presliding_um", "um", 0.2, (0.2, 4.0, 20.0), (0.0, 60.0), vanishes=True),
        ShapeParameter("speed_exponent", "1", 0.0, (0.0,), (0.0, 1.5), refined=False, by_speed=True),
    ),
    also_tried=tuple(
        {"duration_ms": ms, "rise_ms": 1.0, "presliding_um": 0.2, "speed_exponent": 1.0}
        for ms in (10.0, 30.0, 80.0, 250.0)
    ),
    confusables=("friction", "reversal_ringing", "backlash"),
    correctable="Friction compensation of the control; an offset is usually too slow.",
)
