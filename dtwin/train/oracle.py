"""The best correction that can be found when the truth is known, under a bundle's own limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.signal import butter, sosfiltfilt

from dtwin.links import state as layout
from dtwin.machines import mechanism as m_
from dtwin.machines.controller import CobotController
from dtwin.machines.parameters import ControllerParameters
from dtwin.schema import Floats
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.safety import Guard
from dtwin.units import UM_PER_MM

TICK_S = 0.002
Controller = TypeVar("Controller", bound=CobotController)
_ROUNDS = 5
# What is learned from a run is taken below this; above it the structure answers out of phase.
_LEARNED_HZ = 20.0


def best_offsets(
    make: Callable[[], CobotController], motion: ControllerParameters, safety: SafetyLimits
) -> Floats:
    """Return the offsets that leave least of the true error, found by running again and again.

    Begun with nothing and with the uncorrected error led ahead by delay and lag; then what is left of
    the best run so far is learned, by half as much after a run that was worse. What is returned is
    the best of these, so never worse than no correction; nobody proves that there is no better one.

    Parameters
    ----------
    make : callable
        A new controller at the start of the program, which repeats exactly.
    motion : ControllerParameters
        For delay and lag.
    safety : SafetyLimits
        Limits of the bundle, to which these offsets are subject, too.

    Returns
    -------
    ndarray, shape (ticks, 3)
        um, before the guard.
    """
    ahead = round((motion.actuator_delay_s + motion.actuator_lag_s) / TICK_S)
    low = butter(2, _LEARNED_HZ, fs=1.0 / TICK_S, output="sos")
    best, left = np.zeros((1, 3)), _left_um(follow(make(), np.zeros((1, 3)), safety)[0])
    wanted, gain = -_led(left, ahead), 1.0
    for _ in range(_ROUNDS):
        after = _left_um(follow(make(), wanted, safety)[0])
        if np.mean(after**2) < np.mean(left**2):
            best, left = wanted, after
        else:
            gain *= 0.5
        learned = gain * sosfiltfilt(low, _led(left, ahead), axis=0)
        wanted = best[np.minimum(np.arange(len(learned)), len(best) - 1)] - learned
    return best


def follow(
    controller: Controller, offsets_um: Floats, safety: SafetyLimits
) -> tuple[Controller, dict[str, int]]:
    """Run a program with offsets through the guard; return it and how often each guard acted.

    Parameters
    ----------
    controller : CobotController
        At the start of the program.
    offsets_um : ndarray, shape (n, 3)
        By tick; the last one is held.
    safety : SafetyLimits
        Limits.
    """
    guard, nothing = Guard(safety, np.empty(0), np.empty(0)), np.empty(0)
    tick = 0
    while not controller.done:
        wanted = offsets_um[min(tick, len(offsets_um) - 1)]
        safe = guard.step(wanted, nothing, age_s=0.0, elapsed_s=TICK_S, enabled=True)
        controller.step(layout.correction_registers(tick + 1, safe))
        tick += 1
    return controller, guard.counted()


def _left_um(controller: CobotController) -> Floats:
    truths = controller.ticks().truths
    return np.asarray(UM_PER_MM * (truths[:, m_.TCP : m_.TCP + 3] - truths[:, :3]))


def _led(error_um: Floats, ahead: int) -> Floats:
    return error_um[np.minimum(np.arange(len(error_um)) + ahead, len(error_um) - 1)]
