"""Positioning tests planned: thirteen rules, advice about the pitch, time, programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from dtwin.errors import InputError
from dtwin.kinds.linear._plan import duration_s, linear_advice, linear_plan
from dtwin.kinds.linear._planned import laser_program, proposals
from studies.lathe_fit import read_linear_plan

EXAMPLE: dict[str, Any] = {
    "name": "z",
    "machine": "lathe",
    "axis": "Z",
    "unit": "in",
    "start": 1.0,
    "end": 7.0,
    "step": 1.0,
    "runs": 3,
    "dwell_s": 2.0,
    "feed_min": 50.0,
    "overshoot": 0.1,
    "axis_low": 0.0,
    "axis_high": 41.0,
}
MAPPING = EXAMPLE | {"end": 40.0, "runs": 4, "dwell_s": 5.4, "feed_min": 20.0, "pitch": 0.25}
GOLDEN = Path(__file__).parents[1] / "golden" / "lathe_z_1_7.nc"


def codes(**changes: Any) -> set[str]:
    return {f.code for f in linear_advice(linear_plan(MAPPING | changes, "test"))}


def test_the_published_program_comes_out_line_for_line() -> None:
    """Comments are our own; every word that a control reads is the published one."""
    made = laser_program(linear_plan(EXAMPLE, "test")).splitlines()
    bare = [re.sub(r"\(.*?\)", "()", line) for line in made]
    assert len(bare) == 105
    assert bare == GOLDEN.read_text().splitlines()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"axis": "A"}, "no axis of a machine"),
        ({"axis": "Y"}, "the machine has no such axis"),
        ({"end": 1.0}, "must end above"),
        ({"start": -1.0}, "start lies outside"),
        ({"end": 42.0}, "end lies outside"),
        ({"step": 0.00005}, "too small"),
        ({"step": 7.0}, "longer than the test"),
        ({"step": 0.7}, "does not divide"),
        ({"dwell_s": 0.5}, "dwell is out of range"),
        ({"runs": 100}, "count of runs"),
        ({"feed_min": 51.0}, "feed is out of range"),
        ({"overshoot": 0.0}, "overshoot is out of range"),
        ({"start": 0.0, "end": 7.0}, "no room for the overshoot"),
    ],
)
def test_each_of_the_thirteen_rules_is_kept(changes: dict[str, Any], told: str) -> None:
    linear_plan(EXAMPLE, "test")
    with pytest.raises(InputError, match=told) as caught:
        linear_plan(EXAMPLE | changes, "test")
    assert caught.value.got
    assert caught.value.allowed


def test_metric_plans_have_metric_limits() -> None:
    metric = EXAMPLE | {"unit": "mm", "feed_min": 1000.0, "overshoot": 5.0, "axis_low": -10.0}
    assert "G71\n" in laser_program(linear_plan(metric, "test"))
    with pytest.raises(InputError) as caught:
        linear_plan(metric | {"feed_min": 1300.0}, "test")
    assert caught.value.allowed == "2.54 to 1270 mm/min"


@pytest.mark.parametrize("text", ["", "[plan]\nkind = 3\n", "[plan]\nname = 1\n", "[plan]\nx = 1", "="])
def test_a_plan_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(InputError):
        read_linear_plan(path)


def test_the_published_mapping_takes_twenty_hours() -> None:
    plan = linear_plan(MAPPING | {"step": 0.025}, "test")
    assert (plan.count, plan.readings) == (1561, 12488)
    assert duration_s(plan) / 3600 == pytest.approx(20.0, abs=0.2)


def test_steps_and_pitch() -> None:
    folded = linear_advice(linear_plan(MAPPING | {"step": 0.5, "dwell_s": 6.0}, "test"))
    told = next(f for f in folded if f.code == "plan.step_and_pitch")
    assert (told.severity, told.numbers["phases_1"]) == ("warning", 1.0)
    advised = float(re.findall(r"; ([\d.]+) in does better", told.message)[0])
    better = codes(step=advised, dwell_s=6.0)
    assert "plan.step_and_pitch" not in better
    # 0.52 in meets 25 angles, 0.025 in ten.
    assert "plan.step_and_pitch" not in codes(step=0.52)
    assert "plan.too_coarse_for_a_table" in codes(step=0.52)
    fine = linear_advice(linear_plan(MAPPING | {"step": 0.025}, "test"))
    assert {f.code: f.severity for f in fine}["plan.step_and_pitch"] == "info"
    assert "plan.too_coarse_for_a_table" not in {f.code for f in fine}
    assert "plan.pitch_unknown" in codes(step=0.52, pitch=0.0)


def test_laser_and_machine_that_will_miss_each_other() -> None:
    assert codes(step=0.52, dwell_s=6.0) == {"plan.too_coarse_for_a_table"}
    assert "plan.dwell_too_short" in codes(step=0.52, dwell_s=3.0)
    assert "plan.window_too_wide" in codes(step=0.025, dwell_s=6.0)
    assert "plan.overshoot_in_window" in codes(step=0.52, dwell_s=6.0, overshoot=0.04)
    assert "plan.long" in codes(step=0.025, dwell_s=6.0)
    assert "plan.no_repeats" in codes(step=0.52, dwell_s=6.0, runs=1)


MM = EXAMPLE | {"unit": "mm", "start": 5.0, "end": 305.0, "axis_high": 400.0, "overshoot": 2.0, "feed_min": 1000.0}


def test_a_step_that_beats_with_the_pitch_is_told_and_another_proposed() -> None:
    plan = linear_plan(MM | {"step": 21.428571428571427, "pitch": 20.0}, "test")
    told = next(f for f in linear_advice(plan) if f.code == "plan.step_beats_pitch")
    better = float(re.search(r"; ([0-9.]+) mm does better", told.message)[1])  # type: ignore[index]
    assert "(20 mm) as one of 300 mm" in told.message
    assert "plan.step_beats_pitch" not in {
        f.code for f in linear_advice(linear_plan(MM | {"step": better, "pitch": 20.0}, "test"))
    }


@pytest.mark.parametrize("travel_mm", [100.0, 310.0, 430.0, 1000.0])
@pytest.mark.parametrize("pitch_mm", [5.0, 10.0, 16.0, 20.0, 25.4])
def test_no_proposal_meets_the_screw_at_few_angles_or_beats_with_it(travel_mm: float, pitch_mm: float) -> None:
    for document in proposals("m", {"X": {"travel_mm": travel_mm, "pitch_mm": pitch_mm}}):
        stated = {name: value for name, value in document["plan"].items() if name != "kind"}
        said = {f.code for f in linear_advice(linear_plan(stated, "test")) if f.severity == "warning"}
        assert not said & {"plan.step_beats_pitch", "plan.step_and_pitch"}
