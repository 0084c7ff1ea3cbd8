"""LinuxCNC's compensation file, read as its source reads one, on an axis with a known error."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_twin_exports import EFFECTS, made_twin

from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.lifecycle.export import Request, Source, export
from dtwin.machines.linuxcnc.configuration import compensation_text

RNG = np.random.default_rng(21)


class Joint:
    """``usrmotLoadComp`` (usrmotintf.cc), ``EMCMOT_SET_JOINT_COMP`` (command.c), ``compute_screw_comp`` (control.c)."""

    def __init__(self, text: str, comp_file_type: int) -> None:
        rows: list[tuple[float, float, float]] = []
        for line in text.splitlines():
            number = r"\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)"
            found = re.match(3 * number, line)
            if found is None:
                break
            nominal, forward, reverse = (float(v) for v in found.groups())
            assert len(rows) < 256, "too many compensation entries"
            assert not rows or nominal > rows[-1][0], "compensation values must increase"
            trims = (nominal - forward, nominal - reverse) if comp_file_type == 0 else (forward, reverse)
            rows.append((nominal, *trims))
        self.nominal, self.forward, self.reverse = np.array(rows).T

    def motor_mm(self, command: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Return the motor's commands: the trim is added, and held beyond the ends."""
        forward, reverse = (np.interp(command, self.nominal, trim) for trim in (self.forward, self.reverse))
        return command + np.where(way > 0, forward, reverse)


@pytest.fixture(scope="module")
def source() -> Source:
    twin, obs = made_twin((*EFFECTS[:2], ("cyclic_error", "X", (2.0, 1.0), {"pitch_mm": 40.0})))
    return Source(twin_bundle(twin, obs, horizon_s=0.01).bundle, "candidate", twin, "7")


def error_um(x: np.ndarray, way: np.ndarray) -> np.ndarray:
    wave = 2 * np.pi * x / 40.0
    return 20e-3 * x - 2.0 * way + 2.0 * np.cos(wave) + np.sin(wave)


def test_a_joint_goes_where_it_was_told_to_also_at_negative_positions(source: Source) -> None:
    request = Request("comp", axis="X", travel_mm=(-450.0, -250.0), origin_mm=(-350.0, 0.0, 0.0))
    joint = Joint(export(source, request).text, 1)
    command, way = RNG.uniform(-450.0, -250.0, 1000), RNG.choice([-1.0, 1.0], 1000)
    before = error_um(command + 350.0, way)
    motor = joint.motor_mm(command, way)
    after = 1000.0 * (motor - command) + error_um(motor + 350.0, way)
    assert np.abs(before).max() > 4.0
    assert np.abs(after).max() < 0.06


def test_the_other_type_of_the_file_would_not_do(source: Source) -> None:
    text = export(source, Request("comp", axis="X")).text
    assert "COMP_FILE_TYPE = 1" in text
    command, way = np.array([40.0, -60.0]), np.array([1.0, -1.0])
    assert np.abs(Joint(text, 0).motor_mm(command, way) - command).min() > 1.0


def test_the_file_says_whose_it_is_where_linuxcnc_no_longer_reads(source: Source, tmp_path: Path) -> None:
    trial = replace(source, state="candidate, for a trial only: 3 µm; ölig")
    made = export(trial, Request("comp", axis="X"))
    lines = made.text.splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("#"))
    assert all(line.startswith("#") for line in lines[first:])
    assert len(Joint(made.text, 1).nominal) == first
    assert "version 7, state candidate, for a trial only: 3 um? ?lig" in lines[first]
    assert "for LINEAR_UNITS = mm" in lines[-1]
    assert made.text.isascii()
    file = tmp_path / "x.comp"
    file.write_text(made.text, encoding="utf-8")
    assert compensation_text(file).splitlines() == lines[:first]
    # A remark among the rows would end the table there.
    file.write_text("\n".join([lines[0], "# later", *lines[1:first]]), encoding="utf-8")
    with pytest.raises(InputError, match="no row"):
        compensation_text(file)


def test_rows_that_would_not_rise_are_refused(source: Source) -> None:
    with pytest.raises(InputError, match="too close together"):
        export(source, Request("comp", axis="X", travel_mm=(0.0, 0.0001), points=200))


FORMS = [
    "comp",
    "siemens",
    "siemens-cec",
    "heidenhain",
    "fanuc",
    "fanuc30i",
    "haas",
    "beckhoff",
    "csv",
    "klipper",
    "reprap",
]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_ascii(source: Source, form: str) -> None:
    twin, _ = made_twin((("squareness", "XY", (30.0,), {}), ("scale_mismatch", "X", (10.0,), {})))
    trial = replace(source, twin=twin, state="candidate, for a trial only: 3 µm, ölig")
    axis = "X" if form not in ("csv", "klipper", "reprap") else ""
    travel_mm = (-100.0, 0.0) if axis or form == "csv" else None
    made = export(trial, Request(form, axis=axis, travel_mm=travel_mm))
    assert made.text.isascii()
    assert all(len(line) < 200 for line in made.text.splitlines())
