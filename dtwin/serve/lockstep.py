"""The serving loop in lock-step with a controller: its clock, the same decision."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from dtwin.errors import DeviceError
from dtwin.links import layout
from dtwin.schema import Floats
from dtwin.serve._timing import LoopTiming
from dtwin.serve.decision import Decision
from dtwin.serve.loop import Mode, ServeStatus

# A step so near the period is one: what is missing is rounding of the stamps.
_WHOLE = 0.999


class Controller(Protocol):
    """What the lock-step loop needs of a virtual controller."""

    @property
    def done(self) -> bool:
        """Whether its program has ended."""

    def state(self) -> Floats:
        """Return the newest state (N,)."""

    def step(self, registers: Floats) -> None:
        """Advance by one period with these correction registers (4,) in force."""


def serve_lockstep(
    decision: Decision,
    controller: Controller,
    *,
    period_s: float = 0.002,
    mode: Mode = "live",
    transport_ticks: int = 1,
    stop: Callable[[], bool] | None = None,
) -> ServeStatus:
    """Serve a virtual controller on its own clock, one tick at a time, until it is done.

    Args:
        decision: Features, equation, direction and safety: the code of the wall-clock loop.
        controller: Machine that advances a tick per correction.
        mode: As in ``ServingLoop``. One of "live", "shadow", "dry-run".
        transport_ticks: Ticks between a state and the arrival of its correction, the modelled transport; 1 is a
            correction that arrives within its own tick.
        stop: Asked every tick; true releases and lets the program run to its end.

    Returns:
        With machine-clock ages; stage times are of the computation alone. A device fault is in it, not raised.
    """
    decision.reset()
    decision.guard.reset()
    timing = LoopTiming(period_s)
    queue = np.zeros((max(1, transport_ticks), layout.REGISTERS_N))
    age_s = (len(queue) - 1) * period_s
    sequence, largest, last_stamp_s, stopped = 0, 0.0, np.nan, False
    fault: DeviceError | None = None
    while not controller.done and fault is None:
        start_ns = time.perf_counter_ns()
        state = controller.state()
        stopped = stopped or (stop is not None and stop())
        row = timing.stages()
        stamp_s = float(state[layout.TIMESTAMP])
        step_s = stamp_s - last_stamp_s
        # States that come closer together earn no full step; a stamp that stands or goes back must not keep it from zero.
        elapsed_s = step_s if 0.0 < step_s < _WHOLE * period_s else period_s
        safe = decision.decide(state, age_s=0.0, elapsed_s=elapsed_s, enabled=not stopped, stages=row)
        largest = max(largest, float(np.sqrt(safe @ safe)))
        arriving = queue[sequence % len(queue)]
        arriving[layout.REGISTER_SEQUENCE] = 0.0 if mode == "shadow" else sequence + 1
        arriving[layout.REGISTER_OFFSET :] = safe if mode == "live" else 0.0
        sequence += 1
        row[5] = time.perf_counter_ns() - start_ns
        row[4] = 0
        try:
            controller.step(queue[sequence % len(queue)])
        except DeviceError as error:
            fault = error
        # It waits for every correction: whatever time it leaves out, no state is missed.
        timing.tick(step_s, period_s, age_s, decision.window_age_s)
        last_stamp_s = stamp_s
    rested = mode != "live" or decision.guard.at_rest
    return ServeStatus(
        clock="machine",
        mode=mode,
        ended=fault.code if fault else "stopped" if stopped else "finished",
        released=rested and fault is None,
        reasons=decision.guard.counted(),
        timing=timing.summary(),
        fault=fault.as_dict() if fault else None,
        largest_um=largest,
        largest_band_um=decision.direction.largest_band_um,
        last_sequence=0 if mode == "shadow" else sequence,
    )
