"""The virtual lathe: programs, the laser's trigger, play, and the published map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.errors import InputError
from dtwin.kinds.linear._plan import LinearPlan
from dtwin.kinds.linear._planned import laser_program
from dtwin.kinds.linear._simulate import laser_setup, motion_of_plan, simulate_lathe, verification_plan, virtual_lathe
from dtwin.machines.laser_trigger import watch
from dtwin.machines.lathe import NetworkScrew, ThreadScrew, VirtualLathe, Wander, run_program
from dtwin.machines.printed_network import read_network
from dtwin.report.checking import check_source

CALM = Wander(offset_um=0.0, scale_um_per_m=0.0, reading_um=0.0, quantum_um=0.0)
SMALL = replace(verification_plan(), end=6.2, step=0.52, runs=2)


def codes(plan: LinearPlan) -> set[str]:
    motion = motion_of_plan(plan)
    later = motion.t_s >= motion.zeroed_s
    found = watch(motion.t_s[later], motion.position_mm[later], laser_setup(plan))
    return {a.code for a in found.alarms}


def test_the_control_runs_its_programs_in_both_dialects() -> None:
    first, second = (run_program(laser_program(SMALL, c), "Z") for c in ("opencnc", "iso"))
    assert np.allclose(first.t_s, second.t_s)
    assert np.allclose(first.position_mm, second.position_mm)
    assert first.position_mm.max() == pytest.approx(6.3 * 25.4)
    for text in ("G53Z1.0F50.\nG02X1Y1\n", "G53Z1.0\nG53Z2.0\n", "hello", "(nothing)\n"):
        with pytest.raises(InputError):
            run_program(text, "Z")


def test_every_target_is_read_once_from_each_side_in_its_order() -> None:
    motion = motion_of_plan(SMALL)
    later = motion.t_s >= motion.zeroed_s
    found = watch(motion.t_s[later], motion.position_mm[later], laser_setup(SMALL))
    assert found.alarms == ()
    up = [t * 25.4 for t in SMALL.targets]
    assert [r.target_mm for r in found.readings] == pytest.approx((up + up[::-1]) * 2)
    assert [r.direction for r in found.readings[10:12]] == ["forward", "reverse"]
    assert all(r.end_s - r.begin_s == pytest.approx(2.0) for r in found.readings)


def test_what_laser_and_control_do_to_each_other_is_told_by_name() -> None:
    assert codes(SMALL) == set()
    assert codes(replace(SMALL, dwell_s=3.0)) >= {"trigger.dwell_too_short", "trigger.missed"}
    assert codes(replace(SMALL, overshoot=0.04)) >= {"trigger.missed"}
    close = replace(SMALL, end=2.0, step=0.025)
    assert "trigger.moved_while_reading" in codes(close)
    assert codes(replace(close, window=0.01)) == set()


def test_a_window_smaller_than_the_error_is_told() -> None:
    plan = replace(SMALL, window=0.001)
    lathe = VirtualLathe(NetworkScrew(read_network()), CALM, 1)
    found = lathe.measure(motion_of_plan(plan), laser_setup(plan))
    told = {a.code for a in found.triggered.alarms}
    assert told >= {"trigger.window_too_small", "trigger.missed"}


def test_the_slide_keeps_its_place_within_the_play() -> None:
    screw = ThreadScrew(tilt_um=0.0, wave_um=0.0, lead_um_per_m=0.0, wear_um=0.0)
    still = replace(
        screw,
        leading=replace(screw.leading, once_um=0.0, twice_um=0.0),
        trailing=replace(screw.trailing, once_um=0.0, twice_um=0.0),
    )
    places = VirtualLathe(still, CALM).slide_mm(np.array([10.0, 11.0, 10.95, 10.98, 10.5, 11.0]))
    # 72 um of play: a way back of 50 um moves nothing.
    assert np.allclose(places, [9.964, 10.964, 10.964, 10.964, 10.536, 10.964])


def test_the_tilted_nut_makes_the_cyclic_error_differ_with_the_direction() -> None:
    x = np.linspace(400.0, 406.35, 201)[:-1]
    lower, upper = ThreadScrew().flanks_um(x)
    waves = [np.fft.rfft(e - np.linspace(e[0], e[-1], len(e)))[2] / 100 for e in (lower, upper)]
    assert abs(waves[0] - waves[1]) > 2.0


def test_without_wander_the_laser_shows_the_published_map() -> None:
    lathe = VirtualLathe(NetworkScrew(read_network()), CALM, 1)
    found = lathe.measure(motion_of_plan(SMALL), laser_setup(SMALL))
    target = np.array([r.target_mm for r in found.triggered.readings]) / 25.4
    way = np.array([r.direction == "reverse" for r in found.triggered.readings], float)
    # The reflector is where the slide is, so the map is read to within its slope times its error.
    told = read_network().error_in(way, target) * 25400.0
    assert np.max(np.abs(found.truth_um - told)) < 1e-6
    assert found.error_um[0] == pytest.approx(0.0, abs=1e-6)
    assert np.allclose(found.error_um, found.truth_um - found.truth_um[0], atol=1e-6)


def test_the_published_figures_lie_in_the_scatter_of_the_simulated_campaigns() -> None:
    """The verification grid sees a little less than the mapping: medians over ten seeds."""
    plan = verification_plan()
    motion, setup = motion_of_plan(plan), laser_setup(plan)
    ranges = []
    for seed in range(10):
        error = virtual_lathe("published", seed).measure(motion, setup).error_um
        means = error.reshape(4, 2, -1).mean(axis=0)
        means[1] = means[1][::-1]
        ranges.append([np.ptp(means), np.abs(means[1] - means[0]).max()])
    average, reversal = np.median(ranges, axis=0) / 25400.0
    assert 0.0047 < average < 0.0056
    assert 0.0036 < reversal < 0.0043


def test_a_campaign_is_written_and_checked(tmp_path: Path) -> None:
    folder = tmp_path / "z"
    readings, alarms = simulate_lathe(folder, quick=True, seed=3)
    assert (readings, alarms) == (608, ())
    opened = open_campaign(folder)
    runs, rejected = opened.read(opened.entries[0])
    assert (len(runs), rejected) == (4, [])
    assert not any(f.severity == "error" for run in runs for f in run.findings)
    assert runs[0].meta.condition["axis"] == "Z"
    result = check_source(folder)
    assert {f["code"] for f in result["findings"]} == {"linear.drift"}
    assert result["positioning"]["before_after"]["cyclic_error_um"] == pytest.approx(36.8, abs=4)
    with pytest.raises(InputError, match="already"):
        simulate_lathe(folder, quick=True)
    with pytest.raises(InputError, match="no such lathe"):
        simulate_lathe(tmp_path / "y", truth="other", quick=True)


def test_the_same_seed_is_the_same_campaign(tmp_path: Path) -> None:
    plan = SMALL
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        simulate_lathe(tmp_path / name, plan=plan, seed=seed, truth="mechanism")
    a, b, c = ((tmp_path / n / "laser.txt").read_text() for n in "abc")
    assert a == b != c
