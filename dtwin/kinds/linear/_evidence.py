"""The laser looks at the virtual lathe on days with a correction, and on others without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta

import numpy as np

from dtwin.acquire.virtual import EPOCH
from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import axis_number, is_positioning_bundle
from dtwin.kinds.linear._gates import screw_logged
from dtwin.kinds.linear._loop import PERIOD_S, ExactCorrection, looped, measured
from dtwin.kinds.linear._models import MM_PER_IN
from dtwin.kinds.linear._plan import LinearPlan, better_step
from dtwin.kinds.linear._simulate import verification_plan, virtual_lathe
from dtwin.positioning.matrix import LinearTest
from dtwin.progress import Progress
from dtwin.schema import Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.train.measured_ways import MeasuredWays, guard_shares, numbered

_DAYS = 3
_CLOCK = "machine clock, 10 ms cycle, one cycle late"
_TARGETS = 60


def measured_days(
    bundle: Bundle, logged: Mapping[str, float], truth: str, seed: int, progress: Progress | None = None
) -> MeasuredWays:
    """Measure the mapped travel on several days with a bundle, and on as many between without.

    Every day has its own drift and noise. The oracle is an exact map on the days without.

    ``logged``: what its training logged: mapped travel and pitch.
    ``truth``: as for :func:`dtwin.kinds.linear._simulate.virtual_lathe`.
    """
    if not is_positioning_bundle(bundle):
        raise InputError("the bundle does not correct a position", code="lathe.bundle", got=bundle.name)
    pitch_mm, low_mm, high_mm = screw_logged(logged)
    axis = "XYZ"[axis_number(bundle)]
    plan = evidence_plan((low_mm, high_mm), pitch_mm, bundle.machine, axis)
    runs: list[Run] = []
    oracle: list[Run] = []
    guards: list[Mapping[str, int]] = []
    for day in range(_DAYS):
        first = 1000 * (seed + 1) + 10 * day
        lathe = virtual_lathe(truth, first)
        runs.append(_run_of_test(measured(lathe, plan), plan.axis, 2 * day))
        oracle.append(_run_of_test(measured(lathe, plan, ExactCorrection(lathe)), plan.axis, 2 * day))
        served = looped(virtual_lathe(truth, first + 1), plan, bundle)
        runs.append(_run_of_test(served.test, plan.axis, 2 * day + 1, bundle.model_sha256))
        guards.append(served.guard)
        if progress is not None:
            progress(day + 1, _DAYS, "days")
    shares = guard_shares(guards)
    return MeasuredWays(
        numbered(runs),
        _CLOCK,
        {"one cycle of the loop": PERIOD_S},
        tuple(oracle),
        {f"{plan.axis} {way}": shares for way in ("forward", "reverse")},
    )


def _run_of_test(test: LinearTest, axis: str, day: int, correction: str = "") -> Run:
    """Return readings of a test of one run as a run of the lake.

    ``test``: every target once in each direction.
    ``correction``: as for :class:`RunMeta`.
    """
    there, back = test.position_mm, test.position_mm[::-1]
    n = len(there)
    samples = {
        "t_s": np.arange(2.0 * n),
        "position_mm": np.concatenate([there, back]),
        "direction": np.repeat(np.array(["forward", "reverse"], dtype=object), n),
        "error_um": np.concatenate([test.forward_um[:, 0], test.reverse_um[::-1, 0]]),
    }
    meta = RunMeta(
        "e",
        kind="linear",
        condition={"axis": axis},
        correction=correction,
        sample_rate_hz=1.0,
        started=(EPOCH + timedelta(days=day)).isoformat(),
    )
    return Run(meta, samples, source="virtual lathe")


def evidence_plan(reach_mm: tuple[float, float], pitch_mm: float, machine: str, axis: str = "Z") -> LinearPlan:
    """Return a test, in inches as the virtual lathe's, over the mapped travel, whose step meets the screw at many angles.

    ``pitch_mm``: travel in one turn of the screw.
    """
    low, high = (round(end / MM_PER_IN, 4) for end in reach_mm)
    span = round(high - low, 4)
    head = replace(
        verification_plan(),
        name="evidence",
        machine=machine,
        axis=axis,
        start=low,
        end=high,
        runs=1,
        step=span / _TARGETS,
        axis_low=low - 1.0,
        axis_high=high + 1.0,
        pitch=pitch_mm / MM_PER_IN,
    )
    step = better_step(head, span / 8.0) or head.step
    return replace(head, step=step, window=min(head.window, step / 4.0))
