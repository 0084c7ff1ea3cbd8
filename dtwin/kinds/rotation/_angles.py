"""The angle of a turning axis at each reading of a probe: from its encoder, from pulses, or from a speed alone."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import LSQUnivariateSpline
from scipy.optimize import minimize_scalar

from dtwin.errors import InputError
from dtwin.kinds.rotation._files import Channel
from dtwin.schema import Finding, Floats
from dtwin.statistics import rms, usual_size
from dtwin.units import shown_number

_TURN = 360.0
_FEWEST_PULSES = 2
_KNOTS_PER_TURN = 2
_TUKEY = 4.685
_SEARCHED = 0.02
_ORDERS = 6
_LARGE_DEG = 1.0
_WRAP = 0.7
"""Part of the whole range that every wrap of an angle takes at least."""
_NOT_A_TURN = 0.05


def unwrapped(t_s: Floats, angle_deg: Floats, where: str) -> Floats:
    """Return an angle that goes on over its zero, and over gaps of whole turns at the usual speed.

    Raises ``InputError`` when it wraps elsewhere than at a turn: it is in another unit than its head says.
    """
    steps = np.abs(np.diff(angle_deg))
    whole = float(np.ptp(angle_deg))
    wraps = steps[steps > 0.5 * steps.max()] if steps.size else steps
    # Of few readings a turn none may be near its ends.
    most = whole + 2.0 * float(np.max(steps, where=steps < _WRAP * whole, initial=0.0))
    turn = most > (1.0 - _NOT_A_TURN) * _TURN and whole < (1.0 + _NOT_A_TURN) * _TURN
    if wraps.size > 1 and np.all(wraps > _WRAP * whole) and not turn:
        raise InputError(
            "the angle wraps, and not at a turn: it is in another unit than its head says",
            code="rotation.unit",
            where=where,
            got=f"{shown_number(angle_deg.min(), 4)}° to {shown_number(angle_deg.max(), 4)}°",
            allowed='a head that says its unit: "angle [deg]", "[rad]", "[rev]", "[gon]"; counts of an encoder are turned into one of these before',
        )
    turned = np.unwrap(angle_deg, period=_TURN)
    step, gap_s = np.diff(turned), np.diff(t_s)
    usual = float(np.median(step / np.maximum(gap_s, 1e-12)))
    # Less than half a turn needs no help; a stop does not get it.
    lost = np.where(np.abs(usual * gap_s) > 0.5 * _TURN, np.round((usual * gap_s - step) / _TURN), 0.0)
    return turned + _TURN * np.concatenate([[0.0], np.cumsum(lost)])


def smooth_angle(angle: Channel, where: str) -> tuple[Channel, list[Finding]]:
    """Return a logged angle without the scatter of its stamps, and how large that is.

    A turning mass cannot follow it: the angle is a cubic spline with two knots a turn, stamps far off it count less.
    """
    turned = unwrapped(angle.t_s, angle.value, where)
    turns = abs(turned[-1] - turned[0]) / _TURN
    t = angle.t_s
    knots = np.linspace(t[0], t[-1], max(2, int(_KNOTS_PER_TURN * turns)) + 1)[1:-1]
    held = np.searchsorted(t, knots)
    # A spline needs readings between its knots.
    knots = knots[np.diff(np.concatenate([[0], held])) > 4]
    weight = np.ones(len(t))
    try:
        for _ in range(6):
            spline = LSQUnivariateSpline(t, turned, knots, w=weight)
            left = turned - spline(t)
            scale = usual_size(left - np.median(left)) or 1e-9
            weight = np.clip(1.0 - (left / (_TUKEY * scale)) ** 2, 1e-3, 1.0)
    except ValueError:
        return Channel(t, turned), []
    left = turned - spline(t)
    scatter = rms(left)
    if scatter < _LARGE_DEG:
        return Channel(t, spline(t)), []
    said = (
        f"the stamps of the angle are late by turns: it scatters by {scatter:z.1f}° RMS about a smooth rotation, by {np.abs(left).max():z.0f}° "
        "at most; the smooth one is taken, whose zero is as late as stamps are on average"
    )
    numbers = {"scatter_deg": scatter, "largest_deg": float(np.abs(left).max())}
    return Channel(t, spline(t)), [Finding("rotation.stamps", "warning", said, numbers)]


def angle_of_pulses(pulse: Channel, where: str) -> Channel:
    """Return the angle by a pulse a turn, 0 at the first, at the readings between the first and the last.

    Raises ``InputError`` when fewer than two pulses begin.
    """
    low, high = float(pulse.value.min()), float(pulse.value.max())
    # Twice over the middle: noise on an edge is no second pulse.
    above, state, edges = pulse.value > 0.4 * low + 0.6 * high, bool(pulse.value[0] > 0.5 * (low + high)), []
    below = pulse.value < 0.6 * low + 0.4 * high
    if low < high:
        for n in np.flatnonzero(above | below):
            if above[n] and not state:
                edges.append(int(n))
            state = bool(above[n])
    if len(edges) <= _FEWEST_PULSES:
        raise InputError(
            "too few pulses: a turn is from one pulse to the next",
            code="rotation.pulses",
            where=where,
            got=f"{len(edges)} pulses",
            allowed=f"more than {_FEWEST_PULSES}; a column that is low, and high once a turn",
        )
    within = slice(edges[0], edges[-1] + 1)
    t = pulse.t_s[within]
    return Channel(t, np.interp(t, pulse.t_s[edges], _TURN * np.arange(len(edges))))


def nominal_angle(t_s: Floats, speed_rpm: float, probe: Floats) -> tuple[Floats, float]:
    """Return the angle that a speed alone gives, and the speed that fits what repeats in the readings best.

    It is searched within 2 % of the stated one: the first six orders take the most of the readings there.
    """
    span_s = float(t_s[-1] - t_s[0])
    turns = max(1.0, span_s * speed_rpm / 60.0)
    thin = slice(None, None, max(1, len(t_s) // 4000))
    t, x = t_s[thin] - t_s[0], probe[thin] - np.mean(probe[thin])
    if turns < 2.0:
        return 6.0 * speed_rpm * (t_s - t_s[0]), speed_rpm
    # A tenth of a turn more or less over the whole is a step; then the best of its neighbourhood.
    count = int(min(2001, 2 * np.ceil(10.0 * _SEARCHED * turns) + 1))
    tried = speed_rpm * (1.0 + _SEARCHED * np.linspace(-1.0, 1.0, count))
    coarse = max(tried, key=lambda rpm: _taken(t, x, rpm))
    step = tried[1] - tried[0]
    fine = minimize_scalar(lambda rpm: _left(t, x, rpm), bounds=(coarse - step, coarse + step), method="bounded")
    return 6.0 * float(fine.x) * (t_s - t_s[0]), float(fine.x)


def _taken(t_s: Floats, x: Floats, rpm: float) -> float:
    waves = np.exp(-2j * np.pi * np.outer(np.arange(1, _ORDERS + 1) * rpm / 60.0, t_s))
    return float(np.sum(np.abs(waves @ x) ** 2))


def _left(t_s: Floats, x: Floats, rpm: float) -> float:
    """Return the squares that the orders leave, fitted: part of a turn at an end does not matter."""
    phase = np.outer(t_s, np.arange(1, _ORDERS + 1) * rpm * 2.0 * np.pi / 60.0)
    design = np.hstack([np.ones((len(t_s), 1)), np.cos(phase), np.sin(phase)])
    return float(np.sum((x - design @ np.linalg.lstsq(design, x, rcond=None)[0]) ** 2))
