"""Instruments of a tone that read with the opposite sign, in another unit, or on a clock of their own."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.kinds.sinusoidal._check import judge_sinusoidal_run
from dtwin.kinds.sinusoidal._groups import groups_of
from dtwin.schema import Run, RunMeta, SignalGroup
from dtwin.units import G_MM_S2


@pytest.mark.parametrize(
    ("sign", "said"),
    [(1.0, set()), (-1.0, {"sinusoidal.sign"}), (1000.0, {"sinusoidal.tool_scale"}), (0.02, {"sinusoidal.tool_scale"})],
)
def test_a_probe_of_the_opposite_sign_or_another_size_is_an_error(sign: float, said: set[str]) -> None:
    t_s = np.arange(0.0, 7.0, 0.001)
    encoder = 0.0196 * np.sin(2.0 * np.pi * 5.0 * t_s - 0.02)
    samples = {"t_s": t_s, "cmd_z_mm": 0.02 * np.sin(2.0 * np.pi * 5.0 * t_s), "act_z_mm": encoder}
    condition = {"frequency_hz": 5.0, "amplitude_um": 20.0}
    run = Run(RunMeta("f5", kind="sinusoidal", condition=condition), {**samples, "tool_z_mm": sign * 1.02 * encoder})
    assert {f.code for f in judge_sinusoidal_run(run) if f.severity == "error"} == said


@pytest.mark.parametrize(("lag", "gain", "exchanged"), [(0.02, 0.98, True), (0.6, 0.7, True), (-0.01, 1.001, False)])
def test_an_encoder_ahead_of_its_command_is_the_command(lag: float, gain: float, exchanged: bool) -> None:
    t_s, turn = np.arange(0.0, 7.0, 0.001), 2.0 * np.pi * 5.0
    noise_mm = np.random.default_rng(3).normal(0.0, 2e-5, t_s.size)
    told, follows = 0.02 * np.sin(turn * t_s), gain * 0.02 * np.sin(turn * t_s - lag) + noise_mm
    condition = {"frequency_hz": 5.0, "amplitude_um": 20.0}
    found = []
    for command, encoder in ((told, follows), (follows, told)):
        samples = {"t_s": t_s, "cmd_z_mm": command, "act_z_mm": encoder}
        run = Run(RunMeta("f5", kind="sinusoidal", condition=condition), samples)
        found.append("sinusoidal.exchanged" in {f.code for f in judge_sinusoidal_run(run)})
    # One with feed forward may be ahead a little.
    assert found == [False, exchanged]


def _with_accelerometer(scale: float = 1.0, begins_s: float = 0.0) -> Run:
    """Return a tone of 20 µm at 5 Hz; its accelerometer reads g times ``scale``, its probe's clock begins at ``begins_s``."""
    t_s, turn = np.arange(0.0, 7.0, 0.001), 2.0 * np.pi * 5.0
    moved_mm = 0.02 * np.sin(turn * t_s)
    samples = {"t_s": t_s + begins_s, "cmd_z_mm": moved_mm, "act_z_mm": moved_mm, "tool_z_mm": moved_mm}
    felt = SignalGroup("accelerometers", 1000.0, {"tool_z_g": -scale * turn**2 / G_MM_S2 * moved_mm})
    condition = {"frequency_hz": 5.0, "amplitude_um": 20.0}
    return Run(RunMeta("f5", kind="sinusoidal", condition=condition), samples, signals=(felt,))


@pytest.mark.parametrize(("scale", "said"), [(1.0, False), (0.5, False), (9.80665, True), (1000.0, True)])
def test_an_accelerometer_in_another_unit_is_asked_for_it(scale: float, said: bool) -> None:
    assert ("sensor.scale" in {f.code for f in judge_sinusoidal_run(_with_accelerometer(scale))}) == said


def test_what_was_sent_is_known_whatever_the_clocks_begin_at() -> None:
    told = groups_of([_with_accelerometer(), _with_accelerometer(begins_s=1000.0)], "here")
    assert told.sent_rms_um == pytest.approx([20.0 / np.sqrt(2.0)] * 2, rel=1e-3)
