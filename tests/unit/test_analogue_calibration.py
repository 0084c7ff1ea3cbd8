"""Calibration of analogue inputs: lines through measurements, and wires that are swapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dtwin.errors import GateRefusal, InputError
from dtwin.links.analogue import AxisCalibration, _eight_bits, _step_um
from dtwin.links.analogue_calibration import _HEAD, calibrate, load, read_points, save

VOLTS = np.repeat([3.0, 4.0, 5.0, 6.0, 7.0], 3)


def measured(
    sensitivity: np.ndarray, neutral: tuple[float, float, float], noise_um: float = 0.05
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(1)
    out = {}
    for i, axis in enumerate("xyz"):
        moved = np.outer(VOLTS - neutral[i], sensitivity[:, i])
        out[axis] = (VOLTS, moved + noise_um * rng.standard_normal(moved.shape))
    return out


def test_slope_sign_and_neutral_voltage_are_found() -> None:
    fits = calibrate(measured(np.diag([25.3, -24.6, 25.0]), (5.02, 4.97, 5.0)))
    for axis, um_per_v, neutral_v in (("x", 25.3, 5.02), ("y", -24.6, 4.97), ("z", 25.0, 5.0)):
        found = fits[axis]
        assert found.um_per_v == pytest.approx(um_per_v, abs=1.5 * found.um_per_v_uncertainty)
        assert found.neutral_v == pytest.approx(neutral_v, abs=1.5 * found.neutral_v_uncertainty)
        assert found.noise_um == pytest.approx(0.05, rel=0.5)
    assert fits["y"].calibration.code(10.0) < fits["y"].calibration.code(0.0)


@pytest.mark.parametrize(
    ("sensitivity", "message"),
    [
        ([[0, 25, 0], [25, 0, 0], [0, 0, 25]], "wires are swapped"),
        ([[25, 0, 0], [8, 25, 0], [0, 0, 25]], "also moves y"),
        ([[0.1, 0, 0], [0, 25, 0], [0, 0, 25]], "no correction input"),
    ],
)
def test_what_would_make_the_error_larger_is_refused(sensitivity: list[list[float]], message: str) -> None:
    with pytest.raises(GateRefusal, match=message):
        calibrate(measured(np.array(sensitivity, dtype=float), (5.0, 5.0, 5.0)))


def test_a_bent_answer_two_levels_and_a_missing_axis_are_refused() -> None:
    points = measured(25.0 * np.eye(3), (5.0, 5.0, 5.0))
    volts, moved = points["x"]
    with pytest.raises(GateRefusal, match="not a line"):
        calibrate({**points, "x": (volts, moved + np.outer((volts - 5) ** 2, [3.0, 0, 0]))})
    few = volts < 4.5
    with pytest.raises(GateRefusal, match="too few voltages"):
        calibrate({**points, "x": (volts[few], moved[few])})
    with pytest.raises(GateRefusal, match="at no voltage"):
        calibrate({**points, "x": (volts, moved + np.array([200.0, 0.0, 0.0]))})
    with pytest.raises(GateRefusal, match="not measured"):
        calibrate({"x": points["x"]})


def test_a_calibration_comes_back_from_its_file(tmp_path: Path) -> None:
    fits = calibrate(measured(25.0 * np.eye(3), (5.0, 5.1, 4.9)))
    path = save(tmp_path / "analogue.json", fits)
    assert load(path) == tuple(fits[axis].calibration for axis in "xyz")
    whole = path.read_text()
    slope = str(fits["y"].um_per_v)
    # Of 0 µm per volt the first correction would be a division by zero, and 1e9 V are the end of the travel.
    wrong = [(slope, text) for text in ("0.0", "NaN", "1e-300", "1" + "0" * 400, "true")]
    for old, new in [*wrong, (str(fits["y"].neutral_v), "1e9")]:
        path.write_text(whole.replace(old, new, 1))
        with pytest.raises(InputError, match="cannot be used"):
            load(path)
    for text in ("{}", "[" * 100_000):
        path.write_text(text)
        with pytest.raises(InputError, match="cannot be used"):
            load(path)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "axis,voltage_v\nx,1",
        f"{','.join(_HEAD)}\nw,1,2,3,4",
        f"{','.join(_HEAD)}\nx,nan,1,1,1",
        f"{','.join(_HEAD)}\nx,one,1,1,1",
        f"{','.join(_HEAD)}\nx,1,5,1,1,1",
        "x" * 200_000,
    ],
)
def test_a_points_file_with_a_mistake_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(InputError, match="cannot be used"):
        read_points(path)


def test_codes_round_clamp_and_lose_bits_as_they_must() -> None:
    axis = AxisCalibration()
    assert axis.code(0.0) == 32768
    assert axis.offset_um(axis.code(12.5)) == pytest.approx(12.5, abs=_step_um(axis, "dac") / 2)
    assert axis.code(1e6) == axis.code(125.0) == 65535
    assert axis.code(-1e6) == axis.code(-125.0) == 0
    assert _eight_bits((32768, 65535, 127)) == (32768, 65280, 0)
    assert _step_um(axis, "pwm") == pytest.approx(0.98, abs=0.005)
    assert _step_um(axis, "dac") == pytest.approx(0.0038, abs=0.0001)
