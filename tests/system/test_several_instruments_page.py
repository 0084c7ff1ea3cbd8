"""The page on tests by several instruments, followed literally, with a mill whose scale of X is off and that has lost motion."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from laser_axis import write_laser
from mill_and_laser import measured
from one_cobot import write_circles as write_cobot_circles
from one_cobot import write_drift, write_poses
from shown_commands import blocks, follow, here, page

from dtwin.acquire.virtual_mill import write_runs
from dtwin.machines.mill_parameters import MillParameters

pytestmark = pytest.mark.system

SCALE_PPM, PLAY_UM = 60.0, 4.0


def test_the_page_is_followed(tmp_path: Path) -> None:
    mill = MillParameters().with_axis("X", scale_ppm=SCALE_PPM, play_um=PLAY_UM)
    campaign, runs = measured(mill, 4)
    (tmp_path / "ball-bar").mkdir()
    write_runs(tmp_path / "ball-bar", replace(campaign, name="ball-bar", machine="mill-7"), runs)
    for axis in "xy":
        write_laser(
            tmp_path / f"laser-{axis}",
            "mill-7",
            axis.upper(),
            SCALE_PPM if axis == "x" else 0.0,
            PLAY_UM if axis == "x" else 0.0,
        )
    campaign, runs = measured(mill.with_axis("X", scale_ppm=SCALE_PPM, play_um=0.5), 5)
    (tmp_path / "ball-bar-2").mkdir()
    write_runs(tmp_path / "ball-bar-2", replace(campaign, name="ball-bar-2", machine="mill-7"), runs)
    write_laser(tmp_path / "laser-x-2", "mill-7", "X", SCALE_PPM, 0.5)
    off_mrad = np.array([0.0, 0.6, -0.3, 0.0, 0.2, 0.0])
    write_cobot_circles(tmp_path / "circles", off_mrad, day="2026-03-01", growth_um_m_k=15.0, n=60)
    write_poses(tmp_path / "tracker", off_mrad, day="2026-03-05", growth_um_m_k=15.0, n=80)
    write_drift(tmp_path / "room", day="2026-03-07")
    said = follow(blocks(page("docs/how-to/several-instruments.md")), tmp_path, here)
    printed = {" ".join(command.split()[1:3]): text for command, text in said}
    assert "it is scale mismatch XY (scale mismatch XY agrees: laser-x, laser-y" in printed["machine diagnose"]
    assert "add lead_error X" in printed["twin discover"]
    shown = {command.split()[3]: text for command, text in said if command.startswith("dtwin twin show")}
    assert "joint_offset 3" in shown["cobot-1"].partition("one cause in several campaigns")[2].partition("\n\n")[0]
    sizes = {(e["effect"], e["axis"]): e for e in json.loads(shown["mill-7"])["effects"]}
    for (name, axis), true in {("lead_error", "X"): SCALE_PPM, ("backlash", "X"): PLAY_UM}.items():
        assert abs(sizes[name, axis]["value"] - true) <= 1.5 * sizes[name, axis]["k2"] < 0.1 * true
    every = [text for command, text in said if command.startswith("dtwin machine next")]
    assert ["linear" in text for text in every] == [True, False, False]
    assert (tmp_path / "next.toml").is_file()
