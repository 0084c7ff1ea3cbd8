"""Tests of one machine by a ball bar and a laser: names, parts, contradictions, and coverage of what they agree on."""

from __future__ import annotations

import mill_and_laser
import numpy as np
import pytest

from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.joint import Joint, MachineTest, Settled, Size, _said, joint
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations

LIBRARY = Library()


def judged(name: str, obs: Observations) -> MachineTest:
    return MachineTest(name, "2026-01-01", obs, diagnose(obs, [], LIBRARY))


def circles(mill: MillParameters, seed: int = 1) -> MachineTest:
    return judged("bar", mill_and_laser.circles(mill, seed))


def laser(axis: str, lead_ppm: float, lost_um: float, seed: int = 1) -> MachineTest:
    return judged(f"laser-{axis}", mill_and_laser.laser(axis, lead_ppm, lost_um, seed))


def settled_with(found: Joint, label: str) -> Settled:
    return next(s for s in found.settled if label in s.group)


def test_a_scale_that_one_circle_cannot_tell_from_dynamics_is_named_by_the_laser() -> None:
    bar = circles(MillParameters().with_axis("X", scale_ppm=30.0))
    assert any("scale_mismatch XY" in {s.label for s in group} and len(group) > 1 for group in bar.found.found)
    found = joint([bar, laser("X", 30.0, 0.0), laser("Y", 0.0, 0.0)], LIBRARY)
    assert settled_with(found, "scale_mismatch XY").left == ("scale_mismatch XY",)


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


def test_one_axis_of_two_settles_nothing_of_their_difference() -> None:
    bar = circles(MillParameters().with_axis("X", scale_ppm=30.0))
    assert joint([bar, laser("X", 30.0, 0.0)], LIBRARY).settled == ()


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
        # Less than three standard uncertainties apart, and bounded below half of what it must be.
        ((1.36, 0.82), (0.14, 0.21), "refuted"),
        ((1.36, 0.82), (0.14, 0.60), None),
        ((0.70, 0.82), (0.05, 0.21), None),
        ((3.00, 0.30), (1.00, 0.21), "is a part"),
        ((3.00, 0.30), (-1.00, 0.21), "refuted"),
    ],
)
def test_what_another_test_bounds_is_no_cause(
    here: tuple[float, float], there: tuple[float, float], said: str | None
) -> None:
    assert _said(Size("bar", "", "thermal_growth", *here), Size("laser", "", "thermal_growth", *there)) == said


def test_growth_of_two_axes_together_is_judged_together() -> None:
    # A bar that drifts by little: each axis alone would grow by less than can be seen, both would explain it.
    mill = MillParameters(bar_growth_um_h=-1.337)
    bar = judged("bar", mill_and_laser.circles(mill, 1, radii_mm=(50.0, 100.0, 150.0)))
    lasers = [judged(f"laser-{axis}", mill_and_laser.warmed(axis, 1)) for axis in "XY"]
    settled = settled_with(joint([bar, *lasers], LIBRARY), "thermal_growth X")
    assert settled.left == ("thermal_drift",)
    assert {"thermal_growth X", "thermal_growth Y"} <= {j.label for j in settled.judged if j.said == "refuted"}


def test_a_long_wave_of_an_axis_is_no_shape_of_a_guideway_alone() -> None:
    mill = MillParameters().with_axis("X", pitch_error_um=0.3, pitch_mm=220.0, pitch_phase_rad=0.5)
    found = circles(mill).found.found
    assert [{s.label for s in group} for group in found] == [{"guideway_shape Y", "cyclic_error X"}]
