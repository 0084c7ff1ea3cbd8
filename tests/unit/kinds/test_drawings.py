"""Figures of one run: what a kind draws is what was measured, and nothing else is drawn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.schema import Floats, Run, RunMeta

RATE_HZ, PERIOD_S = 250.0, 4.0
T_S = np.arange(round(2.0 * PERIOD_S * RATE_HZ)) / RATE_HZ
ANGLE_DEG = 360.0 * T_S / PERIOD_S
LOBES_UM = 3.0 * np.cos(2.0 * np.radians(ANGLE_DEG))


def circle() -> Run:
    meta = RunMeta("c1", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=9425.0, sample_rate_hz=RATE_HZ)
    moved_um = 5.0 + 20.0 * np.cos(np.radians(ANGLE_DEG)) + LOBES_UM
    return Run(meta, {"t_s": T_S, "angle_deg": ANGLE_DEG, "deviation_um": moved_um})


def sweeps() -> Run:
    position = np.array([0.0, 10.0, 20.0, 20.0, 10.0, 0.0])
    ways = np.repeat(np.array(["forward", "reverse"], dtype=object), 3)
    samples = {
        "t_s": np.arange(6.0),
        "position_mm": position,
        "direction": ways,
        "error_um": np.array([0.0, 1.0, 2.0, 5.0, 4.0, 3.0]),
    }
    return Run(RunMeta("s1", kind="linear", condition={"axis": "X"}, sample_rate_hz=1.0), samples)


def tone() -> Run:
    t_s = np.arange(3000) / 1000.0
    told_mm = 0.005 * np.sin(2.0 * np.pi * 10.0 * t_s)
    condition: dict[str, float | str] = {"axis": "Z", "amplitude_um": 5.0, "frequency_hz": 10.0}
    meta = RunMeta("t1", kind="sinusoidal", condition=condition, sample_rate_hz=1000.0)
    return Run(meta, {"t_s": t_s, "cmd_z_mm": told_mm, "tool_z_mm": 1.1 * told_mm})


def turning() -> Run:
    """Six turns of an ellipse of 3 µm that sits 20 µm off the axis."""
    angle = np.arange(6 * 360) + 0.5
    moved_um = 20.0 * np.cos(np.radians(angle)) + 3.0 * np.cos(2.0 * np.radians(angle))
    condition: dict[str, float | str] = {"probe": "radial_x", "sense": "radial", "speed_rpm": 60.0}
    meta = RunMeta("x1", kind="rotation", condition=condition, sample_rate_hz=360.0)
    return Run(meta, {"t_s": angle / 360.0, "angle_deg": angle, "displacement_um": moved_um})


def indexed() -> Run:
    angle, error = np.array([0.0, 90.0, 90.0, 0.0]), np.array([1.0, 2.0, 4.0, 3.0])
    ways = np.repeat(np.array(["forward", "reverse"], dtype=object), 2)
    samples = {"t_s": np.arange(4.0), "angle_deg": angle, "direction": ways, "error_arcsec": error}
    return Run(RunMeta("i1", kind="rotary", condition={"axis": "C"}, sample_rate_hz=1.0), samples)


def warming() -> Run:
    t_s = 3600.0 * np.arange(5.0)
    samples = {"t_s": t_s, "displacement_um": 4.0 * np.arange(5.0), "temperature_ram_c": 20.0 + np.arange(5.0)}
    return Run(RunMeta("w1", kind="drift", condition={"axis": "Z"}, sample_rate_hz=1.0 / 3600.0), samples)


def places() -> Run:
    x, y = (np.ravel(v) for v in np.meshgrid(np.arange(0.0, 500.0, 100.0), np.arange(0.0, 400.0, 100.0)))
    off = np.zeros(x.size)
    off[7] = 0.5
    told = {"target_x_mm": x, "target_y_mm": y, "target_z_mm": 0.01 * x * y}
    return Run(RunMeta("p1", kind="poses"), told | {"error_x_mm": off, "error_y_mm": 0.0 * x, "error_z_mm": 0.0 * x})


def balls() -> Run:
    x = np.array([0.0, 100.0, 200.0])
    samples = {"t_s": x, "x_mm": x, "y_mm": 2.0 * x, "z_mm": 3.0 * x}
    return Run(
        RunMeta("c0", kind="volumetric"),
        samples | dict.fromkeys(("error_x_um", "error_y_um"), 0.03 * x) | {"error_z_um": 0.0 * x},
    )


RUNS = {
    "volumetric": balls,
    "circular": circle,
    "linear": sweeps,
    "sinusoidal": tone,
    "rotation": turning,
    "rotary": indexed,
    "drift": warming,
    "poses": places,
}


def no_floor() -> float:
    return math.nan


def figure(kind: str, name: str, floor_um: Any = no_floor) -> Any:
    (drawing,) = (d for d in kind_named(kind).drawings if d.name == name)
    return drawing.draw(RUNS[kind](), floor_um)


def values(trace: Any, axis: str = "y") -> Floats:
    return np.asarray(getattr(trace, axis), dtype=float)


def test_every_kind_that_draws_is_drawn_here() -> None:
    assert {kind.name for kind in kinds() if kind.offers("drawings")} == set(RUNS)


@pytest.mark.parametrize("kind", RUNS)
def test_every_drawing_has_a_name_of_its_own_and_shows_the_run(kind: str) -> None:
    drawings = kind_named(kind).drawings
    assert len({drawing.name for drawing in drawings}) == len(drawings)
    assert all(drawing.draw(RUNS[kind](), no_floor).data for drawing in drawings)


@pytest.mark.parametrize(("name", "across"), [("angle", ANGLE_DEG), ("time", T_S)])
def test_a_circle_is_drawn_without_its_centre_and_radius(name: str, across: Floats) -> None:
    (curve,) = figure("circular", name).data
    assert values(curve, "x") == pytest.approx(across, abs=1e-3)
    assert values(curve) == pytest.approx(LOBES_UM, abs=0.01)


def test_the_spectrum_of_a_circle_has_the_line_of_its_lobes() -> None:
    lines = figure("circular", "spectrum").data[0]
    top = int(np.argmax(values(lines)))
    assert values(lines, "x")[top] == pytest.approx(2.0 / PERIOD_S, abs=0.01)
    assert values(lines)[top] == pytest.approx(3.0, rel=0.01)


def test_the_floor_is_asked_for_only_where_it_is_shown() -> None:
    def refused() -> float:
        raise AssertionError("asked for")

    figure("circular", "spectrum", refused)
    figure("linear", "along", refused)
    with pytest.raises(AssertionError, match="asked for"):
        figure("circular", "polar", refused)


def test_sweeps_are_drawn_over_their_positions() -> None:
    forward, reverse = figure("linear", "along").data
    assert (forward.name, reverse.name) == ("forward", "reverse")
    assert values(reverse, "x") == pytest.approx([20.0, 10.0, 0.0])
    assert values(reverse) == pytest.approx([5.0, 4.0, 3.0])


def test_a_tone_is_drawn_over_the_phase_of_its_command() -> None:
    (curve,) = figure("sinusoidal", "along").data
    phase = np.radians(values(curve, "x"))
    assert values(curve) == pytest.approx(0.5 * np.sin(phase), abs=1e-3)


def test_a_drift_is_drawn_above_the_temperatures() -> None:
    moved, ram = figure("drift", "time").data
    assert values(moved) == pytest.approx(4.0 * values(moved, "x"))
    assert (ram.name, ram.yaxis) == ("ram", "y2")
    assert values(ram) == pytest.approx(20.0 + values(ram, "x"))


def test_poses_are_drawn_where_they_lie_with_the_worst_one() -> None:
    (seen,) = figure("poses", "above").data
    size = np.asarray(seen.marker.color, dtype=float)
    assert (int(np.argmax(size)), float(size.max())) == (7, pytest.approx(450.0, abs=50.0))
    # Along X the frame takes a tenth of an error that one pose has.
    assert values(seen, "x")[7] - values(seen, "x")[6] == pytest.approx(100.5, abs=0.3)


def test_balls_are_drawn_from_above_and_from_the_front() -> None:
    for name, up in (("above", 2.0), ("front", 3.0)):
        (seen,) = figure("volumetric", name).data
        assert values(seen) == pytest.approx(up * values(seen, "x"))
        assert np.asarray(seen.marker.color, dtype=float) == pytest.approx([0.0, 4.24, 8.49])


def test_a_turning_target_is_drawn_about_its_centre() -> None:
    (mean,) = (trace for trace in figure("rotation", "polar").data if trace.name == "synchronous")
    angle = np.radians(values(mean, "theta"))
    assert np.asarray(mean.customdata, dtype=float) == pytest.approx(3.0 * np.cos(2.0 * angle), abs=0.01)


@pytest.mark.parametrize(("kind", "name"), [("circular", "angle"), ("linear", "along"), ("rotation", "polar")])
def test_a_run_without_the_columns_is_refused(kind: str, name: str) -> None:
    (drawing,) = (d for d in kind_named(kind).drawings if d.name == name)
    run = Run(RunMeta("empty", kind=kind), {"t_s": T_S})
    with pytest.raises(InputError) as refused:
        drawing.draw(run, no_floor)
    assert (refused.value.code, refused.value.got) == ("run.columns", "t_s")
