"""Three circles at three heights: the commanded path, and what the bar reads of it."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.links import layout
from dtwin.machines.cobot import VirtualCobot
from studies.machines.joint_program import Waypoint, drive_program
from studies.machines.placing_cell import DATUM_MM, PLACE_MM
from studies.machines.sphere_path import HEIGHT_MM, RADIUS_MM, sphere_plan, sphere_run

FEED = 6000.0


@pytest.fixture(scope="module")
def cobot() -> VirtualCobot:
    return VirtualCobot(seed=2)


def test_the_bar_stays_at_its_length_and_the_circles_at_their_heights(cobot: VirtualCobot) -> None:
    plan = sphere_plan(cobot, FEED)
    ticks = cobot.run(plan)
    section = ticks.states[:, layout.SEGMENT_ID].astype(int)
    spoke = ticks.truths[:, :3] - cobot.centre_mm(RADIUS_MM)
    inside = (section > 0) & (section < section.max())
    np.testing.assert_allclose(np.linalg.norm(spoke[inside], axis=1), RADIUS_MM, atol=1e-9)
    heights = {tuple(np.round(spoke[section == k, 2], 6)[[0, -1]]) for k in (1, 4, 6, 9, 11, 14)}
    assert heights == {(-HEIGHT_MM,) * 2, (0.0, 0.0), (HEIGHT_MM,) * 2}
    assert section.max() == 15
    speed = np.linalg.norm(np.diff(ticks.truths[:, :3], axis=0), axis=1) * 500.0
    assert speed[inside[1:]].max() == pytest.approx(FEED / 60.0, rel=0.04)
    jumps = speed[1:] - speed[:-1]
    assert np.abs(jumps).max() < 5.0, "the path jumps"
    stops = np.diff(section)[inside[1:] & (np.diff(section) > 0)]
    assert len(stops) >= 13


def test_one_mounting_reads_alike_and_another_differs_by_its_centre(cobot: VirtualCobot) -> None:
    ticks = cobot.run(sphere_plan(cobot, FEED))
    first, again, other = (
        sphere_run(cobot, FEED, ticks, setup=setup, repeat=repeat) for setup, repeat in (("a", 1), ("a", 2), ("b", 1))
    )
    assert np.abs(np.diff(first.azimuth_rad)).max() < 0.02
    assert first.azimuth_rad[0] - first.azimuth_rad[-1] == pytest.approx(8.0 * np.pi, abs=1e-3)
    n = min(len(first.deviation_um), len(again.deviation_um), len(other.deviation_um))
    repeats = np.std(first.deviation_um[:n] - again.deviation_um[:n])
    mountings = np.std(first.deviation_um[:n] - other.deviation_um[:n])
    assert repeats < 20.0 < mountings


def test_a_program_in_joint_space_ends_where_the_straight_one_ends(cobot: VirtualCobot) -> None:
    stops = [
        Waypoint("clear", PLACE_MM + np.array([150.0, 60.0, 90.0])),
        Waypoint("above", PLACE_MM + np.array([0.0, 0.0, 15.0])),
        Waypoint("place", PLACE_MM, 0.5),
    ]
    ends = {
        motion: drive_program(cobot, stops, motion=motion, feed_mm_min=3000.0, datum_mm=DATUM_MM)
        for motion in ("MoveL", "MoveJ")
    }
    (line, line_s), (joint, joint_s) = ends["MoveL"], ends["MoveJ"]
    assert line_s == pytest.approx(joint_s)
    assert np.linalg.norm(line[-1] - joint[-1]) < 0.02
    assert 0.0 < np.linalg.norm(line[-1] - PLACE_MM) < 1.0
    with pytest.raises(InputError, match="no such motion"):
        drive_program(cobot, stops, motion="MoveC", feed_mm_min=3000.0, datum_mm=DATUM_MM)
