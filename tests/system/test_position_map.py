"""The printed equation of the thesis's mill is a map of positions, and the tool says so."""

from __future__ import annotations

import json

import pytest

from studies.position_map import position_map
from studies.report.position_map import position_map_text

pytestmark = pytest.mark.system


@pytest.mark.parametrize("seed", [0, 2])
def test_what_it_learned_is_the_mounting(seed: int) -> None:
    found = json.loads(json.dumps(position_map(seed)))
    # Values of the printed equation, worked out by hand from its text.
    assert [round(p["error_um"], 1) for p in found["at"]] == [-1.8, 7.6, 16.3, 7.6]
    shares = found["influence"]
    assert shares["path angle"] > 0.8
    assert shares["accelerometer RMS, g"] < 1e-6
    same, anew = found["sessions"]
    assert same["r2"] > 0.99
    assert anew["after_um"] > 10 * anew["mounting_out_before_um"]
    # The machine's own error does carry over.
    assert anew["mounting_out_after_um"] < 0.6 * anew["mounting_out_before_um"]
    assert found["verdict"].startswith("a position map of one session")
    assert "bar mounted anew" in position_map_text(found)
    robot = found["robot"]
    # Worked out by hand: only the program's form and the rewritten one can be a robot's error.
    printed, rewritten, ran = (row for row in robot["at"].values())
    assert printed[1] == pytest.approx(-356.2, abs=0.1)
    assert (rewritten[1], ran[1]) == pytest.approx((0.0336, 0.0360), abs=1e-4)
    assert robot["decided_r2"] > 0.95
    assert robot["held_against_bar_r2"] < 0.1
    assert "which corrected the robot" in position_map_text(found)
