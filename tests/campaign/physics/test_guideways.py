"""Guideways that are bent otherwise than in an arc, and in each direction otherwise, and axes that grow unwatched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mill_and_laser import circular_tests

from dtwin.acquire.virtual_mill import _standard_tests
from dtwin.machines.mill import Disturbance, Moment, VirtualMill
from dtwin.machines.mill_parameters import MillParameters, NoiseParameters
from dtwin.physics._grading import _beside_unknown
from dtwin.physics._laws import LawTest
from dtwin.physics.candidates import applicable
from dtwin.physics.diagnose import diagnose
from dtwin.physics.experiment import detectable
from dtwin.physics.fit import Fit, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import SETUP_COLUMNS, Observations, observe
from dtwin.physics.several import fit_several
from dtwin.physics.twin import chosen_terms, twin_of
from dtwin.report.twins import parameter_table
from dtwin.schema import Floats, Plane

LIBRARY = Library()
PLANES: tuple[Plane, ...] = ("XY", "YZ", "ZX")


def measured(mill: MillParameters, disturbance: Disturbance, planes: tuple[Plane, ...] = ("XY",)) -> Observations:
    machine = VirtualMill(mill, seed=4, disturbance=disturbance)
    return observe(machine.campaign(), machine.measure(_standard_tests(4, planes=planes)))


def labels(obs: Observations) -> set[str]:
    return {s.label for group in diagnose(obs, [], LIBRARY).found for s in group}


def unwatched(obs: Observations) -> Observations:
    """Return the same runs without the temperatures that were logged."""
    columns = [{k: v for k, v in c.items() if k == "time_h" or k.startswith(SETUP_COLUMNS)} for c in obs.columns]
    return replace(obs, columns=tuple(columns))


def bump(moment: Moment) -> Floats:
    """A hump of the guideway of X, some 60 mm wide, that lifts Y."""
    x_mm = moment.test.radius_mm * np.cos(moment.angle_rad)
    return np.asarray(9.0 * np.exp(-(((x_mm - 25.0) / 60.0) ** 2)) * np.sin(moment.angle_rad))


def test_a_hump_of_a_guideway_is_named_and_hides_nothing_else() -> None:
    obs = measured(MillParameters().with_axis("Y", play_um=4.0), bump)
    found = diagnose(obs, [], LIBRARY)
    named = {s.label for group in found.found for s in group}
    assert {"guideway_shape X", "backlash Y"} <= named
    assert "instrument_artefact" not in named
    # What polynomials of the fifth order leave of a hump.
    assert found.unresolved is None or found.unresolved.systematic_rms_um < 0.15 * obs.rms(obs.y_um)


def test_squareness_is_of_the_lines_of_the_axes_and_not_of_the_slope_in_the_middle() -> None:
    obs = measured(MillParameters(squareness_um_m={"XY": 30.0}), bump)
    effects = ["squareness", "straightness:X", "guideway_shape:X"]
    found = fit(obs, chosen_terms(effects, LIBRARY, obs))
    x_mm = np.linspace(-1.0, 1.0, 2001) * obs.radius_mm.max()
    line_um_m = 1e3 * np.polyfit(x_mm, 9.0 * np.exp(-(((x_mm - 25.0) / 60.0) ** 2)), 1)[0]
    (squareness,) = [e for e in found.estimates if e.effect == "squareness"]
    assert squareness.value == pytest.approx(30.0 - line_um_m, abs=2.0)


def rails(moment: Moment) -> Floats:
    """Screws every 130 mm draw the rail of X to its bed by 3 µm."""
    x_mm = moment.test.radius_mm * np.cos(moment.angle_rad)
    return np.asarray(3.0 * np.cos(2.0 * np.pi * (x_mm - 40.0) / 130.0) * np.sin(moment.angle_rad))


def test_a_wave_of_a_guideway_is_named_with_its_length_and_hides_nothing_else() -> None:
    obs = measured(MillParameters(squareness_um_m={"XY": 30.0}).with_axis("Y", play_um=4.0), rails)
    found = [group[0] for group in diagnose(obs, [], LIBRARY).found]
    assert {f.label for f in found} == {"guideway_wave X", "squareness XY", "backlash Y"}
    wave = fit(obs, chosen_terms(["squareness", "backlash:Y", "guideway_wave:X"], LIBRARY, obs))
    assert wave.terms[-1].shape["wave_mm"] == pytest.approx(130.0, rel=0.01)
    size = {e.name: e.value for e in wave.estimates}
    assert np.hypot(size["cosine"], size["sine"]) == pytest.approx(3.0, abs=0.2)


def test_a_wave_of_a_guideway_is_not_tried_on_circles_of_one_radius() -> None:
    obs = measured(MillParameters(), rails)
    alone = obs.take(np.flatnonzero(obs.radius_mm == obs.radius_mm[0]))
    assert applicable(LIBRARY, alone, [])[1]["guideway_wave X"] == "the radius was not changed"
    assert "guideway_wave X" not in applicable(LIBRARY, obs, [])[1]


def edge(moment: Moment) -> Floats:
    """A step of X in Y's way, 10 mm long, as of a cover that catches at one place."""
    x_mm = moment.test.radius_mm * np.cos(moment.angle_rad)
    return np.asarray(8.0 / (1.0 + np.exp(-(x_mm - 20.0) / 2.5)) * np.sin(moment.angle_rad))


@pytest.mark.long
@pytest.mark.parametrize("repeats", [2, 3])
def test_a_curve_that_only_follows_a_step_is_no_shape_of_a_guideway(repeats: int) -> None:
    # Of two repeats the play seemed to differ by direction, and was not told.
    machine = VirtualMill(MillParameters().with_axis("Y", play_um=6.0), seed=4, disturbance=edge)
    tests = [test for test in _standard_tests(4, planes=("XY",)) if test.repeat <= repeats]
    found = diagnose(observe(machine.campaign(), machine.measure(tests)), [], LIBRARY)
    named = [{s.label for s in group} for group in found.found]
    assert {"backlash Y"} in named
    assert not any("guideway_shape X" in group for group in named)
    assert found.unresolved is not None


def test_beside_something_unknown_a_law_of_direction_is_broken_by_what_happens_one_way_only() -> None:
    perhaps = _beside_unknown(LawTest("direction", 1e-9, 0.47, 0.04))
    assert not perhaps.broken
    assert not perhaps.confirmed
    assert _beside_unknown(LawTest("direction", 1e-9, 0.95, 0.04)).broken
    for holds in (LawTest("direction", 1.0, 0.02, 0.04), LawTest("direction", 1e-9, 0.31, 0.04)):
        assert _beside_unknown(holds) == holds


def lengthening(moment: Moment) -> Floats:
    """The bar becomes longer by 20 µm an hour while it is held."""
    return np.full(moment.angle_rad.shape, 20.0 * moment.time_h)


def test_a_bar_that_becomes_longer_in_six_runs_is_a_drift_and_no_growth_of_two_axes() -> None:
    machine = VirtualMill(MillParameters(), seed=4, noise=NoiseParameters(rms_um=0.1), disturbance=lengthening)
    obs = unwatched(observe(machine.campaign(), machine.measure(circular_tests())))
    groups = [{s.label for s in group} for group in diagnose(obs, [], LIBRARY).found]
    assert {"thermal_drift"} in groups
    assert not any(label.startswith("warming_growth") for group in groups for label in group)


def test_an_arc_is_named_as_such_alone() -> None:
    assert labels(measured(MillParameters().with_axis("X", bow_um=4.0), lambda m: 0.0 * m.angle_rad)) == {
        "straightness X"
    }


def sideways(moment: Moment) -> Floats:
    """X bends towards Y by 6 µm at 100 mm, and towards Z not at all."""
    if moment.test.plane != "XY":
        return np.asarray(0.0 * moment.angle_rad)
    x_mm = moment.test.radius_mm * np.cos(moment.angle_rad)
    return np.asarray(6.0 * (x_mm / 100.0) ** 2 * np.sin(moment.angle_rad))


@pytest.fixture(scope="module")
def three_planes() -> Observations:
    return measured(MillParameters(), sideways, PLANES)


def fitted(obs: Observations) -> Fit:
    return fit(obs, chosen_terms(["straightness:X"], LIBRARY, obs))


def test_a_guideway_bends_in_each_direction_by_itself(three_planes: Observations) -> None:
    values = {e.name: e.value for e in fitted(three_planes).estimates}
    assert values["bow_at_100_mm"] == pytest.approx(6.0, abs=0.3)
    assert values["second_axis_bow_at_100_mm"] == pytest.approx(0.0, abs=0.3)


def test_a_plane_tells_nothing_of_the_direction_that_it_does_not_show(three_planes: Observations) -> None:
    obs = three_planes.take(np.flatnonzero([meta.plane == "ZX" for meta in three_planes.runs]))
    told = {e.name: e.identifiable for e in fitted(obs).estimates}
    assert told == {"bow_at_100_mm": False, "second_axis_bow_at_100_mm": True}
    (seen,) = [d for d in detectable(obs, LIBRARY, noise_um=0.5) if d.label == "straightness X"]
    assert np.isfinite(seen.amplitude)


def test_tests_in_different_planes_tell_a_direction_each(three_planes: Observations) -> None:
    apart = [three_planes.take(np.flatnonzero([m.plane == p for m in three_planes.runs])) for p in ("XY", "ZX")]
    first, second = (replace(o, campaign=replace(o.campaign, name=n)) for o, n in zip(apart, "ab", strict=True))
    both = fit_several([first, second], chosen_terms(["straightness:X"], LIBRARY, first), LIBRARY).estimates
    assert [e.identifiable for e in both] == [True, True]
    assert [e.value for e in both] == pytest.approx([6.0, 0.0], abs=0.3)


def test_what_a_plane_does_not_show_is_not_spoken_of(three_planes: Observations) -> None:
    obs = three_planes.take(np.flatnonzero([meta.plane == "XY" for meta in three_planes.runs]))
    (group,) = diagnose(obs, [], LIBRARY).found
    assert [size.name for size in group[0].sizes] == ["bow_at_100_mm"]
    twin = twin_of(fitted(obs), obs, name="t", version=1, action="fit", data={})
    assert [row[1] for row in parameter_table(twin).rows] == ["bow at 100 mm"]


def test_a_version_from_before_there_were_two_directions_says_what_it_said(three_planes: Observations) -> None:
    twin = twin_of(fitted(three_planes), three_planes, name="t", version=1, action="fit", data={})
    (first, _) = twin.estimates
    assert replace(twin, estimates=(first,)).values(twin.terms[0]).tolist() == [first.value, first.value]


def warming(moment: Moment) -> Floats:
    """The scale of X fades towards 40 um/m with a time constant of 20 min, and nothing is logged of it."""
    grown = 0.04 * moment.test.radius_mm * (1.0 - np.exp(-3.0 * moment.time_h))
    return np.asarray(grown * np.cos(moment.angle_rad) ** 2)


def test_an_axis_that_grows_while_nobody_logs_why_is_named() -> None:
    obs = measured(MillParameters(squareness_um_m={"XY": 30.0}), warming)
    found = diagnose(unwatched(obs), [], LIBRARY)
    groups = [{s.label for s in group} for group in found.found]
    assert {"squareness XY"} in groups
    assert any("warming_growth X" in group for group in groups)
