"""Counts of the loop's clockwork, and what it reports of the system."""

from __future__ import annotations

import gc
import json
import os
from pathlib import Path

import numpy as np
import pytest
from bundles import path_bundle, sensor_bundle

from dtwin.features.windows import WindowContract
from dtwin.serve._timing import LoopTiming
from dtwin.serve.decision import Decision
from dtwin.serve.realtime import realtime
from dtwin.serve.runtime import CompiledBundle


def test_late_and_missed_ticks_are_counted() -> None:
    timing = LoopTiming(0.002)
    timing.tick(np.nan, np.nan, 0.0005, 0.0)
    for step_s, age_s in ((0.002, 0.0005), (0.002, 0.0021), (0.008, 0.0005), (0.002, 0.001)):
        timing.tick(step_s, step_s, age_s, 0.0)
    assert (timing.ticks, timing.late, timing.missed) == (5, 1, 3)
    assert timing.late_share == pytest.approx(4 / 8)
    json.dumps(timing.summary(), allow_nan=False)


def test_a_correction_is_late_by_the_state_that_it_first_acts_in() -> None:
    timing = LoopTiming(0.002)
    for k in range(6):
        timing.tick(0.002, 0.002, 0.0005, 0.0, stamp_s=0.002 * k, sequence=100 + k)
    timing.applied(0, 0.002)
    timing.applied(101, 0.006)
    assert timing.late == 1
    timing.applied(101, 0.012)
    timing.applied(105, 0.012)
    assert timing.late == 3
    assert timing.late_stamps_s() == pytest.approx([0.000, 0.004, 0.006])
    assert timing.summary()["answer_ms"]["max"] == pytest.approx(8.0)


def test_a_tick_that_is_late_twice_counts_once() -> None:
    timing = LoopTiming(0.002, capacity=4)
    timing.applied(7, 0.0)
    timing.tick(0.002, 0.002, 0.003, 0.0, stamp_s=0.0, sequence=8)
    timing.applied(8, 0.02)
    assert timing.late == 1
    for k in range(5):
        timing.tick(0.002, 0.002, 0.0, 0.0, stamp_s=0.02 + 0.002 * k, sequence=9 + k)
    timing.applied(13, 0.03)
    assert timing.late == 3


def test_numbers_of_another_session_are_not_taken_for_ours() -> None:
    timing = LoopTiming(0.002)
    timing.tick(0.002, 0.002, 0.0, 0.0, stamp_s=0.0, sequence=5)
    timing.applied(2_000_000_000, 1.0)
    timing.applied(5, 0.004)
    assert timing.late == 0
    assert timing.summary()["answer_ms"]["max"] == pytest.approx(4.0)


def test_empty_and_overflowing_buffers() -> None:
    empty = LoopTiming(0.002).summary()
    assert (empty["ticks"], empty["period_ms"]) == (0, None)
    json.dumps(empty, allow_nan=False)
    timing = LoopTiming(0.002, capacity=8)
    for k in range(20):
        timing.stages()[:] = k * 1000
        timing.tick(0.002, 0.002, 0.0, 0.0)
    summary = timing.summary()
    assert summary["ticks"] == 20
    assert summary["stage_us"]["total"]["max"] == 19.0
    assert sum(summary["jitter_us_histogram"].values()) == 8


def test_jitter_lands_in_its_bin() -> None:
    timing = LoopTiming(0.002)
    for interval_s in (0.002, 0.00203, 0.0045):
        timing.tick(interval_s, 0.002, 0.0, 0.0)
    histogram = timing.summary()["jitter_us_histogram"]
    assert (histogram["<10"], histogram["<50"], histogram["<5000"]) == (1, 1, 1)


WAKE_UP = "/dev/cpu_dma_latency"


def _target(link: Path) -> str:
    """Where a descriptor of this process points; listing them opens one that is gone again."""
    return str(link.readlink()) if link.is_symlink() else ""


def test_realtime_is_undone_and_reports_every_part() -> None:
    policy, enabled = os.sched_getscheduler(0), gc.isenabled()
    with realtime(priority=10) as report:
        assert not gc.isenabled()
        assert set(report) == {"priority", "memory_lock", "timer_slack", "processor", "garbage_collection", "awake"}
        used = report["priority"] == "used"
        assert (os.sched_getscheduler(0) == os.SCHED_FIFO) == used
        wishes = [link for link in Path("/proc/self/fd").iterdir() if _target(link) == WAKE_UP]
        assert (len(wishes) == 1) == (report["awake"] == "used")
    assert WAKE_UP not in {_target(link) for link in Path("/proc/self/fd").iterdir()}
    assert os.sched_getscheduler(0) == policy
    assert gc.isenabled() == enabled


def test_what_the_system_refuses_is_said_not_raised() -> None:
    with realtime(priority=5000, core=10_000) as report:
        assert report["priority"].startswith("not available: ")
        assert report["processor"].startswith("not available: ")


class NoWindow:
    """Counts how often it is asked."""

    def __init__(self, contract: WindowContract) -> None:
        self.contract, self.asked = contract, 0

    def newest_window(self) -> tuple[None, float]:
        self.asked += 1
        return None, float("inf")


def test_warming_up_leaves_no_trace() -> None:
    bundle = sensor_bundle()
    assert bundle.window is not None
    sensors = NoWindow(bundle.window)
    for decision in (
        Decision(CompiledBundle(path_bundle()), np.zeros(3)),
        Decision(CompiledBundle(bundle), np.zeros(3), sensors=sensors),
    ):
        assert decision.guard.counted() == {}
        assert decision.guard.at_rest
        assert not decision.compiled._tape.inputs.any()
    assert sensors.asked == 0
