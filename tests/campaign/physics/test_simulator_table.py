"""Every identifiable parameter of the published simulated machines is found again."""

from __future__ import annotations

import itertools
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import Fit, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms
from dtwin.schema import Campaign

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks" / "hidden_effect"))
from published import measured

TABLE = Path(__file__).parents[3] / "data" / "published" / "ballbar_simulator.toml"
LADDER = [
    ["scale_mismatch"],
    ["squareness"],
    ["backlash", "backlash_taper"],
    ["straightness"],
    ["servo_mismatch"],
    ["lateral_play", "lateral_play_taper"],
    ["cyclic_error", "cyclic_error_by_direction"],
    ["reversal_spike"],
]
UNITS = 0.2
SERVO_MS = 0.01


@cache
def machine(name: str) -> dict[str, Any]:
    return dict(tomllib.loads(TABLE.read_text(encoding="utf-8"))[name])


@cache
def observed(name: str) -> Observations:
    feeds = (300.0, machine(name)["feed"], 6000.0)
    runs = measured(machine(name), feeds, "time", 0.1, np.random.default_rng(1))
    return observe(Campaign("simulated", name), runs)


def value(found: Fit, effect: str, axis: str, parameter: str) -> float:
    (estimate,) = [e for e in found.estimates if (e.effect, e.axis, e.name) == (effect, axis, parameter)]
    assert estimate.identifiable
    return estimate.value


def assert_play_and_bow(found: Fit, truth: dict[str, Any], *, lateral: bool = True) -> None:
    radius = float(truth["radius"])
    for axis in "XY":
        low = axis.lower()
        bow = value(found, "straightness", axis, "bow_at_100_mm") * (radius / 100) ** 2
        assert bow == pytest.approx(truth[f"straightness_{low}"], abs=UNITS)
        for effect in ("backlash", "lateral_play") if lateral else ("backlash",):
            name_of = "backlash" if effect == "backlash" else "play"
            middle = value(found, effect, axis, name_of)
            taper = value(found, f"{effect}_taper", axis, "change_per_100_mm") * radius / 100
            first, second = truth[f"{effect}_{low}"]
            assert middle + taper == pytest.approx(first, abs=UNITS)
            assert middle - taper == pytest.approx(second, abs=UNITS)


@pytest.mark.parametrize("name", ["sim1", "sim2", "sim3"])
def test_parameters_are_found_within_the_published_tolerance(name: str) -> None:
    truth, obs = machine(name), observed(name)
    library = Library()
    terms = chosen_terms([effect for rung in LADDER for effect in rung], library, obs)
    found = fit(obs, terms)
    assert found.noise_floor_um < 0.1
    assert found.rms_after_um < 1.5 * found.noise_floor_um

    scale = value(found, "scale_mismatch", "XY", "scale")
    assert scale == pytest.approx(truth["scale_x"] - truth["scale_y"], abs=UNITS)
    square = value(found, "squareness", "XY", "squareness")
    assert square == pytest.approx(truth["squareness"], abs=UNITS)
    delay = value(found, "servo_mismatch", "XY", "delay")
    assert delay == pytest.approx(truth["servo_mismatch"], abs=SERVO_MS)
    assert_play_and_bow(found, truth)
    for axis in "XY":
        low = axis.lower()
        ends = truth[f"reversal_spike_{low}"]
        for end, which in zip(ends, ("positive", "negative"), strict=True):
            height = value(found, "reversal_spike", axis, f"height_at_{which}_end")
            assert height == pytest.approx(end, abs=UNITS)
        even = [value(found, "cyclic_error", axis, part) for part in ("cosine", "sine")]
        odd = [value(found, "cyclic_error_by_direction", axis, p) for p in ("cosine", "sine")]
        right, left = truth[f"cyclic_{low}"]
        assert 2 * np.hypot(*(np.add(even, odd))) == pytest.approx(right, abs=UNITS)
        assert 2 * np.hypot(*(np.subtract(even, odd))) == pytest.approx(left, abs=UNITS)


def test_the_machine_without_screw_and_lateral_errors() -> None:
    truth, obs = machine("sim5"), observed("sim5")
    terms = chosen_terms([effect for rung in LADDER[:4] for effect in rung], Library(), obs)
    found = fit(obs, terms)
    assert found.rms_after_um < 1.5 * found.noise_floor_um
    scale = value(found, "scale_mismatch", "XY", "scale")
    assert scale == pytest.approx(truth["scale_x"] - truth["scale_y"], abs=UNITS)
    square = value(found, "squareness", "XY", "squareness")
    assert square == pytest.approx(truth["squareness"], abs=UNITS)
    assert_play_and_bow(found, truth, lateral=False)


def test_the_error_falls_from_rung_to_rung_down_to_the_floor() -> None:
    obs, library = observed("sim1"), Library()
    effects: list[str] = []
    errors = [fit(obs, []).rms_after_um]
    for rung in LADDER:
        effects += rung
        errors.append(fit(obs, chosen_terms(effects, library, obs)).rms_after_um)
    assert all(after <= before * 1.0001 for before, after in itertools.pairwise(errors))
    assert errors[-1] < 0.05 * errors[0]


def test_from_nothing_simple_effects_are_named_and_not_what_imitates_several_of_them() -> None:
    # A pitch error and guideways of any shape do what scale, squareness and bows do, and 14 µm hide what is a thirtieth of it.
    groups = [{suspect.label for suspect in group} for group in diagnose(observed("sim1"), [], Library()).found]
    named = set().union(*groups)
    assert named >= {"scale_mismatch XY", "squareness XY", "servo_mismatch XY", "reversal_spike X", "reversal_spike Y"}
    assert not any(label.startswith(("guideway_shape", "pitch_error")) for label in named)
    assert len(groups) >= 15
