"""The everyday test of a ball bar: three planes, one radius, one feed, both ways; effects that act in one plane only."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics.candidates import Candidates
from dtwin.physics.cross_validation import left_out_gain
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term, set_up
from dtwin.schema import Campaign, Run, RunMeta

LIBRARY = Library()
LEANING = {"XY": 20.0, "YZ": -13.0, "ZX": 24.0}


def three_planes(mill: MillParameters, seed: int) -> Observations:
    made = VirtualMill(mill, seed=seed, noise=NoiseParameters(rms_um=0.1))
    tests = [
        CircularTest(plane, way, 150.0, 1000.0, repeat, plane)
        for plane in ("XY", "YZ", "ZX")
        for repeat in (1, 2)
        for way in ("CCW", "CW")
    ]
    return observe(made.campaign(), made.measure(tests))


def named(obs: Observations) -> list[set[str]]:
    return [{s.label for s in group} for group in diagnose(obs, [], LIBRARY).found]


def test_what_acts_in_one_plane_foretells_runs_that_are_left_out_of_it() -> None:
    obs = three_planes(MillParameters(squareness_um_m={"XY": 20.0}), seed=3)
    problem = set_up(obs, [], [])
    candidates = Candidates(obs, [Instance(LIBRARY["squareness"], plane) for plane in LEANING])
    gains = {
        plane: left_out_gain(problem, candidates.whitened(problem, Term(Instance(LIBRARY["squareness"], plane), {})))
        for plane in LEANING
    }
    assert gains["XY"] > 0.5
    assert max(gains["YZ"], gains["ZX"]) < 0.1


@pytest.mark.parametrize("seed", [1, 2])
def test_three_leaning_axes_are_no_bent_guideways(seed: int) -> None:
    obs = three_planes(MillParameters(squareness_um_m=LEANING).with_axis("Y", scale_ppm=13.0), seed)
    groups = named(obs)
    assert all({f"squareness {plane}"} in groups for plane in LEANING)
    assert not any("guideway_shape" in label for group in groups for label in group)
    sizes = {e.axis: e for e in fit(obs, [Term(Instance(LIBRARY["squareness"], p), {}) for p in LEANING]).estimates}
    assert all(abs(sizes[p].value - LEANING[p]) < 3.0 for p in LEANING)


def test_scales_of_two_axes_are_in_the_group_of_a_servo_lag_of_all() -> None:
    mill = MillParameters(squareness_um_m={"XY": -14.0}).with_axis("X", scale_ppm=25.0).with_axis("Y", scale_ppm=15.0)
    groups = named(three_planes(mill, seed=1))
    assert any({"scale_mismatch X", "scale_mismatch Y"} <= group for group in groups)


def test_a_bend_that_only_the_plane_left_out_shows_is_no_reason_against_scales() -> None:
    """On an arc a bend and a scale are nearly alike: without its own bend, the plane left out seemed to contradict the scale."""
    stretched, bow_um = {"X": 40.0, "Y": 0.0, "Z": -20.0}, -3.0
    runs = []
    for (plane, begin, end), way, repeat in product(
        (("XY", 0, 360), ("YZ", -20, 200), ("ZX", -110, 110)), ("CCW", "CW"), (1, 2)
    ):
        angle = np.arange(begin, end, 0.5) + 0.25
        cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        value = 0.1 * (stretched[plane[0]] * cos**2 + stretched[plane[1]] * sin**2)
        value += bow_um * cos**2 * sin if plane == "YZ" else 0.0
        value += 0.05 * np.random.default_rng(len(runs)).standard_normal(angle.size)
        meta = RunMeta(f"{len(runs)}", "circular", plane, way, 100.0, 1000.0, repeat=repeat, setup=plane)
        turned = slice(None, None, 1 if way == "CCW" else -1)
        runs.append(Run(meta, {"angle_deg": angle[turned], "deviation_um": value[turned]}))
    obs = observe(Campaign("arcs", "mill"), runs)
    lag, bow = (Term(Instance(LIBRARY[name], axis), {}) for name, axis in (("servo_lag", ""), ("straightness", "Y")))
    candidates = Candidates(obs, [lag.instance, bow.instance])
    problem = candidates.given(set_up(obs, [], []), [bow])
    assert left_out_gain(problem, candidates.whitened(problem, lag)) > 0.5


def test_a_table_that_stands_still_for_as_long_as_its_large_play_is_wide_has_no_ringing() -> None:
    """At most 12 µm of standstill were tried: of 20 mills with a play of 12 to 280 µm ten had a false name."""
    mill = MillParameters(squareness_um_m={"XY": 100.0}).with_axis("X", play_um=140.0)
    made = VirtualMill(mill, seed=1, noise=NoiseParameters(rms_um=0.1))
    tests = [CircularTest("XY", way, 150.0, 1000.0, repeat, "XY") for repeat in (1, 2) for way in ("CCW", "CW")]
    assert named(observe(made.campaign(), made.measure(tests))) == [{"backlash X"}, {"squareness XY"}]
