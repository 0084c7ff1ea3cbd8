"""How uncertain a twin's correction is: against corrections of twins whose parameters were moved by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.kinds.sinusoidal._correction import _tone_twin_bundle
from dtwin.kinds.sinusoidal._groups import SENT_FREQUENCY, SENT_RMS, groups_of
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters
from dtwin.physics.fit import Estimate, fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.several_twin import SeenTwin
from dtwin.physics.twin import Twin, chosen_terms, twin_of
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.results import OUTPUT_RMS, Candidate, Scores
from dtwin.train.twin_band import parameter_factor, with_held_out_band
from studies.placement_model import TrainingPlacement, placement_bundle

LIBRARY = Library()


def twin_with(names: list[str], obs: Observations) -> Twin:
    return twin_of(fit(obs, chosen_terms(names, LIBRARY, obs)), obs, name="t", version=1, action="fit", data={})


@pytest.fixture(scope="module")
def circles() -> Observations:
    tests = [
        CircularTest(plane, direction, 100.0, feed, setup=plane)
        for plane in ("XY", "ZX")
        for feed in (1500.0, 4000.0)
        for direction in ("CCW", "CW")
        for _ in range(3)
    ]
    mill = VirtualMill(MillParameters(), samples_per_turn=360)
    return observe(mill.campaign(), mill.measure(tests))


def moved(twin: Twin, number: int, by: float) -> Twin:
    """Return the twin with one parameter elsewhere."""
    estimates = list(twin.estimates)
    estimates[number] = replace(estimates[number], value=estimates[number].value + by)
    return replace(twin, estimates=tuple(estimates))


def by_hand(twin: Twin, obs: Observations, correction: Any) -> Floats:
    """Return the half width from corrections of moved twins, shape (ticks,)."""
    factor = parameter_factor(twin, twin, obs)
    assert factor is not None
    slopes = []
    for number, estimate in enumerate(twin.estimates):
        step = 1e-4 * max(abs(estimate.value), 1.0)
        slopes.append((correction(moved(twin, number, step)) - correction(moved(twin, number, -step))) / (2.0 * step))
    return np.sqrt((np.array(slopes).T @ factor @ factor.T * np.array(slopes).T).sum(axis=1))


def test_the_covariance_has_the_uncertainties_that_the_twin_states(circles: Observations) -> None:
    twin = twin_with(["scale_mismatch", "squareness", "backlash"], circles)
    factor = parameter_factor(twin, twin, circles)
    assert factor is not None
    stated = [e.uncertainty_at_shape for e in twin.estimates]
    assert np.sqrt((factor**2).sum(axis=1)) == pytest.approx(stated, rel=1e-3)


def test_the_band_of_circles_follows_from_the_covariance(circles: Observations) -> None:
    twin = twin_with(["scale_mismatch", "squareness", "backlash"], circles)
    made = twin_bundle(twin, circles).bundle
    rows = ticks_of_circles(made)

    def correction(other: Twin) -> Floats:
        return CompiledBundle(twin_bundle(other, circles).bundle, fades=False).run(rows)[:, 0]

    expected = by_hand(twin, circles, correction)
    compiled = CompiledBundle(made)
    found = [(compiled.tick(row), float(compiled.band_um[0]))[1] for row in rows]
    assert found == pytest.approx(expected.tolist(), rel=0.01)
    assert min(found) > 0.0
    assert np.ptp(found) > 0.2 * np.mean(found)


def ticks_of_circles(bundle: Bundle) -> Floats:
    rng = np.random.default_rng(2)
    n = 40
    given = {
        "path_angle_rad": rng.uniform(-6.0, 6.0, n),
        "direction_sign": rng.choice([-1.0, 1.0], n),
        "commanded_speed_mm_s": rng.uniform(20.0, 60.0, n),
        "radius_mm": np.full(n, 100.0),
        "plane_id": rng.choice([0.0, 2.0], n),
    }
    return np.column_stack([given[name] for name in bundle.tick_inputs])


def test_the_band_of_a_tone_follows_from_the_covariance(tmp_path_factory: pytest.TempPathFactory) -> None:
    where = tmp_path_factory.mktemp("band") / "tones"
    simulate_turning(where, grid=Grid((5.0, 15.0, 25.0, 35.0, 40.0), (2.0, 6.0, 11.0)), truth="linear")
    opened = open_campaign(where)
    runs = [run for entry in opened.entries for run in opened.read(entry)[0]]
    # Each tone measured again: without repeats nobody knows an uncertainty.
    again = [replace(run, meta=replace(run.meta, run_id=f"{run.meta.run_id}-b", repeat=2)) for run in runs]
    rng = np.random.default_rng(5)
    both = [with_noise(run, rng) for run in [*runs, *again]]
    obs, groups = observe(opened.campaign, both), groups_of(runs, "the test")
    twin = twin_with(["structural_mode", "servo_response"], obs)
    made = _tone_twin_bundle(twin, obs, groups).bundle
    window = {SENT_FREQUENCY: 21.0, SENT_RMS: 5.0 / np.sqrt(2.0)}

    def served(bundle: Bundle) -> tuple[Floats, Floats]:
        compiled = CompiledBundle(bundle, fades=False)
        compiled.window(np.array([window.get(name, 1.41) for name in bundle.feature_inputs]))
        out, half = [], []
        # Until the sine has followed the window.
        for tick in range(24_000):
            phase = np.mod(2.0 * np.pi * 21.0 * tick / 8000.0, 2.0 * np.pi)
            row = {"command_phase_rad": phase, "command_amplitude_um": 5.0}
            answer = float(compiled.tick(np.array([row[name] for name in bundle.tick_inputs]))[0])
            if tick >= 23_600:
                out.append(answer)
                half.append(float(compiled.band_um[0]))
        return np.array(out), np.array(half)

    expected = by_hand(twin, obs, lambda other: served(_tone_twin_bundle(other, obs, groups).bundle)[0])
    _, found = served(made)
    assert found == pytest.approx(expected, rel=0.02, abs=1e-6)
    assert found.min() > 0.0


def with_noise(run: Any, rng: np.random.Generator) -> Any:
    tool = np.asarray(run.samples["tool_z_mm"], dtype=float)
    # The slide goes a little further and later each time.
    gain, later = 1.0 + 0.002 * rng.standard_normal(), 1e-5 * rng.standard_normal()
    t = np.asarray(run.samples["t_s"], dtype=float)
    return replace(run, samples=dict(run.samples) | {"tool_z_mm": gain * np.interp(t - later, t, tool)})


def test_without_repeats_there_is_no_band(circles: Observations) -> None:
    twin = twin_with(["scale_mismatch"], circles)
    unknown = [replace(e, uncertainty=float("nan")) for e in twin.estimates]
    blind: tuple[Estimate, ...] = tuple(unknown)
    assert twin_bundle(replace(twin, estimates=blind), circles).bundle.band is None


def small_bundle() -> Bundle:
    g = GraphBuilder()
    angle = g.input("path_angle_rad")
    return create_bundle(
        name="small",
        machine="m",
        model_version=1,
        inputs=[Input("path_angle_rad", "rad", "path", 500.0, "path", -20.0, 20.0)],
        outputs=[Output("radial_um", "path_radial")],
        tick_graph=g.graph({"radial_um": 20.0 * g.apply("sin", angle)}),
    )


def candidate(bundle: Bundle, **numbers: float) -> Candidate:
    scores = {g: Scores(g, 0.9, rms, rms, 0.5, "", 2, 6) for g, rms in (("feed_mm_min", 1.5), ("radius_mm", 2.0))}
    return Candidate("c", "symbolic", True, 3, scores, 1.0, bundle=bundle.to_dict(), numbers=numbers)


def test_a_learned_correction_carries_twice_what_it_left_of_the_worst_group() -> None:
    made = with_held_out_band(candidate(small_bundle()))
    assert made.bundle is not None
    bundle = Bundle.from_dict(dict(made.bundle))
    assert CompiledBundle(bundle).band_um.tolist() == [4.0]
    assert bundle.band is not None
    assert not bundle.band.fades
    assert with_held_out_band(made) is made
    of_waves = with_held_out_band(candidate(small_bundle(), **{OUTPUT_RMS: 0.25}))
    assert of_waves.bundle is not None
    assert CompiledBundle(Bundle.from_dict(dict(of_waves.bundle))).band_um.tolist() == [0.5]


def test_placements_have_the_uncertainty_of_their_means() -> None:
    rng = np.random.default_rng(4)
    errors = {m: rng.normal((30.0, -20.0, 5.0), 2.0, (5, 3)) for m in ("MoveL", "MoveJ")}
    placed = [TrainingPlacement(m, 1000.0, e) for m, rows in errors.items() for e in rows]
    bundle = placement_bundle(placed, "m", feeds_mm_min=(500.0, 2000.0))
    compiled = CompiledBundle(bundle)
    for joint, motion in ((0.0, "MoveL"), (1.0, "MoveJ")):
        row = {"joint_motion": joint, "programmed_feed_mm_min": 1000.0}
        compiled.tick(np.array([row[name] for name in bundle.tick_inputs]))
        # 2.869: Student's t of 4 degrees of freedom at 95.45 %.
        assert compiled.band_um == pytest.approx(2.869 * errors[motion].std(axis=0, ddof=1) / np.sqrt(5), rel=1e-3)
    alone = placement_bundle([p for p in placed if p.motion == "MoveL"] + placed[-1:], "m", feeds_mm_min=(5.0, 9.0))
    assert alone.band is None


def test_of_several_campaigns_the_covariance_is_that_of_all(circles: Observations) -> None:
    twin = twin_with(["scale_mismatch", "squareness", "backlash"], circles)
    free = SeenTwin(**vars(twin), covariance=np.eye(len(twin.estimates)))
    factor = parameter_factor(free, free, circles)
    assert factor is not None
    stated = np.array([e.uncertainty_at_shape for e in twin.estimates])
    assert factor @ factor.T == pytest.approx(np.diag(stated**2))
