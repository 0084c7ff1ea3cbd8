"""Readings of a positioning test in matrices, also where the laser missed most of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dtwin.kinds.registry import kind_named
from dtwin.positioning.matrix import linear_test
from dtwin.schema import Run, RunMeta


def swept(number: int, forward: list[float], reverse: list[float]) -> Run:
    ways = ["forward"] * len(forward) + ["reverse"] * len(reverse)
    at = np.array([*forward, *reverse])
    samples = {"t_s": np.arange(at.size, dtype=float), "position_mm": at, "error_um": 0.1 * at}
    meta = RunMeta(f"r{number}", kind="linear", condition={"axis": "X"}, repeat=number)
    return Run(meta, {**samples, "direction": np.array(ways, dtype=object)})


def test_targets_that_every_run_read_both_ways_are_kept() -> None:
    found = linear_test([swept(1, [5.0, 24.0, 43.0], [43.0, 24.0, 5.0]), swept(2, [5.0, 43.0], [43.0, 5.0])])
    assert found.position_mm.tolist() == [5.0, 43.0]
    assert found.forward_um.shape == found.reverse_um.shape == (2, 2)
    assert found.left_out == 1


def test_runs_with_no_target_in_common_are_judged_without_an_exception() -> None:
    runs = [swept(1, [5.0, 24.0], [43.0]), swept(2, [62.0], [5.0])]
    found = linear_test(runs)
    assert (found.position_mm.size, found.forward_um.shape, found.left_out) == (0, (0, 2), 4)
    assert isinstance(kind_named("linear").judge_campaign(runs), list)


def test_cycles_stand_in_the_order_of_their_repeats_not_of_their_names() -> None:
    rng = np.random.default_rng(0)
    moved = []
    for number in (1, 10, 11, 2, 3, 4, 5, 6, 7, 8, 9):
        run = swept(number, [5.0, 24.0, 43.0], [43.0, 24.0, 5.0])
        lost = -12.5 * number + rng.normal(0.0, 0.3, 6)
        moved.append(replace(run, samples={**run.samples, "error_um": run.samples["error_um"] + lost}))
    assert np.allclose(np.diff(linear_test(moved).forward_um, axis=1), -12.5, atol=2.0)
    assert [f.code for f in kind_named("linear").judge_campaign(moved)] == ["linear.slip"]


def test_a_cycle_keeps_its_number_where_another_is_left_out() -> None:
    rng = np.random.default_rng(0)
    runs = []
    for number in (1, 3, 4, 5, 6):
        run = swept(number, [5.0, 24.0, 43.0, 62.0], [62.0, 43.0, 24.0, 5.0])
        error_um = run.samples["error_um"] + rng.normal(0.0, 0.3, 8)
        error_um[2] += 50.0 * (number == 4)
        runs.append(replace(run, samples={**run.samples, "error_um": error_um}))
    (found,) = kind_named("linear").judge_campaign(runs)
    assert "cycle 4 forward at 43 mm" in found.message


def test_a_position_that_no_machine_has_is_told_as_it_is() -> None:
    found = linear_test([swept(1, [-0.0, 24.0, 1e60], [1e60, 24.0, 0.0])])
    assert np.allclose(found.position_mm, [0.0, 24.0, 1e60])
    assert not np.signbit(found.position_mm).any()
