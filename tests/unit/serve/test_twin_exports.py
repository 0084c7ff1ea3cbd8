"""A twin's correction in other languages: run, evaluated, tabulated, driven."""

from __future__ import annotations

import ctypes
import math
import re
import runpy
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import path_bundle, sensor_bundle
from emitted import StructuredText, URScript

from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.lifecycle._axis_tables import axis_table, compensation_file, csv_table
from dtwin.lifecycle._gcode_compensation import compensate
from dtwin.lifecycle.export import Request, Source, export
from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters
from dtwin.physics.effect import Instance
from dtwin.physics.fit import Estimate
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.problem import Term
from dtwin.physics.twin import Twin, ValidityBox

LIBRARY = Library()
EFFECTS: tuple[tuple[str, str, tuple[float, ...], dict[str, float]], ...] = (
    ("backlash", "X", (4.0,), {"standstill_um": 3.0}),
    ("scale_mismatch", "X", (20.0,), {}),
    ("squareness", "XY", (30.0,), {}),
    ("straightness", "Y", (3.0, 0.0), {}),
    ("servo_mismatch", "Y", (0.02,), {}),
)


def made_twin(effects: Any = EFFECTS) -> tuple[Twin, Any]:
    """Return a twin with chosen parameters, and runs in three planes."""
    tests = [
        CircularTest(plane, direction, radius, feed, setup=f"{plane}{radius}")
        for plane in ("XY", "YZ", "ZX")
        for radius in (50.0, 100.0)
        for feed in (1500.0, 3000.0)
        for direction in ("CCW", "CW")
    ]
    mill = VirtualMill(MillParameters(), samples_per_turn=360)
    obs = observe(mill.campaign(), mill.measure(tests))
    terms, estimates = [], []
    blank: dict[str, Any] = dict.fromkeys(Estimate.__dataclass_fields__, 0.0)
    for name, axis, values, shape in effects:
        effect = LIBRARY[name]
        terms.append(Term(Instance(effect, axis), shape or effect.start_shape))
        estimates += [
            Estimate(
                **blank
                | {"effect": name, "axis": axis, "name": p.name, "unit": p.unit, "value": v, "identifiable": True}
            )
            for p, v in zip(effect.parameters, values, strict=True)
        ]
    twin = Twin(
        "t", 1, "virtual-mill", "c", "fit", tuple(terms), tuple(estimates), (), ValidityBox.of(obs), {}, (), (), {}, {}
    )
    return twin, obs


@pytest.fixture(scope="module")
def source() -> Source:
    twin, obs = made_twin()
    return Source(twin_bundle(twin, obs, horizon_s=0.01).bundle, "candidate", twin)


def points(source: Source) -> np.ndarray:
    rng = np.random.default_rng(2)
    boxes = {i.name: (i.low, i.high) for i in source.bundle.inputs}
    low, high = np.array([boxes[n] for n in source.bundle.tick_inputs]).T
    rows = rng.uniform(low, high, (300, len(low)))
    names = source.bundle.tick_inputs
    rows[:, names.index("path_angle_rad")] = rng.uniform(-7.0, 7.0, 300)
    rows[:, names.index("direction_sign")] = rng.choice([-1.0, 1.0], 300)
    rows[:, names.index("plane_id")] = rng.integers(0, 3, 300)
    return rows


def wanted(source: Source) -> np.ndarray:
    names = source.bundle.tick_inputs
    graph = source.bundle.tick_graph
    found = [graph.evaluate(dict(zip(names, row, strict=True)), {})[0]["radial_um"] for row in points(source).tolist()]
    assert np.abs(found).max() > 2.0
    return np.array(found)


def test_the_c_header_compiles_and_agrees(source: Source, tmp_path: Path) -> None:
    gcc = shutil.which("gcc")
    if gcc is None:
        pytest.skip("gcc is not installed (Debian package gcc)")
    header = tmp_path / "twin.h"
    header.write_text(export(source, Request("c")).text, encoding="utf-8")
    user = tmp_path / "user.c"
    user.write_text(
        '#include "twin.h"\n#include "twin.h"\n'
        "void tick(const double *i, double *s, double *o) { dtwin_twin_t(i, s, o); }\n"
        "int inside(const double *i) { return dtwin_twin_t_inside(i); }\n",
        encoding="utf-8",
    )
    library = tmp_path / "user.so"
    flags = ["-O2", "-ffp-contract=off", "-std=c99", "-Wall", "-Werror", "-Wno-unused-function"]
    subprocess.run([gcc, *flags, "-shared", "-fPIC", user, "-o", library, "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    n = len(source.bundle.tick_inputs)
    out, state, rows = (ctypes.c_double * 1)(), (ctypes.c_double * 1)(), []
    for row in points(source).tolist():
        code.tick((ctypes.c_double * n)(*row), state, out)
        rows.append(out[0])
        assert code.inside((ctypes.c_double * n)(*row)) == 1
    np.testing.assert_allclose(rows, wanted(source), rtol=1e-12, atol=1e-12)
    outside = points(source)[0]
    outside[source.bundle.tick_inputs.index("radius_mm")] = 300.0
    assert code.inside((ctypes.c_double * n)(*outside)) == 0


def test_python_runs_and_agrees(source: Source, tmp_path: Path) -> None:
    path = tmp_path / "exported_twin.py"
    path.write_text(export(source, Request("python")).text, encoding="utf-8")
    code = runpy.run_path(str(path))
    names = source.bundle.tick_inputs
    rows = [code["twin_t"](dict(zip(names, row, strict=True)), {})[0]["radial_um"] for row in points(source).tolist()]
    np.testing.assert_allclose(rows, wanted(source), rtol=1e-12, atol=1e-12)
    assert set(code["BOX"]) == set(names)


def test_structured_text_and_urscript_agree_and_say_that_they_never_ran(source: Source) -> None:
    names = source.bundle.tick_inputs
    text = export(source, Request("st")).text
    block = StructuredText(text)
    rows = [block.tick(dict(zip(names, row, strict=True)))["radial_um"] for row in points(source).tolist()]
    np.testing.assert_allclose(rows, wanted(source), rtol=1e-12, atol=1e-12)
    script = export(source, Request("urscript")).text
    call = URScript(script).functions["dtwin_twin_t"]
    rows = [call(*row)[0] for row in points(source).tolist()]
    np.testing.assert_allclose(rows, wanted(source), rtol=1e-12, atol=1e-12)
    for written in (text, script):
        assert "never run on a controller" in written
        assert "sign changed" in written


def test_a_promoted_equation_with_states_is_exported_too() -> None:
    source = Source(path_bundle(), "champion", None)
    text = export(source, Request("st")).text
    block, state = StructuredText(text), {"kept": 0.0}
    call = URScript(export(source, Request("urscript")).text).functions["dtwin_first_harmonic"]
    kept = 0.0
    for angle, speed in ((0.3, 40.0), (1.2, 60.0), (2.0, 10.0)):
        inputs = {"path_angle_rad": angle, "commanded_speed_mm_s": speed}
        out, state = source.bundle.tick_graph.evaluate(inputs, state)
        assert block.tick(inputs)["radial_error_um"] == pytest.approx(out["radial_error_um"])
        value, kept = call(angle, speed, kept)
        assert (value, kept) == pytest.approx((out["radial_error_um"], state["kept"]))
    assert r"\begin{aligned}" in export(source, Request("latex")).text
    with pytest.raises(InputError, match="error of single axes"):
        export(source, Request("comp", axis="X"))
    with pytest.raises(InputError, match="windows of sensor signals"):
        export(Source(sensor_bundle(), "champion", None), Request("c"))


def test_a_compensation_file_holds_play_and_scale_of_one_axis_and_nothing_else(source: Source) -> None:
    made = export(source, Request("comp", axis="X", travel_mm=(250.0, 450.0), origin_mm=(350, 0, 0)))
    rows = np.array([[float(v) for v in line.split()] for line in made.text.splitlines() if line[0] != "#"])
    x = rows[:, 0] - 350.0
    assert (np.diff(rows[:, 0]) > 0).all()
    # Trim is what the command must be changed by, mm: minus scale, and half the play by side.
    np.testing.assert_allclose(rows[:, 1], 1e-3 * (-20e-3 * x + 2.0), atol=1e-6)
    np.testing.assert_allclose(rows[:, 2], 1e-3 * (-20e-3 * x - 2.0), atol=1e-6)
    assert made.left_out == {
        "squareness XY on X": "depends on the position of another axis",
        "straightness Y on X": "depends on the position of another axis",
    }
    # A table of zeros would be loaded, and believed.
    with pytest.raises(InputError, match="nothing that a table of this axis holds") as refusal:
        export(source, Request("comp", axis="Y"))
    assert refusal.value.got == "servo_mismatch Y on Y: depends on the feed"
    for bad in (
        Request("comp"),
        Request("comp", axis="X", points=257),
        Request("comp", axis="X", travel_mm=(5.0, 5.0)),
        # Without --origin nothing of this travel was measured.
        Request("comp", axis="X", travel_mm=(250.0, 450.0)),
        Request("csv", axis="X"),
        Request("klipper", axis="X"),
        Request("c", axis="X"),
    ):
        with pytest.raises(InputError):
            export(source, bad)


class Sinumerik:
    """Reads ``$AA_ENC_COMP`` and moves one axis as the manual says: the encoder's value plus the table is the actual."""

    def __init__(self, text: str, axis: str) -> None:
        code = [line for line in text.splitlines() if not line.startswith(";")]
        assert (code[0], code[1], code[-1]) == (f"%_N_{axis}_EEC_INI", "CHANDATA(1)", "M17")
        self.datum = {}
        for line in code[2:-1]:
            found = re.fullmatch(r"\$AA_ENC_COMP(_[A-Z_]+)?\[0,(?:(\d+),)?" + axis + r"\]=(-?\d+(?:\.\d+)?)", line)
            assert found is not None, line
            assert len(line) < 80
            self.datum[found[1] or int(found[2])] = float(found[3])
        low, high, step = (self.datum.pop(f"_{n}") for n in ("MIN", "MAX", "STEP"))
        assert self.datum.pop("_IS_MODULO") == 0.0
        count = round((high - low) / step) + 1
        assert low + (count - 1) * step == pytest.approx(high, abs=1e-9)
        assert sorted(self.datum) == list(range(count))
        self.at = low + step * np.arange(count)
        told = re.search(r"^; MD32450 \$MA_BACKLASH\[0," + axis + r"\] = (\S+)$", text, re.MULTILINE)
        assert told is not None
        self.backlash = float(told[1])

    def encoder_mm(self, command: np.ndarray, forward: np.ndarray) -> np.ndarray:
        """Return where the loop brings the encoder; ``forward`` is 1 or -1."""
        rows = np.array([self.datum[n] for n in range(len(self.datum))])
        # The machine lags behind the encoder by the backlash; its middle is zero.
        goal = command + 0.5 * self.backlash * forward
        encoder = goal.copy()
        for _ in range(5):
            encoder = goal - np.interp(encoder, self.at, rows)
        return encoder


def test_a_siemens_table_brings_the_axis_where_it_was_told_to(source: Source) -> None:
    wavy = ("cyclic_error", "X", (2.0, 1.0), {"pitch_mm": 40.0})
    twin, _ = made_twin((*EFFECTS[:2], wavy))
    request = Request("siemens", axis="X", travel_mm=(250.0, 450.0), origin_mm=(350, 0, 0))
    made = export(replace(source, twin=twin, version="7"), request)
    assert "version 7, state candidate" in made.text
    assert "never loaded into a control" in made.text
    control = Sinumerik(made.text, "X1")
    assert control.backlash == pytest.approx(4e-3)
    rng = np.random.default_rng(5)
    command, forward = rng.uniform(250.0, 450.0, 1000), rng.choice([-1.0, 1.0], 1000)

    def error_um(encoder: np.ndarray) -> np.ndarray:
        x = encoder - 350.0
        wave = 2 * np.pi * x / 40.0
        return 20e-3 * x - 2.0 * forward + 2.0 * np.cos(wave) + np.sin(wave)

    encoder = control.encoder_mm(command, forward)
    left = 1000.0 * (encoder - command) + error_um(encoder)
    assert np.abs(error_um(command)).max() > 4.0
    assert np.abs(left).max() < 0.06
    with pytest.raises(InputError, match="too many rows"):
        export(replace(source, twin=twin), replace(request, points=201))
    with pytest.raises(InputError, match="too close"):
        export(replace(source, twin=twin), replace(request, travel_mm=(350.0, 350.1), points=200))


def test_a_table_says_where_it_goes_beyond_what_was_measured(source: Source) -> None:
    origin = (350.0, 0.0, 0.0)
    inside = export(source, Request("siemens", axis="X", travel_mm=(250.0, 450.0), origin_mm=origin))
    assert "measured from" not in inside.text
    wide = export(source, Request("siemens", axis="X", travel_mm=(0.0, 450.0), origin_mm=origin))
    said = "axis X: measured from 250 to 450 mm; beyond, the table is what the twin's formulas go on to"
    assert f"; {said}" in wide.text
    assert said in wide.notes


def klipper_moves(text: str, points_mm: np.ndarray) -> np.ndarray:
    """Return where Klipper sends commanded points, in the words of its ``skew_correction.py``."""
    (command,) = [line for line in text.splitlines() if not line.startswith(";")]
    assert command.startswith("SET_SKEW ")
    factor = dict.fromkeys(("XY", "XZ", "YZ"), 0.0)
    for part in command.split()[1:]:
        plane, lengths = part.split("=")
        ac, bd, ad = (float(v) for v in lengths.split(","))
        side = math.sqrt(2 * ac * ac + 2 * bd * bd - 4 * ad * ad) / 2.0
        factor[plane] = math.tan(math.pi / 2 - math.acos((ac * ac - side * side - ad * ad) / (2 * side * ad)))
    x, y, z = points_mm.T
    skewed_x = x - y * factor["XY"] - z * (factor["XZ"] - factor["XY"] * factor["YZ"])
    return np.column_stack([skewed_x, y - z * factor["YZ"], z])


def test_klipper_makes_the_axes_square(source: Source) -> None:
    sizes = {"XY": 30.0, "YZ": 20.0, "ZX": -15.0}
    bow = ("straightness", "Y", (3.0, 0.0), {})
    twin, _ = made_twin((*(("squareness", plane, (q,), {}) for plane, q in sizes.items()), bow))
    made = export(replace(source, twin=twin), Request("klipper"))
    assert made.left_out == {"straightness Y": "is no squareness"}
    assert "never loaded into a control" in made.text
    assert "LOAD=dtwin after homing" in made.text
    assert "SET_SKEW CLEAR=1" in made.text
    leans = np.array([[0.0, -30e-6, 0.0], [0.0, 0.0, -20e-6], [15e-6, 0.0, 0.0]])
    a, b = np.random.default_rng(6).uniform(-100.0, 100.0, (2, 1000, 3))
    asked = np.linalg.norm(a - b, axis=1)

    def off_um(first: np.ndarray, second: np.ndarray) -> float:
        apart = np.linalg.norm((first - second) @ (np.eye(3) + leans).T, axis=1)
        return float(1000.0 * np.abs(apart - asked).max())

    assert off_um(a, b) > 2.0
    assert off_um(klipper_moves(made.text, a), klipper_moves(made.text, b)) < 1e-3
    with pytest.raises(InputError, match="no squareness"):
        export(replace(source, twin=made_twin(EFFECTS[:2])[0]), Request("klipper"))


def test_a_table_has_as_many_rows_as_it_needs_and_states_its_error() -> None:
    wave = (("cyclic_error", "X", (2.0, 1.0), {"pitch_mm": 40.0}),)
    twin, _ = made_twin(wave)
    table = axis_table(twin, "X", (-100.0, 100.0), origin_mm=0.0, points=None, speed_mm_s=30.0)
    assert 2 < len(table.position_mm) <= 256
    dense = np.linspace(-100.0, 100.0, 9001)
    truth = 2.0 * np.cos(2 * np.pi * dense / 40.0) + np.sin(2 * np.pi * dense / 40.0)
    off = np.abs(np.interp(dense, table.position_mm, table.forward_um) - truth).max()
    assert off == pytest.approx(table.interpolation_um, rel=0.01)
    assert off <= 0.05
    # A pitch that 256 rows cannot hold: the error is stated, not hidden.
    fine, _ = made_twin((("cyclic_error", "X", (2.0, 1.0), {"pitch_mm": 2.0}),))
    coarse = axis_table(fine, "X", (-100.0, 100.0), origin_mm=0.0, points=None, speed_mm_s=30.0)
    assert len(coarse.position_mm) == 256
    assert coarse.interpolation_um > 0.1
    assert len(compensation_file(coarse).splitlines()) == 256
    lines = csv_table([table, coarse]).splitlines()
    assert lines[0].split(",")[:2] == ["axis", "position_mm"]
    assert len(lines) == 1 + len(table.position_mm) + 256


PROGRAM = """%
(two turns)
G21 G90 G17 G94
M3 S1000
G0 X60 Y0
G1 X50 Y0 F1500
G3 X50 Y0 I-50 J0
G2 X-50 Y0 I-50
G1 X-20 Y10
M30
%
"""


def machine_error_um(x: float, y: float, side: np.ndarray) -> np.ndarray:
    """Play of 4 um and 20 ppm on X, 30 um/m, and a bow of Y: by hand."""
    ex = 20e-3 * x - 30e-3 * y - 2.0 * side[0] + 3.0 * (y / 100.0) ** 2
    return np.array([ex, 0.0])


def driven(text: str) -> tuple[np.ndarray, list[str]]:
    """Drive the straight lines of a program with play, and return where the table really goes."""
    at, side, out, others = np.array([np.nan, np.nan]), np.zeros(2), [], []
    for line in text.splitlines():
        found = re.match(r"G[01] X(\S+) Y(\S+)( F\S+)?$", line)
        if found is None:
            others.append(line)
            continue
        new = np.array([float(found[1]), float(found[2])])
        step = new - at
        moved = np.abs(step) > 1e-4
        side = np.where(np.isfinite(step) & moved, np.sign(step), side)
        at = new
        out.append(at + machine_error_um(at[0], at[1], side) / 1000.0)
    return np.array(out), others


def test_a_compensated_program_drives_the_true_circle() -> None:
    twin, _ = made_twin(EFFECTS[:4])
    made = compensate(PROGRAM, twin, origin_mm=np.zeros(3), where="p.nc")
    path, others = driven(made.text)
    assert others == ["%", "(two turns)", "G21 G90 G17 G94", "M3 S1000", "M30", "%"]
    radius = np.hypot(path[:, 0], path[:, 1])
    circle = np.abs(radius - 50.0) < 0.02
    assert circle.sum() > 200
    # The first step after a reversal is the take-up of the play itself.
    assert np.quantile(np.abs(radius[circle] - 50.0), 0.98) < 2e-4
    plain = np.array(
        [
            50.0
            + machine_error_um(50 * math.cos(t), 50 * math.sin(t), np.array([-math.sin(t), 0]))[0]
            * math.cos(t)
            / 1000.0
            for t in np.linspace(0.1, 6.2, 50)
        ]
    )
    assert np.abs(plain - 50.0).max() > 1e-3
    assert made.interpolation_um <= 0.1
    assert made.outside == 0
    assert path[-1] == pytest.approx([-20.0, 10.0], abs=2e-5)


def test_axes_that_the_program_never_placed_are_not_moved() -> None:
    twin, _ = made_twin(EFFECTS[:4])
    made = compensate("G1 X10 F500\nG1 X20\n", twin, origin_mm=np.zeros(3), where="p.nc")
    assert "Y" not in made.text
    assert "Z" not in made.text
    # Where the first motion begins nobody knows, nor from which side it comes: scale alone.
    assert made.text.splitlines()[0] == "G1 X9.99980 F500"
    assert made.text.splitlines()[1] != "G1 X10.00000 F500"


@pytest.mark.parametrize(
    "line",
    [
        "G91",
        "G41 D1",
        "G2 X1 Y1 R5",
        "#1=5",
        "G81 X1 Y1 Z-5 R2",
        "G20",
        "X1 Y2",
        "o100 sub",
        "G1 X[1+2] F100",
        "G3 X9 Y0 I-50 F100",
        "G1 X5",
        "G28 X0",
    ],
)
def test_what_is_not_understood_is_refused_with_its_line(line: str, source: Source) -> None:
    assert source.twin is not None
    with pytest.raises(InputError) as refusal:
        compensate(f"G90\n{line}\n", source.twin, origin_mm=np.zeros(3), where="p.nc")
    assert "line 2" in str(refusal.value.where)


def test_a_twin_of_another_shape_is_not_confused(source: Source) -> None:
    assert source.twin is not None
    only = replace(source.twin, terms=source.twin.terms[2:3])
    made = export(replace(source, twin=only), Request("csv"))
    assert set(made.left_out) == {"squareness XY on X"}
    values = [float(v) for line in made.text.splitlines()[1:] for v in line.split(",")[2:4]]
    assert not any(values)
