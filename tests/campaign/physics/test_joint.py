"""Tests of one machine by a ball bar and a laser: names, parts, contradictions, and coverage of what they agree on."""

from __future__ import annotations

from dataclasses import replace

import mill_and_laser
import numpy as np
import pytest

from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.joint import Joint, MachineTest, _said, _Settled, _Size, joint
from dtwin.physics.library import Library
from dtwin.physics.machine_terms import machine_terms, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import fit_several

LIBRARY = Library()


def judged(name: str, obs: Observations) -> MachineTest:
    return MachineTest(name, "2026-01-01", obs, diagnose(obs, [], LIBRARY))


def circles(mill: MillParameters, seed: int = 1) -> MachineTest:
    return judged("bar", mill_and_laser.circles(mill, seed))


def laser(axis: str, lead_ppm: float, lost_um: float, seed: int = 1) -> MachineTest:
    return judged(f"laser-{axis}", mill_and_laser.laser(axis, lead_ppm, lost_um, seed))


def test_a_sound_mill_gets_no_name_by_three_repeats() -> None:
    """Eight mills to which noise alone gave names while four degrees of freedom were taken for sixteen."""
    named = [circles(MillParameters(), seed).found.found for seed in (12, 14, 25, 195, 200, 201, 203, 204)]
    assert sum(map(bool, named)) <= 2


def test_friction_that_a_servo_follows_is_no_lost_motion_beside_a_spike() -> None:
    """Four mills of which each had a second or a false name while the answer of the drive was a mere delay."""
    for friction, seed in ((20.0, 3), (40.0, 2), (40.0, 3), (60.0, 1)):
        mill = MillParameters().with_axis("X", friction_mm_s2=friction)
        found = diagnose(
            mill_and_laser.circles(mill, seed, radii_mm=(50.0,), feeds_mm_min=(1000.0, 3000.0)), [], LIBRARY
        )
        (group,) = found.found
        assert group[0].label == "friction X"


def settled_with(found: Joint, label: str) -> _Settled:
    return next(s for s in found.settled if label in s.group)


def test_a_scale_that_one_circle_cannot_tell_from_dynamics_is_named_by_the_laser() -> None:
    bar = circles(MillParameters().with_axis("X", scale_ppm=30.0))
    assert any("scale_mismatch XY" in {s.label for s in group} and len(group) > 1 for group in bar.found.found)
    found = joint([bar, laser("X", 30.0, 0.0), laser("Y", 0.0, 0.0)], LIBRARY)
    assert settled_with(found, "scale_mismatch XY").left == ("scale_mismatch XY",)


def test_the_scale_of_an_axis_without_a_laser_follows_from_circles_and_that_of_the_other() -> None:
    mill = MillParameters().with_axis("X", scale_ppm=30.0).with_axis("Y", scale_ppm=-20.0)
    bar = judged("bar", mill_and_laser.circles(mill, 1, radii_mm=(50.0, 150.0), feeds_mm_min=(1000.0, 3000.0)))
    (x,) = (one for one in joint([bar, laser("Y", -20.0, 0.0)], LIBRARY).shared if one.axis == "X")
    assert (x.cause, x.apart) == ("scale", ())
    assert abs(x.value - 30.0) < x.uncertainty < 5.0
    assert joint([bar], LIBRARY).shared == ()


def test_dynamics_that_look_like_a_scale_are_not_called_one() -> None:
    bar = circles(MillParameters().with_axis("X", mode_share=0.6))
    settled = settled_with(joint([bar, laser("X", 0.0, 0.0), laser("Y", 0.0, 0.0)], LIBRARY), "scale_mismatch XY")
    assert "scale_mismatch XY" not in settled.left
    assert {"inertial_compliance", "structural_resonance X"} <= set(settled.left)


@pytest.mark.parametrize(("lost_um", "said"), [(0.0, "refuted"), (3.0, "is a part")])
def test_friction_is_told_from_backlash(lost_um: float, said: str) -> None:
    bar = circles(MillParameters().with_axis("X", friction_mm_s2=300.0, play_um=lost_um))
    settled = settled_with(joint([bar, laser("X", 0.0, lost_um)], LIBRARY), "friction X")
    assert "backlash X" not in settled.left
    assert "friction X" in settled.left
    judged = next(j for j in settled.judged if j.label == "backlash X")
    assert judged.said == said
    assert judged.there.value == pytest.approx(lost_um, abs=judged.there.uncertainty)


def test_lost_motion_of_two_axes_falls_with_that_of_one() -> None:
    # Little friction of X: what it leaves at both axes is lost motion of X and Y together, of Y alone it is not.
    bar = circles(MillParameters().with_axis("X", friction_mm_s2=0.8545), seed=102)
    assert {"friction X", "backlash X", "backlash Y"} <= {s.label for group in bar.found.found for s in group}
    settled = settled_with(joint([bar, laser("X", 0.0, 0.0, 210), laser("Y", 0.0, 0.0, 211)], LIBRARY), "friction X")
    assert settled.left == ("friction X",)


def test_what_a_wider_test_of_the_kind_names_alone_is_no_group_of_the_narrow_one() -> None:
    mill = MillParameters(cup_lobe_um=1.0, cup_phase_rad=2.0)
    wide = mill_and_laser.circles(mill, 2, radii_mm=(50.0, 150.0))
    tests = [circles(mill), judged("wide", wide)]
    assert [[s.label for s in group] for group in tests[1].found.found] == [["instrument_artefact"]]
    settled = settled_with(joint(tests, LIBRARY), "instrument_artefact")
    assert {"straightness X", "straightness Y"} <= {*settled.group}
    assert settled.left == ("instrument_artefact",)
    # Equal conditions tell nothing.
    assert not joint([tests[0], judged("again", mill_and_laser.circles(mill, 3))], LIBRARY).settled


def test_one_axis_of_two_settles_nothing_of_their_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    bar = circles(MillParameters().with_axis("X", scale_ppm=30.0))
    fitted: list[Observations] = []
    monkeypatch.setattr("dtwin.physics.joint.fit", lambda obs, terms: fitted.append(obs) or fit(obs, terms))
    assert joint([bar, laser("X", 30.0, 0.0)], LIBRARY).settled == ()
    # What no other test sees is not sized: groups have up to some 60 names.
    assert not any(obs is bar.obs for obs in fitted)


def test_tests_that_contradict_each_other_are_named() -> None:
    bar = circles(MillParameters().with_axis("X", play_um=6.0))
    (shared,) = joint([bar, laser("X", 0.0, 1.0)], LIBRARY).shared
    ((first, second, by, spread),) = shared.apart
    assert {first, second} == {"bar", "laser-X"}
    assert abs(by) == pytest.approx(5.0, abs=spread)
    assert np.isnan(shared.value)


def test_what_tests_agree_on_is_known_better_than_by_either() -> None:
    bar = circles(MillParameters().with_axis("X", play_um=4.0))
    (shared,) = joint([bar, laser("X", 0.0, 4.0)], LIBRARY).shared
    assert shared.apart == ()
    assert shared.value == pytest.approx(4.0, abs=2.0 * shared.uncertainty)
    assert shared.uncertainty < min(size.uncertainty for size in shared.sizes)


def test_a_lead_that_the_ball_bar_does_not_see_contradicts_it() -> None:
    bar = circles(MillParameters().with_axis("X", play_um=4.0))
    found = joint([bar, laser("X", 25.0, 4.0), laser("Y", 0.0, 0.0)], LIBRARY)
    scale = next(s for s in found.shared if (s.cause, s.axis) == ("scale", "XY"))
    assert len(scale.apart) == 1


@pytest.mark.parametrize(
    ("here", "there", "said"),
    [
        ((1.36, 0.82), (1.30, 0.21), "agrees"),
        # Less than three standard uncertainties apart, and twenty times likelier without it; then thirteen times.
        ((1.36, 0.82), (0.14, 0.21), "refuted"),
        ((1.36, 0.82), (0.14, 0.80), None),
        ((0.70, 0.82), (0.05, 0.21), None),
        ((3.00, 0.30), (1.00, 0.21), "is a part"),
        ((3.00, 0.30), (-1.00, 0.21), "refuted"),
    ],
)
def test_what_another_test_bounds_is_no_cause(
    here: tuple[float, float], there: tuple[float, float], said: str | None
) -> None:
    assert _said(_Size("bar", "", "thermal_growth", *here), _Size("laser", "", "thermal_growth", *there)) == said


def test_growth_of_two_axes_together_is_judged_together() -> None:
    # A bar that drifts by little: each axis alone would grow by less than can be seen, both would explain it.
    mill = MillParameters(bar_growth_um_h=-1.337)
    bar = judged("bar", mill_and_laser.circles(mill, 1, radii_mm=(50.0, 100.0, 150.0)))
    lasers = [judged(f"laser-{axis}", mill_and_laser.warmed(axis, 1)) for axis in "XY"]
    settled = settled_with(joint([bar, *lasers], LIBRARY), "thermal_growth X")
    assert settled.left == ("thermal_drift",)
    assert {"thermal_growth X", "thermal_growth Y"} <= {j.label for j in settled.judged if j.said == "refuted"}


@pytest.mark.parametrize("radii_mm", [(100.0,), (50.0, 100.0, 150.0)])
@pytest.mark.parametrize(("axis", "wave_mm"), [("X", 220.0), ("Y", 150.0), ("X", 370.0)])
def test_a_wave_longer_than_the_circles_is_a_pitch_error(
    axis: str, wave_mm: float, radii_mm: tuple[float, ...]
) -> None:
    mill = MillParameters().with_axis(axis, pitch_error_um=2.0, pitch_mm=wave_mm, pitch_phase_rad=0.5)
    found = judged("bar", mill_and_laser.circles(mill, radii_mm=radii_mm)).found
    assert [{s.label for s in group} for group in found.found] == [{f"pitch_error {axis}"}]
    assert found.unresolved is None or found.unresolved.systematic_rms_um < 0.05


def test_a_pitch_error_is_one_name_for_a_ball_bar_and_a_laser() -> None:
    mill = MillParameters().with_axis("X", pitch_error_um=2.0, pitch_mm=220.0, pitch_phase_rad=0.5)
    laser = mill_and_laser.warmed("X", 1, wave=(2.0, 220.0, 0.5))
    bar = mill_and_laser.circles(mill)
    twin = fit_several([bar, laser], machine_terms(["pitch_error:X"], LIBRARY, [bar, laser]), LIBRARY)
    (size,) = twin.estimates
    assert size.name == "amplitude"
    assert size.value == pytest.approx(2.0, abs=0.1)


def test_circles_take_the_pitch_that_a_laser_states() -> None:
    mill = MillParameters().with_axis("X", pitch_error_um=2.0, pitch_mm=6.0)
    bar, laser = mill_and_laser.circles(mill), mill_and_laser.laser("X", 0.0, 0.0)
    laser = replace(laser, campaign=replace(laser.campaign, machine_geometry={"screw_pitch_mm": 6.0}))
    (term,) = machine_terms(["screw_error:X"], LIBRARY, [bar, laser])
    seen = seen_by(term, bar, LIBRARY)
    assert seen is not None
    assert (seen.label, seen.shape["pitch_mm"]) == ("cyclic_error X", 6.0)
    assert fit(bar, [seen]).rms_after_um < 0.2


def test_a_wave_that_targets_do_not_show_is_fitted_as_the_shortest_that_they_do() -> None:
    # Circles may propose it for a laser that reads every 20 mm.
    laser = mill_and_laser.laser("X", 0.0, 0.0)
    instance = Instance(LIBRARY["pitch_error"], "X")
    short = fit(laser, [Term(instance, {"wave_mm": 25.0, "half_waves": 0.0})], refine=False)
    shown = fit(laser, [Term(instance, {"wave_mm": 40.0, "half_waves": 0.0})], refine=False)
    assert short.rms_after_um == pytest.approx(shown.rms_after_um)


def test_a_curve_that_a_laser_shows_is_a_wave_to_circles() -> None:
    bar = mill_and_laser.circles(MillParameters())
    instance = Instance(LIBRARY["pitch_error"], "X")
    curve, wave = ({"wave_mm": 200.0, "half_waves": n} for n in (7.0, 0.0))
    assert np.array_equal(bar.regressors(instance, curve), bar.regressors(instance, wave))
    assert bar.regressors(instance, wave).any()
