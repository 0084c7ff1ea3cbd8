"""Equations of tones: exponents, held-out scores, dead terms, the loop's own stability, two rates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from noiseless_instruments import NOISELESS

from dtwin.errors import InputError
from dtwin.features.windows import StreamingWindow
from dtwin.kinds.sinusoidal._bundle import AMPLITUDE, PHASE, SERVO_HZ
from dtwin.kinds.sinusoidal._candidates import narx_candidate, searched_candidate
from dtwin.kinds.sinusoidal._evidence import ToneCommand, run_loop
from dtwin.kinds.sinusoidal._gates import _AnsweredWindow
from dtwin.kinds.sinusoidal._groups import HEARD, ToneGroups, exponent, feature_findings, groups_of
from dtwin.kinds.sinusoidal._simulate import PUBLISHED, QUICK, Grid, virtual_runs, virtual_slide
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.symbolic import Found
from studies.bicuspid import trial
from studies.turning_fit import FittedTones, fitted_tones


def measured(truth: str = "linear", grid: Grid = QUICK, **more: object) -> ToneGroups:
    return groups_of(list(virtual_runs(grid, virtual_slide(truth), 3, **more)), truth)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def groups() -> ToneGroups:
    return measured()


@pytest.fixture(scope="module")
def made(groups: ToneGroups) -> FittedTones:
    return fitted_tones("virtual-turning", groups, "two-modes", "inverse", 0)


def failed(made: FittedTones) -> set[str]:
    return {v.gate for v in made.verdicts if not v.passed}


def test_a_linear_slide_gives_the_exponent_one_and_a_hardening_joint_less() -> None:
    clean = measured(instruments=NOISELESS)
    assert exponent(clean.feature("rms"), clean.beyond_encoder_um) == pytest.approx(1.0, abs=0.02)
    hard = measured("hardening")
    assert 0.7 < exponent(hard.feature("rms"), hard.amplitude_error_um) < 0.9


def test_constants_are_named_and_noise_is_left_out(groups: ToneGroups) -> None:
    told = "\n".join(feature_findings(groups))
    assert "crest_factor is a dead constant on clean sines: 1.4" in told
    assert "rms is a dead constant" not in told
    assert "tell the same" in told
    quiet = measured(grid=Grid((1.0, 40.0), (1.0, 11.0)))
    assert (quiet.heard >= HEARD).tolist() == [False, False, True, True]


def test_held_out_targets_and_every_gate_pass(made: FittedTones) -> None:
    assert failed(made) == set()
    scores, numbers = made.candidate.scores, made.candidate.numbers
    for group in ("frequency_hz", "amplitude_um"):
        assert scores[group].r2 > 0.98
        assert scores[group].mae_um < 0.1
        assert numbers[f"leave_{group}_out.phase_r2"] > 0.95
    assert scores["frequency_hz"].n_groups == len(QUICK.frequencies_hz)


def test_the_printed_forms_have_dead_terms(groups: ToneGroups) -> None:
    assert "no dead term" in failed(fitted_tones("m", groups, "printed-form", "inverse", 0))


def test_the_free_search_keeps_to_three_features(groups: ToneGroups) -> None:
    made = fitted_tones("m", groups, "symbolic", "inverse", 1)
    assert not failed(made) - {"stable on its own correction"}
    assert made.candidate.front


def test_the_free_search_is_repeated_without_what_it_predicts(groups: ToneGroups) -> None:
    class Engine:
        """Knows one formula, and remembers the targets that it was shown."""

        name = "stub"

        def __init__(self) -> None:
            self.shown: list[np.ndarray] = []

        def search(self, inputs: Mapping[str, np.ndarray], target: np.ndarray, seed: int) -> list[Found]:
            self.shown.append(target)
            rms = next(name for name in inputs if name.endswith("_rms_g"))
            return [Found(f"2.0 * {rms}", 3, 0.0)]

    engine = Engine()
    searched_candidate(groups, "m", engine, 1, {})
    left_out = [len(np.unique(groups.label(name))) for name in ("frequency_hz", "amplitude_um")]
    assert len(engine.shown) == 2 * (1 + sum(left_out))
    assert [len(shown) for shown in engine.shown[:2]] == [groups.n, groups.n]
    assert max(len(shown) for shown in engine.shown[2:]) < groups.n


def test_a_correction_that_feeds_on_itself_is_refused(groups: ToneGroups) -> None:
    for action in ("subtract", "printed"):
        made = fitted_tones("m", groups, "two-modes", action, 0)  # type: ignore[arg-type]
        assert failed(made) == {"stable on its own correction"}
        assert 0.7 < made.candidate.numbers["spectral_radius"] < 1.0


def test_narx_predicts_left_out_tones_from_the_command(groups: ToneGroups) -> None:
    found = narx_candidate(groups)
    assert found.scores["frequency_hz"].mae_um < 0.1
    assert not found.promotable


def window_of(groups: ToneGroups, place: int, bundle: Bundle) -> dict[str, float]:
    assert bundle.window is not None
    values = groups.columns | {"sent_z_rms_um": groups.sent_rms_um}
    return {name: float(values[name][place]) for name in bundle.feature_inputs}


def test_the_window_tells_gain_and_lag_and_the_tick_makes_the_exact_vector(
    groups: ToneGroups, made: FittedTones
) -> None:
    place = int(np.flatnonzero((groups.frequency_hz == 40.0) & (groups.amplitude_um == 5.0))[0])
    gain = 1.0 + groups.amplitude_error_um[place] / 5.0
    lag = np.radians(groups.phase_error_deg[place])
    sent = _AnsweredWindow(made.bundle).sent(window_of(groups, place, made.bundle), 5.0)
    # What is sent, times what the slide makes of it, is what was wanted.
    assert abs(sent * gain * np.exp(-1j * lag) - 1.0) < 0.01
    # Amplitude error times a sine is not the error: a seventh of it is left.
    printed = fitted_tones("m", groups, "two-modes", "printed", 0).bundle
    error = gain * np.exp(-1j * lag) - 1.0
    told = 1.0 - _AnsweredWindow(printed).sent(window_of(groups, place, printed), 5.0)
    assert abs(told - error) > 0.1 * abs(error)


def test_the_sine_moves_in_over_a_quarter_of_a_second(groups: ToneGroups, made: FittedTones) -> None:
    bundle = made.bundle
    compiled = CompiledBundle(bundle)
    features = window_of(groups, -1, bundle)
    compiled.window(np.array([features[n] for n in bundle.feature_inputs]))
    t = np.arange(round(2.0 * SERVO_HZ)) / SERVO_HZ
    given = {PHASE: np.mod(2 * np.pi * 40.0 * t, 2 * np.pi), AMPLITUDE: np.full(len(t), 11.0)}
    out = compiled.run(np.column_stack([given[n] for n in bundle.tick_inputs]))[:, 0]
    assert np.max(np.abs(out[:40])) < 0.2
    assert np.max(np.abs(out[-400:])) > 4.0
    assert np.max(np.abs(np.diff(out))) < 2 * np.pi * 40.0 / SERVO_HZ * 1.1 * np.max(np.abs(out))


def test_the_stream_gives_the_bits_of_the_training(made: FittedTones) -> None:
    runs = list(virtual_runs(Grid((30.0, 35.0), (5.0, 6.0)), virtual_slide("linear"), 3))
    run, trained = runs[0], groups_of(runs, "here").features[0]
    window = made.bundle.window
    assert window is not None
    stream = StreamingWindow(window)
    sent = 1000.0 * run.samples["cmd_z_mm"]
    block = np.stack([sent, run.signals[0].columns["tool_z_g"]])
    found = [stream.push(part).values for part in np.split(block[:, :5000], [7, 1234, 4999], axis=1)]
    served = np.concatenate([f for f in found if len(f)])[0]
    assert served[1].tobytes() == trained.tobytes()


def test_surfaces_at_40_and_5_hz(made: FittedTones) -> None:
    found, surfaces = trial(made.bundle, frequencies_hz=(5.0, 40.0))
    low, high = found["rows"]
    assert high["reduction"]["form_um"] > 0.85
    assert high["reduction"]["phase_deg"] > 0.93
    assert found["worse"] == []
    assert low["reduction"]["rms_um"] > 0.0
    assert (low["alarm"], high["alarm"], high["saturated_ticks"]) == ("", "", 0)
    assert surfaces[40.0][0].x_mm.max() == pytest.approx(0.5, abs=1e-3)


def test_a_loop_that_diverges_is_released_with_its_reason(groups: ToneGroups) -> None:
    bundle = fitted_tones("m", groups, "two-modes", "subtract", 0).bundle
    row = trial(bundle, frequencies_hz=(40.0,))[0]["rows"][0]
    assert row["alarm"]


def test_what_is_below_the_noise_is_not_corrected(made: FittedTones) -> None:
    # One micrometre at 1 Hz is below the noise: the box refuses, nothing is added.
    quiet = ToneCommand(1.0, lambda t: np.ones_like(t), np.zeros_like, 8.0)
    record = run_loop(virtual_slide("linear"), quiet, made.bundle, seed=1)
    assert np.ptp(record.correction_um) == 0.0
    assert set(record.guard) == {"outside_box"}


def test_too_small_a_grid_is_refused() -> None:
    few = measured(grid=Grid((1.0, 5.0, 40.0), (1.0, 2.0, 9.0)))
    with pytest.raises(InputError, match="too few tones"):
        fitted_tones("m", few, "two-modes", "inverse", 0)
    with pytest.raises(InputError, match="no run can be learned from"):
        groups_of([], "here")
    assert len(PUBLISHED.groups) == 99
