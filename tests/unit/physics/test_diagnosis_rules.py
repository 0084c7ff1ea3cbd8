"""Rules of the diagnosis that hold whatever the machine is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.stats import chi2

from dtwin.acquire.virtual_mill import _standard_tests
from dtwin.machines.mill import Moment, VirtualMill
from dtwin.machines.mill_parameters import HeatParameters, MillParameters
from dtwin.physics._score import Score
from dtwin.physics._search import adjusted
from dtwin.physics.candidates import Candidate, independent
from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Diagnosis, Suspect, Verdict
from dtwin.physics.effect import Instance
from dtwin.physics.gridding import N_BINS
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term
from dtwin.physics.twin import chosen_terms
from dtwin.physics.whitening import harmonic_numbers, pure_error
from dtwin.schema import Floats

LIBRARY = Library()
NAMES = (("squareness", "XY"), ("scale_mismatch", "XY"), ("servo_mismatch", "XY"))


def candidates(*columns: Floats) -> list[Candidate]:
    return [
        Candidate(
            Term(Instance(LIBRARY[name], axis)),
            column[:, None] / np.linalg.norm(column),
            1.0,
            Score(0.01, 1.0, 0.1, 20.0),
        )
        for (name, axis), column in zip(NAMES, columns, strict=True)
    ]


def runs_of(n_bins: int) -> Observations:
    return cast(Observations, SimpleNamespace(n_bins=n_bins))


@pytest.mark.parametrize("n_bins", [15, 360])
def test_effects_that_cannot_be_told_apart_count_as_one_test(n_bins: int) -> None:
    one, two, three = np.eye(3)
    apart = adjusted(candidates(one, two, three), runs_of(n_bins))
    alike = adjusted(candidates(one, one, one), runs_of(n_bins))
    assert max(apart.values()) == pytest.approx(0.03, rel=0.15)
    assert max(alike.values()) == pytest.approx(0.01, rel=0.15)


def test_of_shapes_that_share_a_direction_the_best_is_found_by_chance_as_often_as_is_said() -> None:
    turned = np.linspace(0.0, np.pi, 12, endpoint=False)
    shapes = [np.array([[1.0, 0.0], [0.0, np.cos(a)], [0.0, np.sin(a)], [0.0, np.cos(3.0 * a)]]) for a in turned]
    shapes = [np.linalg.qr(shape)[0] for shape in shapes]
    tries = independent(shapes, runs_of(15))
    noise = np.random.default_rng(8).standard_normal((20_000, 4))
    smallest = np.min([chi2.sf(((noise @ shape) ** 2).sum(axis=1), 2) for shape in shapes], axis=0)
    assert np.mean(1.0 - (1.0 - smallest) ** tries <= 0.05) == pytest.approx(0.05, abs=0.008)


def test_the_floor_is_the_noise_whatever_was_fitted_inside_conditions() -> None:
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((36, N_BINS))
    condition_of = np.repeat(np.arange(12), 3)
    moving = np.zeros((36, N_BINS, 2))
    for k in range(2):
        moving[:, k, k] = rng.standard_normal(36)
        moving[:, k, k] /= np.linalg.norm(moving[:, k, k])
    flat = moving.reshape(-1, 2)
    left = noise - (flat @ (flat.T @ noise.ravel())).reshape(noise.shape)
    found = pure_error(left, condition_of, 1.0, moving)
    assert found is not None
    assert found.floor_um == pytest.approx(1.0, rel=0.02)
    # Only the harmonics that were touched are scaled up for the freedom that was spent.
    bare = pure_error(left, condition_of, 1.0)
    assert bare is not None
    untouched = harmonic_numbers(N_BINS) > 20
    assert found.weights[untouched] == pytest.approx(bare.weights[untouched], rel=0.01)
    assert found.dof < bare.dof


def test_heat_times_feed_is_not_called_a_wrong_scale() -> None:
    hot = replace(
        MillParameters(squareness_um_m={"XY": 30.0}).with_axis("X", scale_ppm=25.0), heat=HeatParameters(rise_c=3.0)
    )

    def faster_is_worse(moment: Moment) -> Floats:
        share = moment.test.feed_mm_min / 2000.0
        return 1.2 * moment.rise_c * share * np.cos(2 * moment.angle_rad + 0.4)

    mill = VirtualMill(hot, seed=4, disturbance=faster_is_worse)
    obs = observe(mill.campaign(), mill.measure(_standard_tests(mill.seed, planes=("XY",))))
    found = diagnose(obs, chosen_terms(["scale_mismatch", "squareness"], LIBRARY, obs), LIBRARY)
    assert found.verdict == "unknown_effect", found.headline
    assert "temperature_c" in [channel.name for channel in found.channels]
    assert "temperature_c" in found.headline


@pytest.mark.parametrize(
    ("there", "offered", "crossed", "added"),
    [
        ("backlash Y", "friction", False, False),
        ("backlash X", "friction", False, True),
        ("backlash Y", "friction", True, True),
        ("backlash Y", "reversal_spike", False, True),
        ("friction Y", "backlash", False, False),
    ],
)
def test_what_follows_reversals_stands_beside_its_like_only_where_conditions_tell_them_apart(
    there: str, offered: str, crossed: bool, added: bool
) -> None:
    top = Suspect(offered, "Y", 0.1, 0.9, 0.0, True, None, (), (), 0.5, "")
    found = Diagnosis("missing_effect", "", 1.0, 1.0, 0.1, "repeats", 0.0, found=((top,),))
    campaign = cast(Observations, SimpleNamespace(crossed=crossed))
    assert bool(found.to_add([there], [campaign])) is added


@pytest.mark.parametrize("verdict", ["missing_effect", "need_repeats"])
def test_of_runs_that_were_measured_once_discover_adds_what_they_look_like_and_no_more(verdict: Verdict) -> None:
    """Two arcs both ways: after the first of two faults eleven effects of less than 0.15 µm were added that are not there."""
    top = Suspect("lateral_play", "Y", 0.1, 0.9, 0.0, True, None, (), (), 0.5, "")
    found = Diagnosis(verdict, "", 1.0, 1.0, 0.1, "repeats", 0.0, found=((top,),))
    assert bool(found.to_add(["squareness XY"], [])) is (verdict == "missing_effect")
