"""The uncertainty of a correction in its bundle: carried, proved, shown, and what fades by it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bundles import path_bundle, sensor_bundle

from dtwin.errors import GateRefusal, InputError
from dtwin.links import layout
from dtwin.serve.band import COVARIANCE, HELD_OUT, Band, constant_band, fade, require_fading
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle, _checksum
from dtwin.serve.bundle_file import load_bundle, save_bundle
from dtwin.serve.decision import Decision
from dtwin.serve.interface import Output
from dtwin.serve.proof import prove
from dtwin.serve.runtime import CompiledBundle


def growing_band(name: str = "radial_error_um") -> Band:
    """Half a um at standstill, a um more at 100 mm/s."""
    g = GraphBuilder()
    return Band(COVARIANCE, g.graph({name: 0.5 + 0.01 * g.input("commanded_speed_mm_s")}))


def faded(value: float, half: float) -> float:
    out = np.array([value])
    fade(out, np.array([half]))
    return float(out[0])


def test_a_correction_beyond_its_band_stays_and_a_small_one_goes_without_a_step() -> None:
    sizes = np.linspace(0.0, 3.0, 3001)
    kept = np.array([faded(s, 1.0) for s in sizes])
    assert np.array_equal(kept[sizes >= 1.0], sizes[sizes >= 1.0])
    assert np.abs(kept[sizes < 0.05]).max() < 1e-3
    assert np.all(np.diff(kept) > 0.0)
    # No step in the value, none in the slope.
    slope = np.diff(kept) / np.diff(sizes)
    assert np.abs(np.diff(slope)).max() < 0.01
    assert (sizes - kept).max() == pytest.approx(0.26, abs=0.005)
    assert faded(-0.5, 1.0) == -faded(0.5, 1.0)


@pytest.mark.parametrize(("half", "left"), [(0.0, 0.3), (np.inf, 0.0)])
def test_ends_of_the_band(half: float, left: float) -> None:
    assert faded(0.3, half) == left


def test_a_band_that_is_no_number_stops_the_correction() -> None:
    assert np.isnan(faded(5.0, np.nan))
    assert np.isnan(faded(5.0, -1.0))


def test_a_bundle_of_before_has_the_same_fields_and_checksum_and_serves_as_it_did() -> None:
    plain = path_bundle()
    data = json.loads(json.dumps(plain.to_dict()))
    assert set(data) == {
        *("format", "version", "name", "machine", "model_version", "created", "inputs", "outputs", "states", "window"),
        *("window_graph", "tick_graph", "safety", "provenance", "vectors", "sha256"),
    }
    assert _checksum({k: v for k, v in data.items() if k != "sha256"}) == data["sha256"]
    again = Bundle.from_dict(data)
    assert again == plain
    compiled = CompiledBundle(again)
    assert not compiled.fades
    # With small corrections too: the first harmonic passes zero.
    rows = np.column_stack([np.linspace(-0.1, 0.1, 50), np.full(50, 30.0)])
    state, expected = {"kept": 0.0}, []
    for angle, speed in rows:
        told, state = again.tick_graph.evaluate({"path_angle_rad": angle, "commanded_speed_mm_s": speed}, state)
        expected.append(told["radial_error_um"])
    assert [float(compiled.tick(row)[0]) for row in rows] == pytest.approx(expected, abs=1e-12)
    assert np.isnan(compiled.band_um).all()


def test_the_band_survives_the_file_and_is_proved(tmp_path: Path) -> None:
    bundle = path_bundle(band=growing_band())
    compiled = load_bundle(save_bundle(bundle, tmp_path / "b.json"))
    assert compiled.bundle == bundle
    assert compiled.fades
    compiled.tick(np.array([1.0, 40.0]))
    assert compiled.band_um.tolist() == pytest.approx([0.9])
    assert bundle.band is not None
    wrong = tuple((row[0] + 1e-6,) for row in bundle.band.vectors)
    with pytest.raises(GateRefusal, match="the band gives other values here"):
        prove(replace(bundle, band=replace(bundle.band, vectors=wrong)))
    with pytest.raises(GateRefusal, match="vectors of the band are missing"):
        prove(replace(bundle, band=replace(bundle.band, vectors=())))


def test_what_moves_the_machine_is_another_model_with_a_band() -> None:
    assert path_bundle().model_sha256 != path_bundle(band=growing_band()).model_sha256


def test_a_band_of_something_else_is_refused() -> None:
    with pytest.raises(InputError, match="not one of the outputs"):
        path_bundle(band=growing_band("other_um"))
    g = GraphBuilder()
    with pytest.raises(InputError, match="uses what is not declared"):
        path_bundle(band=Band(COVARIANCE, g.graph({"radial_error_um": g.input("temperature_c")})))


def test_a_negative_half_width_is_refused() -> None:
    with pytest.raises(InputError, match="band is not finite"):
        path_bundle(band=constant_band({"radial_error_um": -1.0}))


def test_a_band_with_an_unknown_basis_is_refused() -> None:
    data = path_bundle(band=growing_band()).to_dict()
    data["band"]["basis"] = "guess"
    data["sha256"] = _checksum({k: v for k, v in data.items() if k != "sha256"})
    with pytest.raises(InputError, match=r"band\.basis"):
        Bundle.from_dict(data)


def test_many_ticks_fade_as_single_ones_do() -> None:
    bundle = path_bundle(band=growing_band())
    rows = np.column_stack([np.linspace(-0.2, 0.2, 101), np.linspace(0.0, 120.0, 101)])
    one, many = CompiledBundle(bundle), CompiledBundle(bundle)
    single = np.array([one.tick(row)[0] for row in rows])
    assert many.run(rows)[:, 0] == pytest.approx(single, abs=1e-12)
    plain = CompiledBundle(bundle, fades=False).run(rows)[:, 0]
    half = 0.5 + 0.01 * rows[:, 1]
    assert np.array_equal(np.abs(single - plain) > 1e-9, (np.abs(plain) < half) & (np.abs(plain) > 1e-9))


def test_a_constant_band_lasts_over_resets() -> None:
    compiled = CompiledBundle(path_bundle(band=constant_band({"radial_error_um": 3.0}, COVARIANCE)))
    compiled.reset()
    small = compiled.tick(np.array([0.05, 0.0]))[0]
    assert compiled.band_um.tolist() == [3.0]
    share = 20.0 * np.sin(0.05) / 3.0
    assert small == pytest.approx(3.0 * share**3 * (3.0 - 2.0 * share))


def test_residuals_widen_the_strip_and_fade_nothing() -> None:
    band = constant_band({"radial_error_um": 30.0})
    assert (band.basis, band.fades) == (HELD_OUT, False)
    compiled = CompiledBundle(path_bundle(band=band))
    assert compiled.tick(np.array([1.0, 0.0]))[0] == pytest.approx(20.0 * np.sin(1.0))
    assert compiled.band_um.tolist() == [30.0]


@pytest.mark.parametrize("band", [None, constant_band({"radial_error_um": 1.0})])
def test_fading_is_refused_where_the_correction_has_no_uncertainty_of_its_own(band: Band | None) -> None:
    with pytest.raises(GateRefusal, match="does not say how uncertain"):
        require_fading(band)


def test_another_clamp_keeps_the_choice() -> None:
    bundle = path_bundle(band=growing_band())
    for fades in (True, False):
        tighter = CompiledBundle(bundle, fades=fades).limited(replace(bundle.safety, clamp_um=1.0))
        assert (tighter.fades, tighter.bundle.safety.clamp_um) == (fades, 1.0)


def test_a_decision_tells_the_band_along_the_axes_of_the_base() -> None:
    bundle = path_bundle(
        outputs=[Output("radial_error_um", "path_radial"), Output("up_um", "base_z")],
        tick_graph=two_outputs(),
        states=[],
        band=constant_band({"radial_error_um": 2.0, "up_um": 0.5}, COVARIANCE),
    )
    decision = Decision(CompiledBundle(bundle), np.zeros(3))
    state = layout.empty_state()
    state[layout.RUNTIME_RUNNING] = state[layout.SAFETY_OK] = 1.0
    state[layout.RADIUS] = 100.0
    state[layout.TARGET_TCP : layout.TARGET_TCP + 3] = 60.0, 80.0, 0.0
    decision.decide(state, age_s=0.0, elapsed_s=0.002, enabled=True, stages=np.zeros(6, dtype=np.int64))
    angle = float(decision.compiled.tick_inputs[0])
    assert decision.band_um.tolist() == pytest.approx([2.0 * abs(np.cos(angle)), 2.0 * abs(np.sin(angle)), 0.5])


def two_outputs():  # type: ignore[no-untyped-def]
    g = GraphBuilder()
    angle = g.input("path_angle_rad")
    speed = g.input("commanded_speed_mm_s") * 0.0
    return g.graph({"radial_error_um": 9.0 * g.apply("sin", angle) + speed, "up_um": g.constant(1.0)})


def test_a_model_with_windows_may_use_them_in_its_band() -> None:
    g = GraphBuilder()
    band = Band(COVARIANCE, g.graph({"radial_error_um": abs(g.input("level")) + g.input("wrist_x_rms_g")}))
    compiled = CompiledBundle(sensor_bundle(band=band))
    compiled.window(np.array([0.5, 100.0]))
    compiled.tick(np.array([0.3]))
    assert compiled.band_um.tolist() == pytest.approx([np.log(51.0) + 0.5])
