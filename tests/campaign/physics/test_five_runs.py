"""Diagnosis of positioning tests as they are measured: five runs, there and back."""

from __future__ import annotations

import re

import numpy as np
import pytest

from dtwin.physics._learned_places import PLACES
from dtwin.physics._local_laws import local_laws
from dtwin.physics._plausible import implausible
from dtwin.physics._score import NoiseLevel, score_test
from dtwin.physics.candidates import Candidates
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term, set_up
from dtwin.physics.twin import chosen_terms
from dtwin.physics.whitening import pure_error
from dtwin.report.twins import diagnosis_text
from dtwin.schema import Campaign, Floats, Run, RunMeta

LIBRARY = Library()
RUNS, TARGETS = 5, 33
AT_MM = np.linspace(0.0, 640.0, TARGETS) + 3.0 * np.sin(np.arange(TARGETS) ** 2)
SHARE = (AT_MM - AT_MM[0]) / np.ptp(AT_MM)
HUMIDITY = np.array([41.0, 47.0, 44.0, 52.0, 43.0])


def campaign(
    error_um: Floats,
    rng: np.random.Generator,
    noise_um: float = 0.25,
    at_mm: Floats = AT_MM,
    celsius: Floats | None = None,
) -> Observations:
    """Return five runs with an error, shape that broadcasts to (runs, 2, targets), and noise."""
    shape = RUNS, 2, len(at_mm)
    error_um = error_um + noise_um * rng.standard_normal(shape)
    # Where a run begins differs more than what it reads.
    error_um = error_um + 2.0 * noise_um * rng.standard_normal((RUNS, 1, 1))
    ways = np.repeat(np.array(["forward", "reverse"], dtype=object), len(at_mm))
    runs = []
    for number in range(RUNS):
        covariates = {
            "humidity_pct": HUMIDITY[number],
            "supply_v": 24.0 + rng.standard_normal(),
            "oil_c": 30.0 + rng.standard_normal(),
            "temperature_c": 20.0 + rng.standard_normal() if celsius is None else float(celsius[number]),
        }
        meta = RunMeta(
            f"r{number}",
            kind="linear",
            condition={"axis": "X"},
            repeat=number + 1,
            started=f"2026-03-02T08:{10 * number:02d}:00+00:00",
            covariates=covariates,
        )
        samples = {
            "position_mm": np.concatenate([at_mm, at_mm[::-1]]),
            "direction": ways,
            "error_um": np.concatenate([error_um[number, 0], error_um[number, 1, ::-1]]),
        }
        runs.append(Run(meta, samples))
    return observe(Campaign("five", "m", kind="linear"), runs)


def test_what_moves_with_a_channel_is_said_to() -> None:
    rng = np.random.default_rng(1)
    moved = (HUMIDITY - HUMIDITY.mean())[:, None, None] / HUMIDITY.std() * (0.3 + SHARE)
    found = diagnose(campaign(1.2 * moved, rng), [], LIBRARY)
    assert found.verdict == "unknown_effect"
    assert [c.name for c in found.channels] == ["humidity_pct"]
    assert "it moves with humidity_pct" in found.headline


def test_channels_that_do_nothing_are_not_named() -> None:
    bow = 2.0 * np.sin(6.0 * SHARE)
    named = [diagnose(campaign(bow, np.random.default_rng(n), 0.1), [], LIBRARY).channels for n in range(10)]
    assert not any(named)


@pytest.mark.parametrize("name", ["thermal_drift", "lead_error", "backlash_taper", "backlash"])
def test_noise_of_five_runs_is_called_significant_as_often_as_stated(name: str) -> None:
    rng = np.random.default_rng(5)
    axis = "" if name == "thermal_drift" else "X"
    term = Term(Instance(LIBRARY[name], axis), LIBRARY[name].start_shape)
    within = LIBRARY[name].within_condition
    p_values = []
    for _ in range(150):
        obs = campaign(np.zeros(1), rng)
        problem = set_up(obs, [], [term] if within else [])
        tested = Candidates(obs, [term.instance]).tested_term(problem, term, NoiseLevel(12.0, 1.0))
        assert tested is not None
        p_values.append(tested.score.p_value)
    # Of 150 a twentieth, 3.3 times the standard error either way.
    assert 0 < np.mean(np.array(p_values) < 0.05) < 0.11


def test_a_zero_that_wanders_between_runs_does_not_hide_what_differs_within_them() -> None:
    backlash = np.array([-0.2, 0.2])[:, None]
    found, inside, named = [], [], []
    for n in range(20):
        # The zero of each run is off by 0.6 µm, the backlash is 0.4 µm.
        obs = campaign(backlash, np.random.default_rng(n), 0.3)
        (size,) = fit(obs, chosen_terms(["backlash:X"], LIBRARY, obs)).estimates
        found.append(abs(size.value - 0.4) / size.uncertainty)
        inside.append(size.uncertainty)
        named.append(diagnose(obs, [], LIBRARY).found)
    # Of 330 readings each way, noise alone leaves ±0.047 µm (k = 2).
    assert np.median(inside) == pytest.approx(2.0 * 0.3 * np.sqrt(2.0 / (RUNS * TARGETS)), rel=0.3)
    assert sum(f > 1.0 for f in found) <= 3
    assert sum("backlash X" in {s.label for group in groups for s in group} for groups in named) >= 18


def test_runs_whose_zero_does_not_wander_are_weighted_as_before() -> None:
    rng = np.random.default_rng(3)
    rows, run_of = rng.standard_normal((10, TARGETS)), np.repeat(np.arange(5), 2)
    made = pure_error(rows, np.tile([0, 1], 5), 1.0, run_of=run_of)
    assert made is not None
    assert made.zero_weight == 1.0
    wandering = rows + 30.0 * rng.standard_normal(5)[run_of, None] * (np.arange(TARGETS) == 0)
    moved = pure_error(wandering, np.tile([0, 1], 5), 1.0, run_of=run_of)
    assert moved is not None
    assert moved.zero_weight < 0.1
    assert moved.weights == pytest.approx(made.weights, rel=0.5)
    # Numbers of runs have a gap where one was left out.
    gap = pure_error(wandering, np.tile([0, 1], 5), 1.0, run_of=run_of + (run_of > 1))
    assert gap is not None
    assert gap.zero_weight == moved.zero_weight


def test_what_the_sweeps_have_in_common_is_no_drift() -> None:
    obs = campaign(3.0 * SHARE, np.random.default_rng(2))
    drift = Term(Instance(LIBRARY["thermal_drift"], ""), LIBRARY["thermal_drift"].start_shape)
    problem = set_up(obs, [], [drift])
    columns = Candidates(obs, [drift.instance]).visible(problem, drift)
    score = score_test(problem, columns, problem.residual, NoiseLevel(), within=True)
    assert score.p_value > 0.05
    assert score.dof == 3.0
    # What is the same in every run says nothing of what differs between them.
    same = np.broadcast_to(SHARE - SHARE.mean(), (2 * RUNS, TARGETS)).reshape(-1, 1)
    alike = same / np.linalg.norm(same)
    assert score_test(problem, alike, problem.residual, NoiseLevel(), within=True).p_value == 1.0


@pytest.mark.parametrize(
    "shape",
    [
        4.0 / (1.0 + ((AT_MM - 210.0) / 30.0) ** 4) * np.ones((2, 1)),
        np.sin(2.0 * np.pi * AT_MM / 137.0) * 4.0 * np.array([[1.0], [-0.6]]),
    ],
    ids=["a dent", "a wave that differs by flank"],
)
def test_what_the_library_does_not_have_gets_no_name(shape: Floats) -> None:
    found = diagnose(campaign(shape, np.random.default_rng(3)), [], LIBRARY)
    assert found.verdict == "unknown_effect", found.headline


def test_what_happens_at_one_place_is_said_and_is_no_curve_and_no_wear() -> None:
    """A door catches the slide past 400 mm, and lets it go 60 mm later on the way back; beside it play and lead."""
    forward, reverse = AT_MM > 400.0, AT_MM > 340.0
    told = 6.0 * SHARE + np.array([[-1.5], [1.5]])
    obs = campaign(told + 5.0 * np.stack([forward, reverse]), np.random.default_rng(4))
    found = diagnose(obs, [], LIBRARY)
    assert {group[0].label for group in found.found} == {"lead_error X", "backlash X"}
    assert found.unresolved is not None
    size_um, there_mm, back_mm = map(float, re.findall(r"[\d.]+(?= µm at| mm)", found.unresolved.words))
    assert found.headline.endswith(found.unresolved.words)
    assert (size_um, there_mm, back_mm) == pytest.approx((5.0, 400.0, 340.0), abs=AT_MM[-1] / TARGETS)
    assert size_um == pytest.approx(5.0, abs=0.3)
    # With it a twin has the true sizes of the others, and lacks nothing.
    (place,) = found.places
    known = [
        Term(Instance(LIBRARY[name], "X"), shape)
        for name, shape in ((place["effect"], place["shape"]), ("lead_error", {}))
    ]
    twin = fit(obs, [*known, *chosen_terms(["backlash"], LIBRARY, obs)])
    sizes = {e.effect: (e.value, e.uncertainty) for e in twin.estimates if e.name != "standstill"}
    ppm = 6.0e3 / np.ptp(AT_MM)
    assert sizes["lead_error"][0] == pytest.approx(ppm, abs=sizes["lead_error"][1])
    assert sizes["backlash"][0] == pytest.approx(3.0, abs=sizes["backlash"][1])
    assert diagnose(obs, twin.terms, LIBRARY).verdict == "nothing_missing"
    one_way = obs.take(np.flatnonzero(obs.sense > 0.0))
    assert {shape["late_of_travel"] for shape in local_laws(one_way)[0].effect.also_tried} == {0.0}


@pytest.mark.parametrize(
    "curve",
    [20.0 * np.abs(SHARE - 0.5) ** 1.5, 3.0 * np.exp(SHARE) * np.sin(4.0 * SHARE**2)],
    ids=["a bow", "a leaning curve"],
)
def test_a_smooth_curve_hides_nothing_beside_it(curve: Floats) -> None:
    both_ways = curve + np.array([[-1.0], [1.0]])
    found = diagnose(campaign(both_ways, np.random.default_rng(3)), [], LIBRARY)
    named = {group[0].label for group in found.found}
    assert {"pitch_error X", "backlash X"} <= named <= {"pitch_error X", "backlash X", "lead_error X"}
    assert found.unresolved is None


@pytest.mark.parametrize("even", [True, False])
def test_a_curve_that_nothing_explains_hides_nothing_of_the_other_parity(even: bool) -> None:
    ways = np.array([[-1.0], [1.0]])
    # A fine graduation, met by every target at another place.
    graduation = 3.0 * np.sin(np.arange(TARGETS) ** 3)
    told = ways if even else 8.0 * SHARE
    found = diagnose(campaign(graduation * (1.0 if even else ways) + told, np.random.default_rng(11)), [], LIBRARY)
    assert [group[0].label for group in found.found] == ["backlash X" if even else "lead_error X"]
    assert found.unresolved is not None
    assert found.unresolved.systematic_rms_um == pytest.approx(3.0 / np.sqrt(2.0), rel=0.15)
    assert f"besides, {found.unresolved.systematic_rms_um:.2g} µm is not resolved" in found.headline


@pytest.mark.parametrize("how", ["knocked", "through stirred air"])
def test_a_run_that_is_spoilt_is_left_out_and_hides_nothing(how: str) -> None:
    rng = np.random.default_rng(12)
    error = np.zeros((RUNS, 2, TARGETS)) + 4.0 * SHARE + np.array([[-1.0], [1.0]])
    # In the order of time: forward, then back from the far end.
    error[2, 0, 20:] += 7.0 * (how == "knocked")
    error[2, 1] += 7.0 * (how == "knocked")
    error[2] += 3.0 * rng.standard_normal((2, TARGETS)) * (how != "knocked")
    found = diagnose(campaign(error, rng), [], LIBRARY)
    assert found.outlier_runs == ("r2",)
    assert {group[0].label for group in found.found} == {"lead_error X", "backlash X"}


def test_a_first_run_that_warms_up_is_not_spoilt() -> None:
    passes = np.arange(2 * RUNS).reshape(RUNS, 2, 1) + np.stack([SHARE, 1.0 - SHARE])
    warmed = 12.0 * SHARE * -np.expm1(-passes / 0.7)
    assert diagnose(campaign(warmed, np.random.default_rng(13), noise_um=0.1), [], LIBRARY).outlier_runs == ()


def test_five_targets_make_a_twin() -> None:
    five_mm = np.array([15.0, 25.2, 35.4, 45.6, 55.8])
    obs = campaign(np.array([[-2.0], [2.0]]), np.random.default_rng(6), at_mm=five_mm)
    assert [[s.label for s in group] for group in diagnose(obs, [], LIBRARY).found] == [["backlash X"]]
    (backlash,) = fit(obs, [Term(Instance(LIBRARY["backlash"], "X"), {})]).estimates
    assert backlash.value == pytest.approx(4.0, abs=backlash.uncertainty)


def test_what_stays_is_told_beside_heat_that_three_runs_do_not_tell() -> None:
    error = 4.0 * SHARE + np.array([[-1.0], [1.0]]) + np.array([0.0, 2.0, 1.0, 9.0, 9.0])[:, None, None] * SHARE
    obs = campaign(error, np.random.default_rng(9), celsius=np.array([20.0, 21.0, 20.5, 20.0, 20.0]))
    found = diagnose(obs.take(np.flatnonzero(obs.run_of < 3)), [], LIBRARY)
    assert {group[0].label for group in found.found} == {"backlash X", "lead_error X"}
    assert found.untestable["thermal_growth X"] == "tested, but 3 runs do not tell what moves between them"


def test_repeats_that_differ_by_more_than_their_readings_are_said_to_and_in_what() -> None:
    rng = np.random.default_rng(1)
    found = diagnose(campaign(3.0 * rng.standard_normal((RUNS, 1, 1)) + 0.0 * SHARE, rng), [], LIBRARY)
    assert found.verdict == "nothing_missing"
    assert "repeats differ by 3.3 µm, neighbouring places of a run by 0.25 µm: most of it is the zero" in found.headline


def test_what_three_runs_do_not_tell_is_one_thing_all_over_the_answer() -> None:
    grown = 5.0 * np.arange(RUNS)[:, None, None] * SHARE
    celsius = np.array([20.0, 21.0, 20.5, 20.0, 20.0])
    obs = campaign(grown, np.random.default_rng(9), celsius=celsius)
    found = diagnose(obs.take(np.flatnonzero(obs.run_of < 3)), [], LIBRARY)
    assert (found.verdict, found.closest) == ("unknown_effect", "warming_growth X")
    assert found.headline.startswith("warming_growth X may be it, which 3 runs do not tell: ")
    told = diagnosis_text("t", found.as_dict())
    assert "not told: warming_growth X: tested, but 3 runs do not tell what moves between them" in told
    assert "not tried" not in told
    assert told.endswith("measure more repeats: they tell whether it is warming_growth X")


def test_growth_that_nobody_logged_is_named() -> None:
    hours = 10.0 / 60.0 * np.arange(RUNS)[:, None, None]
    warmer = 1.0 - np.exp(-hours / 0.3)
    found = diagnose(campaign(12.0 * warmer * SHARE, np.random.default_rng(8)), [], LIBRARY)
    assert "warming_growth X" in [group[0].label for group in found.found]


def test_wear_with_soft_ends_is_wear_and_nothing_else() -> None:
    worn = np.tanh((SHARE - 0.3) / 0.05) - np.tanh((SHARE - 0.6) / 0.05)
    found = diagnose(campaign(-2.0 * worn * np.array([[1.0], [-1.0]]), np.random.default_rng(4)), [], LIBRARY)
    assert [[s.label for s in group] for group in found.found] == [["worn_screw X"]]


@pytest.mark.parametrize(
    ("pitch_mm", "targets", "seed"),
    [
        pytest.param(12.0, 20, 0, id="a screw"),
        pytest.param(12.0, 20, 2, id="a screw, other targets"),
        pytest.param(2.0, 30, 0, id="a graduation of the scale"),
        pytest.param(20.0, 80, 0, id="a screw with several targets in a turn"),
    ],
)
def test_a_wave_of_no_stated_length_is_found_and_is_no_pitch_error(pitch_mm: float, targets: int, seed: int) -> None:
    # Targets moved aside at random: a curve is drawn through the waves, and foretells none of them.
    rng = np.random.default_rng(seed)
    aside_mm = 160.0 / targets
    at = np.linspace(0.0, 500.0, targets) + rng.uniform(-aside_mm, aside_mm, targets)
    wave = 2.0 * np.cos(2.0 * np.pi * at / pitch_mm + seed)
    play = np.array([[-1.5], [1.5]])
    found = diagnose(campaign(wave + play, rng, 0.2, at), [], LIBRARY)
    named = {group[0].label: group[0] for group in found.found}
    assert set(named) == {"backlash X", "periodic_error X"}
    assert named["periodic_error X"].shape["pitch_mm"] == pytest.approx(pitch_mm, rel=0.01)
    even = diagnose(campaign(wave + play, rng, 0.2, np.linspace(0.0, 500.0, targets)), [], LIBRARY)
    assert "periodic_error X" not in {s.label for group in even.found for s in group}


def test_lost_motion_that_is_taken_up_late_is_that_and_the_backlash_has_its_size() -> None:
    # The overrun is 0.5 mm: the first readings after each reversal are off.
    way, since = np.array([[1.0], [-1.0]]), np.stack([AT_MM - AT_MM[0], AT_MM[-1] - AT_MM]) + 0.5
    found = diagnose(campaign(-4.5 * way * (1.0 - 2.0 * np.exp(-since / 8.0)), np.random.default_rng(5)), [], LIBRARY)
    named = {group[0].label: group[0] for group in found.found}
    assert set(named) == {"backlash X", "slow_take_up X"}
    assert named["backlash X"].sizes[0].value == pytest.approx(9.0, abs=0.2)
    assert named["slow_take_up X"].sizes[0].value == pytest.approx(18.0 * np.exp(-0.5 / 8.0), abs=1.5)
    assert named["slow_take_up X"].shape["way_mm"] == pytest.approx(8.0, rel=0.2)


def test_a_hose_that_turns_round_and_tightens_towards_an_end_is_no_wear_and_no_lead_error() -> None:
    way, since = np.array([[1.0], [-1.0]]), np.stack([AT_MM - AT_MM[0], AT_MM[-1] - AT_MM]) + 5.0
    pull = -4.0 * way * (1.0 - 2.0 * np.exp(-since / 60.0)) - 6.0 * np.maximum(0.0, 1.0 - (1.0 - SHARE) / 0.4) ** 5
    found = diagnose(campaign(pull, np.random.default_rng(5)), [], LIBRARY)
    assert {group[0].label for group in found.found} == {"backlash X", "slow_take_up X"}
    (place,) = found.places
    assert place["effect"] == "learned_end"
    end = Term(Instance(PLACES[place["effect"]], "X"), place["shape"])
    assert not implausible([end], np.array([-6.0]), on_circles=False)
    assert "a growth towards an end of -5.9 µm at 640 mm" in found.headline
