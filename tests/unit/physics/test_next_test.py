"""Which test next: what planned tests add to what was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.kinds.registry import kind_named
from dtwin.physics.library import Library
from dtwin.physics.next_test import Knowledge, Made, unclear
from dtwin.physics.observations import Observations
from dtwin.plan_file import planned_document

LIBRARY = Library()
NOISE = {"circular": 0.3, "linear": 0.3}


def circles(plane: str = "XY", feeds: tuple[float, ...] = (1000.0,), repeats: int = 3) -> Observations:
    grid = {"radius_mm": [100.0], "feed_mm_min": list(feeds), "plane": [plane], "repeats": repeats}
    document = {"plan": {"name": "p", "machine": "m"}, "grid": grid}
    return kind_named("circular").foreseen(planned_document(document, "p"))


def sweeps(axis: str) -> Observations:
    kind = kind_named("linear")
    document = next(d for d in kind.proposals("m", {axis: {}}) if d["plan"]["axis"] == axis)
    return kind.foreseen(planned_document(document, "p"))


def made(obs: Observations) -> Observations:
    """Return a test as measured: noise and nothing else."""
    noise = 0.3 * np.random.default_rng(1).standard_normal(obs.y_um.shape)
    return replace(obs, y_um=noise * obs.mask)


def knowledge(measured: list[Observations], planned: list[Observations]) -> Knowledge:
    return Knowledge([Made(made(obs)) for obs in measured], planned, LIBRARY, NOISE)


def untold(measured: list[Observations], planned: list[Observations]) -> set[str]:
    return {unknown.label for unknown in knowledge(measured, planned).untold}


def test_the_same_test_again_tells_little_and_another_plane_tells_much() -> None:
    known = knowledge([circles()], [circles(), circles("ZX")])
    first = knowledge([], [circles()]).worth(0).bits
    again, other = known.worth(0).bits, known.worth(1).bits
    assert 0.0 < again < 0.1 * first
    assert other > 5.0 * again


def test_more_repeats_and_more_feeds_never_tell_less() -> None:
    known = knowledge([], [circles(), circles(repeats=6), circles(feeds=(500.0, 1000.0, 4000.0))])
    once, twice, feeds = (known.worth(n).bits for n in range(3))
    assert once < twice < feeds


def test_noise_costs_bits() -> None:
    quiet, loud = (Knowledge([], [circles()], LIBRARY, {"circular": um}).worth(0).bits for um in (0.1, 10.0))
    assert loud < quiet


def test_circles_tell_the_difference_of_two_scales_and_a_laser_on_one_axis_tells_both() -> None:
    # At one feed an axis that gives way to its acceleration looks like a wrong scale.
    bar, laser = circles(feeds=(500.0, 1500.0, 4000.0)), sweeps("X")
    assert {"scale X", "scale Y"} <= untold([bar], [laser])
    assert not {"scale X", "scale Y"} & untold([bar, laser], [])
    gains = {gain.unknown.label for gain in knowledge([bar], [laser]).worth(0).told}
    assert {"scale X", "scale Y"} <= gains


def test_a_gain_is_a_smaller_uncertainty_that_gets_below_half_of_the_ordinary_size() -> None:
    told = knowledge([], [circles()]).worth(0).told
    assert told
    assert all(gain.after < gain.before and gain.after <= 0.5 * gain.unknown.typical for gain in told)


def test_what_a_plane_does_not_move_stays_untold() -> None:
    told = {gain.unknown.axis for gain in knowledge([], [circles("XY"), circles("ZX")]).worth(0).told}
    assert "Z" not in told
    assert {"X", "Y"} <= told


@pytest.mark.filterwarnings("ignore")
def test_equal_repeats_are_taken_to_have_the_usual_noise() -> None:
    exact = Knowledge([Made(circles())], [circles()], LIBRARY, NOISE)
    assert np.isfinite(exact.worth(0).bits)


def test_what_was_found_and_is_not_clear_counts_in_full_and_as_large_as_it_may_be() -> None:
    obs, group = made(circles()), ("straightness X", "instrument_artefact")
    radii = {"plan": {"name": "p", "machine": "m"}, "grid": {"radius_mm": [50.0, 100.0], "feed_mm_min": [1000.0]}}
    radii["grid"] |= {"plane": ["XY"], "repeats": 3}
    other = kind_named("circular").foreseen(planned_document(radii, "p"))
    nothing, found = (Knowledge([Made(obs, groups)], [other], LIBRARY, NOISE).worth(0) for groups in ((), (group,)))
    assert found.bits > nothing.bits + 3.0
    assert {"straightness X (bow at 100 mm)", "instrument artefact (sine)"} <= {
        gain.unknown.label for gain in found.told
    }


def test_a_group_is_clear_when_another_test_names_a_member_alone() -> None:
    tests = [[["backlash X", "friction X"], ["squareness YZ"]], [["backlash X"]], [["squareness XY", "friction X"]]]
    seen = [circles(), circles("ZX"), circles()]
    assert unclear(tests, seen, LIBRARY) == [[], [], [["squareness XY", "friction X"]]]


def test_a_bow_in_another_plane_leaves_open_what_three_lobes_are() -> None:
    lobes, bow = ["instrument_artefact", "straightness X", "straightness Y"], ["straightness X"]
    assert unclear([[lobes], [bow]], [circles(), circles("ZX")], LIBRARY) == [[lobes], []]
    assert unclear([[lobes], [bow]], [circles(), circles()], LIBRARY) == [[], []]


def test_a_difference_of_two_axes_is_open_until_the_cause_is_told_of_one_of_them() -> None:
    differs = [[["scale_mismatch ZX"]], [["scale_mismatch XY"]]]
    obs = [made(circles("ZX")), made(circles("XY"))]
    assert unclear([*differs, [["backlash X"]]], [*obs, sweeps("X")], LIBRARY) == [*differs, []]
    assert unclear([*differs, [["lead_error Y"]]], [*obs, sweeps("Y")], LIBRARY) == [differs[0], [], []]
    measured = [Made(one, groups) for one, groups in zip(obs, differs, strict=True)]
    known = Knowledge(measured, [sweeps(axis) for axis in "XYZ"], LIBRARY, NOISE)
    worth = {axis: known.worth(number).bits for number, axis in enumerate("XYZ")}
    assert worth["X"] > max(worth["Y"], worth["Z"]) + 0.5
