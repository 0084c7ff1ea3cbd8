"""A mill with known faults is measured, its twin fitted and exported: read by each control, the file must make the mill better."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from test_control_tables import Duet, Fanuc, Sag
from test_linuxcnc_file import Joint
from test_twin_exports import Sinumerik, klipper_moves

from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.lifecycle.export import Export, Request, Source, export
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.problem import Term
from dtwin.physics.twin import twin_of

LIBRARY = Library()
EFFECTS = [("squareness", "XY"), ("squareness", "YZ"), ("squareness", "ZX")]
EFFECTS += [("scale_mismatch", "X"), ("scale_mismatch", "Y"), ("backlash", "X")]
LEAN, SCALE, PLAY_UM = {"XY": 300e-6, "YZ": 200e-6, "ZX": -150e-6}, 250e-6, 20.0
RNG = np.random.default_rng(8)


@pytest.fixture(scope="module")
def source() -> Source:
    faults = MillParameters(squareness_um_m={plane: 1e6 * lean for plane, lean in LEAN.items()})
    faults = faults.with_axis("X", scale_ppm=1e6 * SCALE, play_um=PLAY_UM)
    tests = [
        CircularTest(plane, way, radius, 1500.0, setup=f"{plane}{radius}")
        for plane in ("XY", "YZ", "ZX")
        for radius in (50.0, 100.0)
        for way in ("CCW", "CW")
    ]
    mill = VirtualMill(faults, samples_per_turn=360, seed=3)
    obs = observe(mill.campaign(), mill.measure(tests))
    terms = [Term(Instance(LIBRARY[name], axis), LIBRARY[name].start_shape) for name, axis in EFFECTS]
    twin = twin_of(fit(obs, terms), obs, name="t", version=1, action="fit", data={})
    frozen = twin_bundle(twin, obs, horizon_s=0.0)
    return Source(frozen.bundle, "candidate", frozen.twin, "7")


def along_x_um(x_mm: np.ndarray, way: np.ndarray) -> np.ndarray:
    """The mill's X axis, by its faults: it lags behind by half of its play."""
    return 1000.0 * SCALE * x_mm - 0.5 * PLAY_UM * way


def linuxcnc(made: Export, x: np.ndarray, way: np.ndarray) -> np.ndarray:
    return Joint(made.text, 1).motor_mm(x, way)


def siemens(made: Export, x: np.ndarray, way: np.ndarray) -> np.ndarray:
    return Sinumerik(made.text, "X1").encoder_mm(x, way)


def sag(made: Export, x: np.ndarray, way: np.ndarray) -> np.ndarray:
    return x + Sag(made.text).trim_mm("X", {"X": x, "Y": np.zeros(x.size), "Z": np.zeros(x.size)}, way)


def fanuc(made: Export, x: np.ndarray, way: np.ndarray) -> np.ndarray:
    return x + Fanuc(made.text).trim_mm(x, way, interpolates=False)


@pytest.mark.parametrize(
    ("form", "control"),
    [("comp", linuxcnc), ("siemens", siemens), ("siemens-cec", sag), ("fanuc", fanuc), ("fanuc30i", fanuc)],
)
def test_the_axis_is_better_with_the_file_than_without(form: str, control: Callable[..., Any], source: Source) -> None:
    x, way = RNG.uniform(-100.0, 100.0, 1000), RNG.choice([-1.0, 1.0], 1000)
    motor = control(export(source, Request(form, axis="X")), x, way)
    # A constant is the reference point's.
    before, after = np.ptp(along_x_um(x, way)), np.ptp(1000.0 * (motor - x) + along_x_um(motor, way))
    assert before > 60.0
    assert after < 0.1 * before


def duet(made: Export, points: np.ndarray) -> np.ndarray:
    return Duet().read(made.text).moves(points)


def klipper(made: Export, points: np.ndarray) -> np.ndarray:
    return klipper_moves(made.text, points)


@pytest.mark.parametrize(("form", "printer", "scale"), [("klipper", klipper, 0.0), ("reprap", duet, SCALE)])
def test_distances_are_better_with_the_setting(form: str, printer: Any, scale: float, source: Source) -> None:
    mill = np.diag([1.0 + scale, 1.0, 1.0])
    mill[0, 1], mill[1, 2], mill[2, 0] = -LEAN["XY"], -LEAN["YZ"], -LEAN["ZX"]
    made = export(source, Request(form))
    a, b = RNG.uniform(-100.0, 100.0, (2, 1000, 3))
    asked = np.linalg.norm(a - b, axis=1)
    before = np.linalg.norm((a - b) @ mill.T, axis=1) - asked
    after = np.linalg.norm((printer(made, a) - printer(made, b)) @ mill.T, axis=1) - asked
    assert 1000.0 * np.std(before) > 10.0
    assert np.std(after) < 0.1 * np.std(before)
