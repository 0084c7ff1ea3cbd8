"""A twin of tones as a bundle: against the twin's own numbers, and on a slide with a tone it never saw."""

from __future__ import annotations

import cmath
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.kinds.sinusoidal._correction import _response_at, _tone_of, _tone_twin_bundle
from dtwin.kinds.sinusoidal._evidence import ToneCommand, run_loop
from dtwin.kinds.sinusoidal._groups import ToneGroups, groups_of
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning, virtual_slide
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import Twin, chosen_terms, predict_um, twin_of

LIBRARY = Library()
TONES = Grid((5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0), (2.0, 6.0, 11.0))
twin_from = partial(twin_of, name="t", version=1, action="fit", data={})
Measured = tuple[Observations, ToneGroups]


def campaign(folder: pytest.TempPathFactory, truth: str) -> Measured:
    where = folder.mktemp(truth) / "tones"
    simulate_turning(where, grid=TONES, truth=truth)
    opened = open_campaign(where)
    runs = [run for entry in opened.entries for run in opened.read(entry)[0]]
    return observe(opened.campaign, runs), groups_of(runs, "the test")


@pytest.fixture(scope="module")
def linear(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """24 tones of a servo and a structure in series."""
    return campaign(tmp_path_factory, "linear")


@pytest.fixture(scope="module")
def hardening(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    """24 tones of a structure whose joint grows stiffer under load."""
    return campaign(tmp_path_factory, "hardening")


def twin_with(names: list[str], obs: Observations) -> Twin:
    return twin_from(fit(obs, chosen_terms(names, LIBRARY, obs)), obs)


@pytest.mark.parametrize(
    ("truth", "names"),
    [
        ("linear", ["structural_mode", "servo_response"]),
        ("linear", ["tracking_delay", "inertial_compliance", "lead_error"]),
        ("hardening", ["stiffening_joint"]),
    ],
)
def test_the_response_is_what_the_twin_foretells(truth: str, names: list[str], request: pytest.FixtureRequest) -> None:
    obs, groups = request.getfixturevalue(truth)
    twin = twin_with(names, obs)
    frozen = _tone_twin_bundle(twin, obs, groups)
    assert all(t.included for t in frozen.terms)
    graph = frozen.bundle.window_graph
    assert graph is not None
    foretold = predict_um(twin, obs)
    for row in range(obs.n_rows):
        condition = obs.conditions[obs.condition_of[row]].as_dict()
        size = float(condition["amplitude_um"])
        told = _response_at(graph, float(condition["frequency_hz"]), size)
        assert abs(told - _tone_of(foretold, obs, row)) * size < 1e-9


def left_of_a_tone(bundle: object, truth: str, frequency_hz: float, amplitude_um: float) -> float:
    """Return the length of the error of a tone in the last second, um."""
    command = ToneCommand(frequency_hz, lambda t: amplitude_um * np.ones_like(t), np.zeros_like, 9.0)
    record = run_loop(virtual_slide(truth), command, bundle, seed=4)  # type: ignore[arg-type]
    last = record.t_s > record.t_s[-1] - 1.0
    wanted, tool = (
        fit_tone(record.t_s[last], values[last], frequency_hz) for values in (record.command_um, record.tool_um)
    )
    return abs(tool.phasor - wanted.phasor)


@pytest.mark.parametrize(
    ("truth", "names", "share"), [("linear", ["structural_mode"], 0.01), ("hardening", ["stiffening_joint"], 0.1)]
)
def test_a_tone_that_was_never_measured_is_corrected(
    truth: str, names: list[str], share: float, request: pytest.FixtureRequest
) -> None:
    obs, groups = request.getfixturevalue(truth)
    bundle = _tone_twin_bundle(twin_with(names, obs), obs, groups).bundle
    before, after = (left_of_a_tone(given, truth, 37.0, 8.0) for given in (None, bundle))
    assert before > 2.0
    assert after < share * before


def test_outside_of_what_was_measured_nothing_is_corrected(linear: Measured) -> None:
    obs, groups = linear
    bundle = _tone_twin_bundle(twin_with(["structural_mode"], obs), obs, groups).bundle
    for frequency, amplitude in ((46.0, 6.0), (20.0, 12.0), (20.0, 0.7)):
        before, after = (left_of_a_tone(b, "linear", frequency, amplitude) for b in (None, bundle))
        assert after == pytest.approx(before, rel=0.02)


def test_what_is_no_sine_is_left_out_by_name(linear: Measured) -> None:
    obs, groups = linear
    frozen = _tone_twin_bundle(twin_with(["structural_mode", "guideway_friction", "backlash"], obs), obs, groups)
    assert [t.included for t in frozen.terms] == [True, False, False]
    assert all("a sine cannot carry its corners" in t.how for t in frozen.terms[1:])
    with pytest.raises(InputError, match="no effect that offsets"):
        _tone_twin_bundle(twin_with(["guideway_friction"], obs), obs, groups)


def test_a_response_that_swings_between_the_tones_is_refused(linear: Measured) -> None:
    obs, groups = linear
    twin = twin_with(["structural_mode"], obs)
    (term,) = twin.terms
    # A narrow mode halfway between two tones: none of them sees it.
    narrow = replace(term, shape={"frequency_hz": 27.5, "damping": 0.006})
    with pytest.raises(InputError, match="swings between tones that were measured"):
        _tone_twin_bundle(replace(twin, terms=(narrow,)), obs, groups)


def test_the_lag_has_the_sign_of_a_lag(linear: Measured) -> None:
    obs, groups = linear
    graph = _tone_twin_bundle(twin_with(["structural_mode"], obs), obs, groups).bundle.window_graph
    assert graph is not None
    # The tool of this slide goes further and comes later.
    told = _response_at(graph, 40.0, 6.0)
    assert abs(told) > 1.5
    assert cmath.phase(told) < 0.0
