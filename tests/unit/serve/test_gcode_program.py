"""What a compensated program keeps, in which order, and which programs are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_twin_exports import EFFECTS, made_twin

from dtwin.errors import InputError
from dtwin.kinds.circular.freeze import twin_bundle
from dtwin.lifecycle._gcode_compensation import compensate
from dtwin.lifecycle.export import Request, Source, export
from dtwin.physics.twin import Twin


@pytest.fixture(scope="module")
def source() -> Source:
    twin, obs = made_twin(EFFECTS[:3])
    return Source(twin_bundle(twin, obs, horizon_s=0.01).bundle, "candidate", twin, "7")


@pytest.fixture(scope="module")
def twin(source: Source) -> Twin:
    assert source.twin is not None
    return source.twin


def compensated(text: str, twin: Twin) -> list[str]:
    return compensate(text, twin, origin_mm=np.zeros(3), where="p.nc").text.splitlines()


@pytest.mark.parametrize("word", ["M0", "M1", "M2", "M5", "M9", "M30", "M60"])
@pytest.mark.parametrize("motion", ["G0 X50 Y20", "G1 X50 Y20 F800", "G3 X-10 Y0 I-10 J0 F800"])
def test_what_ends_or_switches_off_comes_after_the_motion_of_its_line(word: str, motion: str, twin: Twin) -> None:
    # The control runs the line's motion first: the spindle would stop, or the program end, before the cut.
    lines = compensated(f"G0 X10 Y0\n{motion} {word}\n", twin)
    assert lines[-1] == word
    assert lines[-2].startswith(("G0 X", "G1 X"))
    assert word not in lines[:-1]


def test_what_switches_on_comes_before(twin: Twin) -> None:
    lines = compensated("G0 X10 Y0\nG1 X20 F800 M3 S500 M9\n", twin)
    assert lines[1] == "M3 S500"
    assert lines[-1] == "M9"


@pytest.mark.parametrize("line", ["M98 P1000", "M97 P5", "M198 P2", "M99 P10", "/G1 X5 Y5", "/X5", "/M98 P1"])
def test_motion_that_the_program_does_not_show_is_refused(line: str, twin: Twin) -> None:
    with pytest.raises(InputError) as refusal:
        compensated(f"G0 X10 Y0\n{line}\nG1 X20 F100\n", twin)
    assert "line 2" in str(refusal.value.where)


@pytest.mark.parametrize("circle", ["G3 I-50 J0 F900", "G3 F900\nI-50"])
def test_a_circle_that_names_its_centre_alone_is_compensated_like_one_with_its_end(circle: str, twin: Twin) -> None:
    whole = compensated("G0 X60 Y0\nG1 X50 Y0 F900\nG3 X50 Y0 I-50 J0 F900\n", twin)
    alone = compensated(f"G0 X60 Y0\nG1 X50 Y0 F900\n{circle}\n", twin)
    assert [line for line in alone if line.startswith("G1 X")] == [line for line in whole if line.startswith("G1 X")]
    assert len(whole) > 100
    assert not [line for line in alone if "I" in line]


@pytest.mark.parametrize("line", ["G3 X0 Y10 I-10 J0 F100", "G3 I-10 F100", "G18 G2 X0 Z5 I-5 K0 F100"])
def test_an_arc_from_a_point_that_nobody_knows_is_refused(line: str, twin: Twin) -> None:
    with pytest.raises(InputError, match="not understand"):
        compensated(f"G21 G90\nG0 X10\n{line}\n", twin)


@pytest.mark.parametrize("line", ["M99", "/M8", "/ (stop here)"])
def test_what_moves_nothing_is_kept(line: str, twin: Twin) -> None:
    assert line in compensated(f"G0 X10 Y0\n{line}\n", twin)


def test_a_compensated_program_says_so_and_is_not_compensated_again(source: Source, tmp_path: Path) -> None:
    program = tmp_path / "part.nc"
    program.write_text("%\nO1234 (PLATE)\nG21 G90 G17\nG0 X10 Y0\nM30\n%\n", encoding="ascii")
    trial = replace(source, state="candidate, for a trial only: µ; (half)")
    made = export(trial, Request("gcode", program=program))
    lines = made.text.splitlines()
    assert lines[:2] == ["%", "O1234 (PLATE)"]
    head = "(DTWIN COMPENSATED, TWIN-T OF VIRTUAL-MILL, VERSION 7, CANDIDATE, FOR A TRIAL ONLY HALF)"
    assert lines[2] == head
    assert made.text.isascii()
    program.write_text(made.text, encoding="ascii")
    with pytest.raises(InputError, match="compensated already"):
        export(source, Request("gcode", program=program))
