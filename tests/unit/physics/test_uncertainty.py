"""What is noise and what is misfit: floors and stated uncertainties beside effects that are missing."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.acquire.virtual_mill import _standard_tests
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import MillParameters, NoiseParameters
from dtwin.physics.candidates import applicable
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term, set_up
from dtwin.physics.twin import chosen_terms

LIBRARY = Library()
NOISE_UM = 0.1
FAULTY = MillParameters(squareness_um_m={"XY": 30.0}).with_axis("X", play_um=6.0, bow_um=4.0)


def campaign() -> Observations:
    mill = VirtualMill(FAULTY, seed=1, noise=NoiseParameters(NOISE_UM))
    tests = [t for t in _standard_tests(1, planes=("XY",)) if t.radius_mm == 150.0]
    slowest = min(t.feed_mm_min for t in tests)
    return observe(mill.campaign(), mill.measure([t for t in tests if t.feed_mm_min == slowest]))


def squareness(obs: Observations, *names: str) -> Estimate:
    found = fit(obs, chosen_terms(["squareness", *names], LIBRARY, obs)).estimates
    return next(e for e in found if e.effect == "squareness")


def test_what_is_missing_does_not_leak_into_the_noise_floor_through_the_drift() -> None:
    obs = campaign()
    tried, _ = applicable(LIBRARY, obs, [])
    within = [Term(i, i.effect.start_shape) for i in tried if i.effect.within_condition]
    loud = 50.0 * np.cos(2.0 * obs.grid.phase_rad) * np.array([[c.sense] for c in obs.conditions])
    louder = obs.with_y(obs.y_um + loud[obs.condition_of])
    floors = [set_up(o, [], within).noise for o in (obs, louder)]
    assert floors[0] is not None
    assert floors[1] is not None
    assert floors[1].floor_um == pytest.approx(floors[0].floor_um, rel=1e-6)


def test_a_size_is_less_certain_beside_what_the_twin_misses() -> None:
    obs = campaign()
    alone, with_all = squareness(obs), squareness(obs, "backlash:X", "straightness:X")
    assert 2.0 * with_all.uncertainty < alone.uncertainty < 30.0
    for estimate in (alone, with_all):
        assert abs(estimate.value - 30.0) < estimate.uncertainty
