"""The thesis's tables of chapter 7: what follows from them, and what does not."""

from __future__ import annotations

import pytest

from studies.published_placements import MOTIONS, recomputed

FOUND = recomputed()


def test_the_figure_of_the_three_circles_follows_but_one_feed_does_not_tell_it_from_zero() -> None:
    xyz = FOUND["xyz"]
    assert xyz["mean_reduction_pct"] == pytest.approx(xyz["printed_mean_pct"], abs=0.05)
    by_feed = {r["feed_mm_min"]: r for r in xyz["rows"]}
    assert abs(by_feed[3000.0]["change_mm"]) < by_feed[3000.0]["half_width_mm"]
    assert abs(by_feed[1000.0]["change_mm"]) > by_feed[1000.0]["half_width_mm"]


@pytest.mark.parametrize("motion", MOTIONS)
def test_mean_sd_is_the_spread_of_three(motion: str) -> None:
    for row in FOUND[motion]["mean_sd"]:
        assert row["spread"] == pytest.approx(row["printed"], abs=1.1e-3)
        assert abs(row["mean"] - row["printed"]) > 8e-3


def test_every_changed_deviation_counts_removed_placements_as_zeros() -> None:
    rows = [row for motion in MOTIONS for row in FOUND[motion]["zeros"]]
    assert len(rows) == 10
    for row in rows:
        assert row["as_zeros"] == pytest.approx(row["printed"], abs=1.1e-3)
        assert row["removed"] < row["printed"] - 0.07


def test_the_offset_that_was_used_is_not_the_one_that_is_printed() -> None:
    assert FOUND["MoveJ"]["offset"]["used"][1] == pytest.approx(-0.6225, abs=1e-3)
    assert FOUND["MoveJ"]["offset"]["printed"][1] == -0.560
    assert FOUND["MoveL"]["offset"]["mean_left"] == pytest.approx([0.0, 0.0], abs=5e-4)


def test_a_mean_over_both_ways_makes_them_mirror_images() -> None:
    centred = FOUND["MoveL"]["centring"]
    assert centred["nc"] == pytest.approx(centred["wc"], abs=1e-9)
    assert centred["removed_pct"] == pytest.approx(centred["printed_removed_pct"], abs=0.3)


def test_the_reductions_as_printed_and_by_the_rule_that_is_stated() -> None:
    line, joint = (FOUND[m]["radial"] for m in MOTIONS)
    assert line["average_pct"]["removed"] == pytest.approx(line["printed_average_pct"], abs=0.3)
    assert joint["average_pct"]["removed"] == pytest.approx(joint["printed_average_pct"], abs=0.1)
    assert line["average_pct"]["all"] == pytest.approx(-75.5, abs=0.5)
    stated = [r["stated_offset_pct"] for r in joint["rows"]]
    assert stated == pytest.approx([91.6, 2.2, 16.1], abs=0.3)


def test_two_readings_are_the_end_of_a_travel() -> None:
    limit = FOUND["MoveL"]["limit"]
    assert len(limit["readings_mm"]) == 2
    assert max(limit["apart_mm"]) < 3e-4
    assert FOUND["MoveJ"]["limit"]["readings_mm"] == []
