from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.programs import gcode, urscript
from dtwin.errors import InputError
from dtwin.plan import advice, duration_s, expand, read_plan, training_plan

GRID = {"radius_mm": [100.0], "feed_mm_min": [2000.0, 4000.0], "plane": ["XY"], "repeats": 2}


def document(**grid: object) -> dict[str, object]:
    return {"plan": {"name": "p", "machine": "m"}, "grid": GRID | grid}


def test_the_training_plan_is_81_tests_of_an_hour() -> None:
    plan = training_plan()
    assert (len(plan.tests), plan.n_runs) == (81, 162)
    moving, total = duration_s(plan)
    assert 55 * 60 < moving < 65 * 60 < total


def test_feeds_are_crossed_and_shuffled_inside_each_setup() -> None:
    plan = training_plan()
    setups = [test.setup for test in plan.tests]
    assert len(set(setups)) == 9
    # A set-up is done once: its tests stand together.
    assert len([1 for a, b in itertools.pairwise(setups) if a != b]) == 8
    for setup in set(setups):
        inside = [(t.feed_mm_min, t.repeat) for t in plan.tests if t.setup == setup]
        assert len(inside) == 9
        assert inside != sorted(inside)
    assert training_plan(seed=1) == plan
    assert training_plan(seed=2) != plan


def test_a_plan_says_what_it_cannot_tell() -> None:
    poor = expand(document(repeats=1, directions=["CCW"], feed_mm_min=[2000.0]), "x")
    assert {f.code for f in advice(poor)} == {"plan.no_repeats", "plan.one_direction", "plan.one_feed"}
    assert {f.code for f in advice(training_plan())} == {"plan.radius_law"}


@pytest.mark.parametrize(
    "grid",
    [
        {"radius_mm": [-1.0]},
        {"radius_mm": [9999.0]},
        {"radius_mm": [1e-300]},
        {"feed_mm_min": ["fast"]},
        {"feed_mm_min": [float("nan")]},
        {"plane": ["QQ"]},
        {"repeats": 0},
        {"repeats": 2.5},
        {"directions": ["UP"]},
        {"directions": [["CCW"]]},
        {"directions": ["CW", "CW"]},
        {"radius_mm": [100.0, 100]},
        {"plane": ["ZX", "XZ"]},
        {"repeat": 3},
        {"radius_mm": []},
        {"feed_mm_min": list(np.arange(1.0, 9999.0)), "repeats": 900},
    ],
)
def test_impossible_plans_are_refused_before_anything_moves(grid: dict[str, object]) -> None:
    with pytest.raises(InputError):
        expand(document(**grid), "x")


@pytest.mark.parametrize(
    "changed",
    [
        {"plan": {"name": "p", "machine": "m", "seed": -1}},
        {"plan": {"name": "p", "machine": "m", "seed": "one"}},
        {"limits": {"max_radius_mm": "wide"}},
        {"limits": 5},
        {"limits": {"max_feed_mm_min": True}},
        {"limits": {"max_feed": 500.0}},
        {"limit": {"max_feed_mm_min": 500.0}},
        {"plan": {"name": "p", "machine": "m", "calibrated_length": "no"}},
    ],
)
def test_a_setting_that_is_none_is_refused(changed: dict[str, object]) -> None:
    with pytest.raises(InputError, match=r"seed|max_|\[limits\]|unknown setting|true or false"):
        expand(document() | changed, "x")


def test_a_broken_plan_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text("[plan\n")
    with pytest.raises(InputError, match="not valid TOML"):
        read_plan(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_plan(tmp_path / "nothing.toml")


def arc_points(program: str, letters: str) -> list[tuple[float, float]]:
    a, b = letters
    return [(float(m[1]), float(m[2])) for m in re.finditer(rf"G[123] {a}(-?[\d.]+) {b}(-?[\d.]+)", program)]


@pytest.mark.parametrize(("plane", "letters"), [("XY", "XY"), ("YZ", "YZ"), ("ZX", "ZX")])
def test_programs_stay_on_the_circle(plane: str, letters: str) -> None:
    test = expand(document(plane=[plane]), "x").tests[0]
    radii = [np.hypot(*point) for point in arc_points(gcode(test), letters)]
    assert set(np.round(radii, 3)) == {100.0, 101.5}
    assert gcode(test).count("G3 ") == gcode(test).count("G2 ") > 0
    # X of a lathe may be a diameter: its circle would be an ellipse.
    assert ("diameter programming off" in gcode(test)) is (plane == "ZX")
    # Upright, the spindle stays above the table.
    assert plane == "XY" or min(point[letters.index("Z")] for point in arc_points(gcode(test), letters)) > -10.0
    script = urscript(test)
    assert script.startswith("def t001():")
    heights = [float(height) for height in re.findall(r"p\[[^,]+,[^,]+,([^,]+)", script.partition("movel")[2])]
    assert plane == "XY" or min(heights) > 0.065
    assert script.count("movec") == (8 if plane == "XY" else 2)
