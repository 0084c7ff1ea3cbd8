"""The best correction that is found when the truth is known, under a bundle's own limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from dtwin.machines import mechanism as m_
from dtwin.machines.controller import CobotController
from dtwin.machines.parameters import ControllerParameters
from dtwin.schema import Floats
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.safety import Guard
from dtwin.statistics import rms
from dtwin.units import UM_PER_MM

TICK_S = 0.002
Controller = TypeVar("Controller", bound=CobotController)
_ROUNDS = 6
# What is learned from a run is taken below these: higher up the structure answers out of phase.
_LEARNED_HZ = (30.0, 6.0)
# A tick that is this near the commonest distance from the centre is on the circle, not in the in-feed.
_ON_CIRCLE_MM = 0.1


def best_offsets(
    begun: Sequence[Callable[[], CobotController]],
    centre_mm: Floats,
    motion: ControllerParameters,
    safety: SafetyLimits,
) -> list[Floats]:
    """Return the offsets that leave least of the true radial error, found by running again and again.

    Begun with nothing; then what is left of the best runs so far is led ahead by delay and lag and
    taken off, and by less after a round that was worse. The best round is returned, so it is
    never worse than no correction; nobody proves that there is no better one.

    ``begun``: new controllers at the start of their programs, which repeat exactly; what is left is judged about one
    centre and one radius for all of them, as the ball bar is.
    ``centre_mm``, shape (3,): about which they turn.
    ``motion``: for delay and lag.
    ``safety``: limits of the bundle, to which these offsets are subject, too.
    Returns, shape (ticks, 3): um, before the guard.
    """
    from scipy.signal import butter, sosfiltfilt

    ahead = round((motion.actuator_delay_s + motion.actuator_lag_s) / TICK_S)
    still = [np.zeros((1, 3)) for _ in begun]
    best, (left, least) = still, _left_um(begun, still, centre_mm, safety)
    gain, hz = 1.0, iter(_LEARNED_HZ)
    low = butter(2, next(hz), fs=1.0 / TICK_S, output="sos")
    for _ in range(_ROUNDS):
        tried = [
            was[np.minimum(np.arange(len(rest)), len(was) - 1)] - gain * sosfiltfilt(low, _led(rest, ahead), axis=0)
            for was, rest in zip(best, left, strict=True)
        ]
        after, size = _left_um(begun, tried, centre_mm, safety)
        if size < least:
            best, left, least = tried, after, size
        else:
            gain *= 0.5
            low = butter(2, next(hz, _LEARNED_HZ[-1]), fs=1.0 / TICK_S, output="sos")
    return best


def follow(controller: Controller, offsets_um: Floats, safety: SafetyLimits) -> tuple[Controller, dict[str, int]]:
    """Run a program with offsets through the guard; return it and how often each guard acted.

    ``controller``: at the start of the program.
    ``offsets_um``, shape (n, 3): by tick; the last one is held.
    """
    guard, ticks = Guard(safety, np.empty(0), np.empty(0)), controller.ticks_left
    wanted = offsets_um[np.minimum(np.arange(ticks), len(offsets_um) - 1)]
    safe = guard.run(wanted, np.empty((ticks, 0)), elapsed_s=TICK_S)
    controller.run(np.column_stack([np.arange(1.0, ticks + 1.0), safe]))
    return controller, guard.counted()


def _left_um(
    begun: Sequence[Callable[[], CobotController]], offsets: Sequence[Floats], centre_mm: Floats, safety: SafetyLimits
) -> tuple[list[Floats], float]:
    """Return what is left along the radius, each of shape (ticks, 3), and its RMS on the circles."""
    outward, error, counted = [], [], []
    for make, offset in zip(begun, offsets, strict=True):
        truths = follow(make(), offset, safety)[0].ticks().truths
        away = truths[:, :3] - centre_mm
        far = np.linalg.norm(away, axis=1)
        outward.append(away / far[:, None])
        vector_um = UM_PER_MM * (truths[:, m_.TCP : m_.TCP + 3] - truths[:, :3])
        error.append(np.sum(vector_um * outward[-1], axis=1))
        counted.append(np.abs(far - np.median(far)) < _ON_CIRCLE_MM)
    on, unit, radial = np.concatenate(counted), np.concatenate(outward), np.concatenate(error)
    basis = np.column_stack([np.ones(len(unit)), unit])
    rest = radial - basis @ np.linalg.lstsq(basis[on], radial[on], rcond=None)[0]
    rest[~on] = 0.0
    parts = np.split(rest[:, None] * unit, np.cumsum([len(part) for part in error])[:-1])
    return parts, rms(rest[on])


def _led(error_um: Floats, ahead: int) -> Floats:
    return error_um[np.minimum(np.arange(len(error_um)) + ahead, len(error_um) - 1)]
