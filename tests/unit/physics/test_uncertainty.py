"""What is noise and what is misfit: floors and stated uncertainties beside effects that are missing."""

from __future__ import annotations

import pytest

from dtwin.acquire.virtual_mill import standard_tests
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_noise import NoiseParameters
from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms

LIBRARY = Library()
NOISE_UM = 0.1
FAULTY = MillParameters(squareness_um_m={"XY": 30.0}).with_axis("X", play_um=6.0, bow_um=4.0)


def campaign() -> Observations:
    mill = VirtualMill(FAULTY, seed=1, noise=NoiseParameters(NOISE_UM))
    tests = [t for t in standard_tests(1, planes=("XY",)) if t.radius_mm == 150.0]
    slowest = min(t.feed_mm_min for t in tests)
    return observe(mill.campaign(), mill.measure([t for t in tests if t.feed_mm_min == slowest]))


def squareness(obs: Observations, *names: str) -> Estimate:
    found = fit(obs, chosen_terms(["squareness", *names], LIBRARY, obs)).estimates
    return next(e for e in found if e.effect == "squareness")


def test_what_is_missing_does_not_leak_into_the_noise_floor_through_the_drift() -> None:
    found = diagnose(campaign(), [], LIBRARY)
    assert found.residual_rms_um > 10.0 * NOISE_UM
    assert found.noise_floor_um == pytest.approx(NOISE_UM, rel=0.5)


def test_a_size_is_less_certain_beside_what_the_twin_misses() -> None:
    obs = campaign()
    alone, with_all = squareness(obs), squareness(obs, "backlash:X", "straightness:X")
    assert alone.uncertainty > 3.0 * with_all.uncertainty
    for estimate in (alone, with_all):
        assert abs(estimate.value - 30.0) < estimate.uncertainty
