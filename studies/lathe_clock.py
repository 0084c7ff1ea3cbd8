"""The lathe's correction every 10 ms of real time, with every cycle accounted for."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import POSITION
from dtwin.kinds.linear._evidence import PERIOD_S
from dtwin.kinds.linear._plan import LinearPlan
from dtwin.kinds.linear._simulate import motion_of_plan
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.realtime import realtime
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from studies.lathe_fit import plan_or_published, positioning_bundle

_LEAD_S = 0.05
_QUANTILES = (50.0, 99.0, 99.9, 100.0)
Send = Callable[[int, float], None]


class _Cycles:
    """What happened to each cycle. ``n``: cycles that are due."""

    def __init__(self, n: int) -> None:
        self.begun_s = np.full(n, np.nan)
        self.ready_s = np.full(n, np.nan)
        self.sent_um = np.zeros(n)
        self.missed = self.late = 0


def paced(
    bundle: Bundle, plan: LinearPlan, seconds: float, *, priority: int = 60, send: Send | None = None
) -> dict[str, Any]:
    """Correct the axis of a plan in real time, one correction in each cycle of 10 ms.

    A cycle whose time has passed before it could begin is missed and counted; the next one takes
    the axis where it is by then. A cycle is late when its correction was ready after the next one
    was due.

    ``bundle``: predicts the error from the commanded position ``position_mm``.
    ``plan``: the motion; it begins again when it has ended.
    ``priority``: as for :func:`dtwin.serve.realtime.realtime`; 0 leaves the scheduler alone.
    ``send``: called with (cycle, um) for every correction, as a link to a control would be.
    Returns counts, jitter and times in ms, what the system allowed, and the guard's reasons.
    Raises ``InputError`` when the bundle asks for more than the position.
    """
    names = [i.name for i in bundle.inputs]
    if names != [POSITION]:
        raise InputError(
            "only a correction that remembers the play runs in real time",
            code="lathe.wall_clock",
            got=f"inputs {', '.join(names)}"[:120],
            allowed=POSITION,
            hint="dtwin lathe fit --model flanks",
        )
    n = max(1, round(seconds / PERIOD_S))
    motion = motion_of_plan(plan)
    length_s = float(motion.t_s[-1] - motion.t_s[0])
    position_mm = motion.at(motion.t_s[0] + np.arange(n) * PERIOD_S % length_s)
    compiled = CompiledBundle(bundle)
    guard = Guard(bundle.safety, *bundle.box)
    # Compiled and called once before any time counts.
    _correct(compiled, guard, float(position_mm[0]), PERIOD_S)
    compiled.reset()
    guard.reset()
    cycles = _Cycles(n)
    with realtime(priority) as allowed:
        begun_s = _run(cycles, compiled, guard, position_mm, send)
    return _summary(cycles, begun_s, allowed, guard)


def paced_by(path: Path, plan: Path | None, seconds: float) -> dict[str, Any]:
    """Return the same of the files of a bundle and of a plan; of the published plan without one."""
    chosen = plan_or_published(plan)
    return paced(positioning_bundle(path), chosen, seconds)


def _run(cycles: _Cycles, compiled: CompiledBundle, guard: Guard, position_mm: Floats, send: Send | None) -> float:
    begun_s = time.perf_counter() + _LEAD_S
    last, number = -1, 0
    while number < len(position_mm):
        wait_s = begun_s + number * PERIOD_S - time.perf_counter()
        if wait_s > 0.0:
            time.sleep(wait_s)
        now_s = time.perf_counter()
        behind = int((now_s - begun_s) / PERIOD_S) - number
        if behind > 0:
            cycles.missed += min(behind, len(position_mm) - number)
            number += behind
            continue
        cycles.begun_s[number] = now_s
        elapsed_s = (number - last) * PERIOD_S
        um = _correct(compiled, guard, float(position_mm[number]), elapsed_s)
        if send is not None:
            send(number, um)
        cycles.sent_um[number] = um
        cycles.ready_s[number] = time.perf_counter()
        if cycles.ready_s[number] > begun_s + (number + 1) * PERIOD_S:
            cycles.late += 1
        last, number = number, number + 1
    if send is not None:
        send(len(position_mm), 0.0)
    return begun_s


def _correct(compiled: CompiledBundle, guard: Guard, position_mm: float, elapsed_s: float) -> float:
    inputs = np.array([position_mm])
    wanted = np.array([0.0, 0.0, -float(compiled.tick(inputs)[0])])
    return float(guard.step(wanted, inputs, age_s=0.0, elapsed_s=elapsed_s)[2])


def _summary(cycles: _Cycles, begun_s: float, allowed: dict[str, str], guard: Guard) -> dict[str, Any]:
    n = len(cycles.begun_s)
    done = np.isfinite(cycles.ready_s)
    due_s = begun_s + np.arange(n) * PERIOD_S
    steps = np.abs(np.diff(cycles.sent_um[done]))
    return {
        "cycles": n,
        "corrected": int(done.sum()),
        "missed": cycles.missed,
        "late": cycles.late,
        "unaccounted": n - int(done.sum()) - cycles.missed,
        "jitter_ms": _spread(1e3 * (cycles.begun_s - due_s)[done]),
        "work_ms": _spread(1e3 * (cycles.ready_s - cycles.begun_s)[done]),
        "largest_step_um": float(steps.max()) if len(steps) else 0.0,
        "realtime": dict(allowed),
        "guard": guard.counted(),
    }


def _spread(values: Floats) -> dict[str, float]:
    names = ("p50", "p99", "p99.9", "max")
    quantiles = np.percentile(values, _QUANTILES) if len(values) else np.full(4, np.nan)
    return {name: float(value) for name, value in zip(names, quantiles, strict=True)}
