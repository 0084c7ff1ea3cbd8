from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dtwin.errors import DeviceError
from dtwin.serve._machine_serving import ServingRequest, _Stops
from dtwin.serve.decision import SATURATED, SOUND, _saturated_kernel
from dtwin.serve.safety import OK, STALE_WINDOW

NOISE = np.random.default_rng(1).standard_normal(600)


def test_a_signal_that_was_cut_is_found_on_either_side() -> None:
    assert _saturated_kernel(np.clip(NOISE, -9.0, 1.2)) == SATURATED
    assert _saturated_kernel(np.clip(NOISE, -1.2, 9.0)) == SATURATED


@pytest.mark.parametrize("steps", [100, 1000])
def test_sound_signals_are_not_accused(steps: int) -> None:
    sine = np.round(steps * np.sin(np.linspace(0.0, 60.0, 600)))
    assert _saturated_kernel(sine) == SOUND
    assert _saturated_kernel(NOISE) == SOUND
    # Stuck is another trouble, which the features name.
    assert _saturated_kernel(np.full(600, 0.3)) == SOUND


def test_serving_ends_where_windows_never_come_again() -> None:
    """A module that is looked for may come back; of a reader that was killed nothing will come: zeros would be sent for ever."""
    died = DeviceError("the acquisition process died", code="daq.worker_died")
    sensors = SimpleNamespace(fault=lambda: died, over=False)
    guard = SimpleNamespace(latched=False, reason=STALE_WINDOW)
    loop: Any = SimpleNamespace(watch=SimpleNamespace(condition="running", since_s=0.0))
    decision: Any = SimpleNamespace(guard=guard, sensors=sensors)
    stops = _Stops(lambda: False, loop, decision, ServingRequest("here"), str)
    assert not stops()
    sensors.over, guard.reason = True, OK
    assert not stops()
    guard.reason = STALE_WINDOW
    assert stops()
    assert (stops.why, stops.fault("here")) == ("daq.worker_died", died)
