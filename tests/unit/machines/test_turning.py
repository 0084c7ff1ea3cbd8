"""The virtual Z slide: calibrated to printed figures, its switches, its sensor, its analogue path."""

from __future__ import annotations

import numpy as np
import pytest
from noiseless_instruments import NOISELESS

from dtwin.features.sine import ToneErrors, tone_errors
from dtwin.kinds.sinusoidal._simulate import record_group, virtual_slide
from dtwin.machines.turning import (
    _UM_S2_PER_G,
    SERVO_HZ,
    AccelerationChannel,
    AnaloguePath,
    Slide,
    TurningSlide,
    _Accelerometer,
    _Motion,
)


def followed(slide: Slide, frequency: float, amplitude: float) -> ToneErrors:
    samples, _ = record_group(slide, NOISELESS, frequency, amplitude, 1)
    columns = [1000.0 * samples[n] for n in ("cmd_z_mm", "act_z_mm", "tool_z_mm")]
    return tone_errors(samples["t_s"], *columns, frequency)


def test_the_default_slide_is_close_to_the_printed_one() -> None:
    at_30, at_40 = followed(Slide(), 30.0, 5.0), followed(Slide(), 40.0, 5.0)
    assert at_30.encoder_um == pytest.approx(5.74, rel=0.05)
    assert at_30.tool_um == pytest.approx(7.29, rel=0.05)
    assert at_30.encoder_lag_deg == pytest.approx(1.06, abs=0.2)
    assert at_30.tool_lag_deg == pytest.approx(4.13, abs=0.2)
    assert at_40.amplitude_error_um == pytest.approx(4.35, rel=0.05)
    assert at_40.tool_lag_deg == pytest.approx(8.41, abs=0.3)
    assert at_40.tracking_um == pytest.approx(1.49, rel=0.05)
    # The error of vectors is longer than the difference of lengths.
    assert at_40.total_um > at_40.amplitude_error_um


def test_the_tool_bends_away_by_its_own_acceleration() -> None:
    # Beyond the encoder a linear structure without damping deviates by acceleration / omega^2.
    slide = Slide(structure_damping=0.0)
    machine = TurningSlide(slide)
    t = np.arange(16_000) / SERVO_HZ
    motion = machine.run(np.minimum(t, 1.0) * 5.0 * np.sin(2 * np.pi * 20.0 * t))
    omega = 2 * np.pi * slide.structure_hz
    beyond = motion.tool_um - motion.encoder_um
    assert np.allclose(beyond, -motion.acceleration_um_s2 / omega**2, atol=1e-12)


def test_a_linear_slide_scales_and_the_switches_do_not() -> None:
    def gain(truth: str, amplitude: float) -> float:
        return followed(virtual_slide(truth), 35.0, amplitude).tool_um / amplitude

    assert gain("linear", 1.0) == pytest.approx(gain("linear", 10.0), rel=1e-9)
    assert gain("hardening", 1.0) > 1.05 * gain("hardening", 10.0)
    assert gain("friction", 1.0) < 0.95 * gain("friction", 10.0)


def test_the_slide_goes_on_where_it_was() -> None:
    command = 3.0 * np.sin(2 * np.pi * 30.0 * np.arange(4000) / SERVO_HZ)
    whole, parts = TurningSlide(), TurningSlide()
    expected = whole.run(command).tool_um
    found = np.concatenate([parts.run(c).tool_um for c in np.split(command, [1, 900, 2500])])
    assert np.array_equal(found, expected)


def test_the_accelerometer_has_a_floor_a_wander_and_a_range() -> None:
    still = _Motion(*(np.zeros(80_000) for _ in range(3)))
    sensor = _Accelerometer(drift_g=0.0)
    shown = AccelerationChannel(sensor, np.random.default_rng(1)).sampled_g(still, 8)
    # Noise of its density in the band of a second-order low-pass, pi / (2 sqrt 2) wider.
    band = sensor.bandwidth_hz * np.pi / (2.0 * np.sqrt(2.0))
    assert np.std(shown) == pytest.approx(sensor.noise_g_per_root_hz * np.sqrt(band), rel=0.1)
    wild = _Motion(np.zeros(800), np.zeros(800), np.full(800, 9.0 * _UM_S2_PER_G))
    clipped = AccelerationChannel(sensor, np.random.default_rng(1)).sampled_g(wild, 8)
    assert clipped[-1] == sensor.range_g


def test_the_analogue_path_quantises_delays_and_saturates() -> None:
    path = AnaloguePath()
    wanted = np.array([1.0, 2.0, 3.0, 4.0])
    arrived, held, clipped = path.arrived_um(wanted, np.array([7.0, 8.0]))
    assert arrived[:2].tolist() == [7.0, 8.0]
    assert np.allclose(arrived[2:], [1.0, 2.0], atol=2e-3)
    assert np.allclose(held, [3.0, 4.0], atol=2e-3)
    assert clipped == 0
    far, _, clipped = path.arrived_um(np.full(5, 50.0), np.zeros(2))
    assert clipped == 5
    # Ten volts less the half volt that stands for nothing.
    assert far[-1] == pytest.approx((path.range_v - path.offset_v) * path.um_per_v, abs=2e-3)
