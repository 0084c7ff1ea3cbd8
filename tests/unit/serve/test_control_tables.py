"""Tables for controls: a little interpreter of each form drives an axis to where it was told to."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_twin_exports import EFFECTS, made_twin

from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.lifecycle.export import Export, Request, Source, export

RNG = np.random.default_rng(11)
WAVY = ("cyclic_error", "X", (2.0, 1.0), {"pitch_mm": 40.0})


@pytest.fixture(scope="module")
def source() -> Source:
    twin, obs = made_twin((*EFFECTS[:2], WAVY))
    return Source(twin_bundle(twin, obs, horizon_s=0.01).bundle, "candidate", twin, "7")


def error_um(x_mm: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """The twin's X axis by hand: 20 ppm, 4 um of play, a wave of 40 mm."""
    wave = 2 * np.pi * x_mm / 40.0
    return 20e-3 * x_mm - 2.0 * forward + 2.0 * np.cos(wave) + np.sin(wave)


def left_um(command: np.ndarray, trim_mm: np.ndarray, forward: np.ndarray, origin_mm: float) -> np.ndarray:
    """What is left where the control adds a trim to the command."""
    moved = command + trim_mm
    return 1000.0 * trim_mm + error_um(moved - origin_mm, forward)


def places(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    return RNG.uniform(low, high, 1000), RNG.choice([-1.0, 1.0], 1000)


def written(source: Source, form: str, **more: Any) -> Export:
    settings = {"axis": "X", "travel_mm": (250.0, 450.0), "origin_mm": (350.0, 0.0, 0.0)} | more
    made = export(source, Request(form, **settings))
    assert "version 7, state candidate" in made.text
    assert "never loaded into a control" in made.text
    assert "from memory" in made.text
    return made


def test_heidenhain_com(source: Source) -> None:
    lines = written(source, "heidenhain").text.splitlines()
    assert (lines[0], lines[-1]) == ("BEGIN X_AXIS.COM MM", "[END]")
    head, *rows = (line.split() for line in lines[1:-1] if not line.startswith("#"))
    assert head == ["NR", "AXISPOS", "BACKLASH", "X"]
    assert [int(row[0]) for row in rows] == list(range(len(rows)))
    assert len(rows) <= 256
    table = np.array([[float(cell) for cell in row[1:]] for row in rows])
    command, forward = places(250.0, 450.0)
    trim = np.where(
        forward > 0, np.interp(command, table[:, 0], table[:, 2]), np.interp(command, table[:, 0], table[:, 1])
    )
    assert np.abs(left_um(command, trim, forward, 350.0)).max() < 0.2
    steep, _ = made_twin((("scale_mismatch", "X", (60_000.0,), {}),))
    with pytest.raises(InputError, match="differ by too much"):
        written(replace(source, twin=steep), "heidenhain")


class Sag:
    """Tables of set positions of base axes, each for its direction; what they say is added to the set position."""

    def __init__(self, text: str) -> None:
        lines = text.splitlines()
        assert (lines[0], lines[-1]) == ("%_N_NC_CEC_INI", "M17")
        self.values: dict[int, dict[int, float]] = {}
        self.of: dict[int, dict[str, str]] = {}
        for line in lines[1:-1]:
            value = re.fullmatch(r"\$AN_CEC\[(\d+),(\d+)\]=(-?[\d.]+)", line)
            setting = re.fullmatch(r"\$AN_CEC_(\w+)\[(\d+)\]=\(?([\w.-]+)\)?", line)
            assert value or setting or line.startswith(";") or line == "CHANDATA(1)", line
            if value:
                self.values.setdefault(int(value[1]), {})[int(value[2])] = float(value[3])
            elif setting:
                self.of.setdefault(int(setting[2]), {})[setting[1]] = setting[3]
        for number, settings in self.of.items():
            count = len(self.values[number])
            assert sorted(self.values[number]) == list(range(count))
            assert count <= 200
            step, low, high = (float(settings[name]) for name in ("STEP", "MIN", "MAX"))
            assert low + (count - 1) * step == pytest.approx(high, abs=1e-6)
            assert (settings["MULT_BY_TABLE"], settings["IS_MODULO"]) == ("0", "0")

    def trim_mm(self, axis: str, command: dict[str, np.ndarray], forward: np.ndarray) -> np.ndarray:
        total = np.zeros(forward.size)
        for number, settings in self.of.items():
            if settings["OUTPUT_AXIS"] != f"{axis}1":
                continue
            values = [self.values[number][n] for n in range(len(self.values[number]))]
            at = float(settings["MIN"]) + float(settings["STEP"]) * np.arange(len(values))
            found = np.interp(command[settings["INPUT_AXIS"][0]], at, values)
            way = int(settings["DIRECTION"])
            total += np.where((way == 0) | (way == forward), found, 0.0)
        return total


def test_siemens_sag_holds_both_directions_and_the_other_axis(source: Source) -> None:
    twin, _ = made_twin((*EFFECTS[:3], WAVY))
    leaning = replace(source, twin=twin)
    made = written(leaning, "siemens-cec")
    # A lean of 30 um/m moves X with Y; what moves with neither is none.
    assert made.left_out == {}
    control = Sag(made.text)
    assert {(s["INPUT_AXIS"], s["DIRECTION"]) for s in control.of.values()} == {("X1", "1"), ("X1", "-1"), ("Y1", "0")}
    command, forward = places(250.0, 450.0)
    other = RNG.uniform(-100.0, 100.0, 1000)
    trim = control.trim_mm("X", {"X": command, "Y": other}, forward)
    left = left_um(command, trim, forward, 350.0) - 30e-3 * other
    assert np.abs(left).max() < 0.1
    assert np.abs(error_um(command - 350.0, forward) - 30e-3 * other).max() > 5.0
    # Beyond the ends the values are held.
    far = control.trim_mm("X", {"X": np.array([1e4]), "Y": np.zeros(1)}, np.ones(1))
    end = control.trim_mm("X", {"X": np.array([450.0]), "Y": np.zeros(1)}, np.ones(1))
    assert far == pytest.approx(end)
    with pytest.raises(InputError, match="too many rows"):
        written(leaning, "siemens-cec", points=201)


def test_siemens_sag_names_what_it_cannot_hold(source: Source) -> None:
    twin, _ = made_twin((*EFFECTS[:2], ("scale_mismatch", "Y", (10.0,), {}), EFFECTS[4]))
    made = export(replace(source, twin=twin), Request("siemens-cec", axis="Y", travel_mm=(-50.0, 50.0)))
    assert set(made.left_out) == {"servo_mismatch Y on Y"}


class Fanuc:
    """Stored pitch error: steps are summed from the reference position; a step is of the section up to its point."""

    def __init__(self, text: str) -> None:
        head, body, end = text.split("%")
        self.marked = "30i, 31i, 32i" in head
        assert self.marked or "16i, 18i, 21i, 0i" in head
        assert not end.strip()
        self.datum, self.steps = {}, {}
        for line in body.split():
            parameter, datum = ("Q1", "Q0") if self.marked else ("", "")
            # Of a 30i lengths have a point, in mm; of a 16i they are counts of 0.001 mm.
            line = re.sub(r"^(N03624Q1A1P\d+)\.(\d{3})$", r"\1\2", line) if self.marked else line
            setting = re.fullmatch(rf"N0(\d{{4}}){parameter}A1P(-?\d+)", line)
            step = re.fullmatch(rf"N1(\d{{4}}){datum}P(-?\d+)", line)
            assert setting or step, line
            if setting:
                self.datum[int(setting[1])] = int(setting[2])
            elif step:
                self.steps[int(step[1])] = int(step[2])
        first, last = self.datum[3621], self.datum[3622]
        assert sorted(self.steps) == list(range(first, last + 1))
        assert len(self.steps) < 128
        assert all(-7 <= step <= 7 for step in self.steps.values())

    def trim_mm(self, command: np.ndarray, forward: np.ndarray, interpolates: bool = True) -> np.ndarray:
        reference, size = self.datum[3620], self.datum[3624] / 1000.0
        at, sums = {0: 0.0}, 0.0
        for number in range(reference + 1, self.datum[3622] + 1):
            sums += self.steps[number]
            at[number - reference] = sums
        sums = 0.0
        for number in range(reference, self.datum[3621] - 1, -1):
            sums -= self.steps[number]
            at[number - 1 - reference] = sums
        points = np.array(sorted(at))
        # Without that option a whole step comes in the middle of its section.
        places = command if interpolates else size * np.round(command / size)
        pitch = np.interp(places, points * size, [at[n] * self.datum[3623] for n in points]) / 1000.0
        return pitch - np.where(forward > 0, 0.0, self.datum[1851] / 1000.0)


@pytest.mark.parametrize("series", ["fanuc", "fanuc30i"])
@pytest.mark.parametrize("travel", [(250.0, 450.0), (-120.0, 80.0), (-450.0, -250.0)])
def test_fanuc_pitch_error(source: Source, travel: tuple[float, float], series: str) -> None:
    middle = sum(travel) / 2
    made = written(source, series, travel_mm=travel, origin_mm=(middle, 0.0, 0.0))
    control = Fanuc(made.text)
    assert control.marked == (series == "fanuc30i")
    assert ("." in made.text.split("%")[1]) == control.marked
    assert control.datum[1851] == 4
    command, forward = places(*travel)
    left = left_um(command, control.trim_mm(command, forward), forward, middle)
    # The reference position is the zero: a constant is left. Values are whole micrometres.
    assert np.ptp(left) < 1.4
    assert np.ptp(error_um(command - middle, forward)) > 8.0
    with pytest.raises(InputError, match="too many rows"):
        written(source, series, points=129)


@pytest.mark.parametrize("interpolates", [True, False])
def test_fanuc_has_points_enough_for_a_control_that_does_not_interpolate(source: Source, interpolates: bool) -> None:
    # Straight lines would need two points: half of 8 um would come at once.
    twin, _ = made_twin((("scale_mismatch", "X", (40.0,), {}),))
    made = written(replace(source, twin=twin), "fanuc", travel_mm=(-200.0, 0.0), origin_mm=(-100.0, 0.0, 0.0))
    control = Fanuc(made.text)
    command, forward = places(-200.0, 0.0)
    left = 1000.0 * control.trim_mm(command, forward, interpolates) + 40e-3 * (command + 100.0)
    assert np.ptp(left) < 2.1
    assert len(control.steps) < 40


def test_fanuc_numbers_its_points_as_the_manual_does(source: Source) -> None:
    """Series 0i-PB, B-63980EN: -400 to 800 mm every 50, reference 40: the farthest are 33 and 56."""
    made = written(source, "fanuc", travel_mm=(-400.0, 800.0), origin_mm=(200.0, 0.0, 0.0), points=27)
    datum = Fanuc(made.text).datum
    assert (datum[3624], datum[3620] - datum[3621], datum[3622] - datum[3620]) == (50_000, 40 - 33, 56 - 40)


def test_fanuc_takes_large_steps_by_magnification_and_refuses_larger_ones(source: Source) -> None:
    large, _ = made_twin((("scale_mismatch", "X", (20_000.0,), {}),))
    control = Fanuc(written(replace(source, twin=large), "fanuc", points=20).text)
    assert 1 < control.datum[3623] <= 100
    command, forward = places(250.0, 450.0)
    slope = np.polyfit(command, control.trim_mm(command, forward), 1)[0]
    assert slope == pytest.approx(-0.02, rel=0.02)
    absurd, _ = made_twin((("scale_mismatch", "X", (500_000.0,), {}),))
    with pytest.raises(InputError, match="changes by more"):
        written(replace(source, twin=absurd), "fanuc", points=4)


def test_haas_list(source: Source) -> None:
    small, _ = made_twin((EFFECTS[0], ("cyclic_error", "X", (6.0, 0.0), {"pitch_mm": 200.0})))
    made = written(replace(source, twin=small), "haas", travel_mm=(-450.0, 0.0), origin_mm=(-225.0, 0.0, 0.0))
    head, *rows = (line.split(",") for line in made.text.splitlines() if not line.startswith("#"))
    assert head == ["entry", "position_inch", "value_inch"]
    table = np.array([[float(cell) for cell in row] for row in rows])
    np.testing.assert_allclose(table[:, 1], -0.5 * np.arange(len(table)))
    assert table[0, 2] == 0.0
    assert len(table) <= 256
    command, _ = places(-450.0, 0.0)
    trim = 25.4 * np.interp(-command, -25.4 * table[:, 1], table[:, 2])
    left = 1000.0 * trim + 6.0 * np.cos(2 * np.pi * (command + trim + 225.0) / 200.0)
    # Steps of 2.54 um: half of one to each side.
    assert np.ptp(left) < 3.2
    with pytest.raises(InputError, match="larger than the control takes"):
        written(source, "haas", travel_mm=(-2000.0, 0.0), origin_mm=(-1000.0, 0.0, 0.0))
    with pytest.raises(InputError, match="negative positions"):
        written(source, "haas")


def test_beckhoff_list(source: Source) -> None:
    datum: dict[str, str] = {}
    for line in written(source, "beckhoff").text.splitlines():
        if not line.startswith("#"):
            key, value = line.split()
            assert key not in datum
            datum[key] = value
    get = {key: int(value) for key, value in datum.items() if key != "kopf.log_achs_name"}
    count = get["kw.ssfk.kw_nr_max"]
    assert (get["kopf.achs_nr"], get["kw.ssfk.unit"], get["kw.ssfk.bilateral"]) == (1, 1, 1)
    assert count < 1500
    at = (get["kw.ssfk.kw_startpos"] + get["kw.ssfk.interval"] * np.arange(count)) / 1e4
    pos, neg = ([get[f"kw.ssfk.table[{n}].{way}"] / 1e4 for n in range(count)] for way in ("pos", "neg"))
    command, forward = places(250.0, 450.0)
    # Beckhoff's formula: actual minus commanded, so that the control takes it away.
    trim = -np.where(forward > 0, np.interp(command, at, pos), np.interp(command, at, neg))
    assert np.abs(left_um(command, trim, forward, 350.0)).max() < 0.2
    # As in their example, play leaves the axis behind: less in the positive direction.
    assert all(p < n for p, n in zip(pos, neg, strict=True))
    with pytest.raises(InputError, match="too close together"):
        written(source, "beckhoff", travel_mm=(250.0, 250.0001))
    large, _ = made_twin((("scale_mismatch", "X", (80_000.0,), {}),))
    with pytest.raises(InputError, match="larger than the control takes"):
        written(replace(source, twin=large), "beckhoff")


class Duet:
    """RepRapFirmware 3.5: M579 and M556 change what they name; a point is scaled, then sheared by tangents."""

    def __init__(self) -> None:
        self.scale, self.tangent = dict.fromkeys("XYZ", 1.0), dict.fromkeys("XYZ", 0.0)

    def read(self, text: str) -> Duet:
        for line in text.splitlines():
            code, *words = line.split(";")[0].split() or [""]
            value = {word[0]: float(word[1:]) for word in words}
            if code == "M579":
                self.scale |= value
            elif code == "M556":
                # Versions before 3.4 do nothing below 10.
                size = value.pop("S")
                assert size >= 10.0
                self.tangent |= {axis: side / size for axis, side in value.items()}
            else:
                assert not code
        return self

    def moves(self, points_mm: np.ndarray) -> np.ndarray:
        x, y, z = (points_mm * [self.scale[a] for a in "XYZ"]).T
        x = x + self.tangent["X"] * y + self.tangent["Z"] * z
        return np.column_stack([x, y + self.tangent["Y"] * z, z])


def test_duet_makes_the_axes_square_and_right_in_length(source: Source) -> None:
    sizes = {"XY": 30.0, "YZ": 20.0, "ZX": -15.0}
    squares = (("squareness", plane, (q,), {}) for plane, q in sizes.items())
    twin, _ = made_twin((*squares, ("scale_mismatch", "X", (40.0,), {}), EFFECTS[0]))
    made = export(replace(source, twin=twin), Request("reprap"))
    assert set(made.left_out) == {"backlash X"}
    assert "never loaded into a control" in made.text
    machine = np.array([[1.00004, -30e-6, 0.0], [0.0, 1.0, -20e-6], [15e-6, 0.0, 1.0]])
    a, b = RNG.uniform(-100.0, 100.0, (2, 1000, 3))
    asked = np.linalg.norm(a - b, axis=1)

    def off_um(first: np.ndarray, second: np.ndarray) -> float:
        return float(1000.0 * np.abs(np.linalg.norm((first - second) @ machine.T, axis=1) - asked).max())

    assert off_um(a, b) > 4.0
    printer = Duet().read(made.text)
    assert off_um(printer.moves(a), printer.moves(b)) < 0.01
    with pytest.raises(InputError, match="no squareness"):
        export(replace(source, twin=made_twin(EFFECTS[:1])[0]), Request("reprap"))


def test_a_duet_keeps_what_was_not_measured(source: Source) -> None:
    twin, _ = made_twin((("squareness", "XY", (30.0,), {}), ("scale_mismatch", "X", (40.0,), {})))
    flat = replace(twin, box=replace(twin.box, planes=("XY",)))
    printer = Duet()
    printer.scale["Z"], printer.tangent["Y"], printer.tangent["Z"] = 1.01, 2e-3, 3e-3
    made = export(replace(source, twin=flat), Request("reprap"))
    printer.read(made.text)
    assert (printer.scale["Z"], printer.tangent["Y"], printer.tangent["Z"]) == (1.01, 2e-3, 3e-3)
    # An angle of less than 90 degrees is negative, and a long axis gets less.
    assert printer.tangent["X"] == pytest.approx(30e-6)
    assert printer.scale["X"] == pytest.approx(1.0 - 40e-6)
    assert "from memory" not in made.text
    assert any("were in force" in note for note in made.notes)
