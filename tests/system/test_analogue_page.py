"""The page about the analogue board is followed, on the firmware in a simulated board."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path

import pytest
from shown_commands import blocks, follow, page, run
from simulated_analogue_board import AnalogueBoard

from dtwin.errors import MissingPart
from dtwin.links.analogue import AxisCalibration, _step_um

pytestmark = pytest.mark.system
PAGE = page("docs/how-to/mill-by-analogue-input.md")
PORT = "/dev/ttyACM0"
PATIENCE = 5
STARVED = ("serial.stuck", "serial.silent", "analogue.tripped")


def on_a_board(command: str, folder: Path) -> str:
    """Run a command beside a board that has just started, as an Uno does when its port is opened.

    A busy test computer may halt the simulated board for longer than the command waits for it.
    """
    if PORT not in command:
        return run(command, folder)
    for patience in range(PATIENCE, -1, -1):
        with AnalogueBoard(folder) as board:
            try:
                return run(command.replace(PORT, board.port), folder)
            except AssertionError as error:
                if not patience or not any(code in str(error) for code in STARVED):
                    raise
    raise AssertionError


def test_the_page_is_followed_from_the_compiler_to_a_calibrated_correction(tmp_path: Path) -> None:
    shown = blocks(PAGE)
    (points,) = (b for b in shown if b.language == "csv")
    (script,) = (b for b in shown if b.language == "python")
    (tmp_path / "points.csv").write_text("\n".join(points.lines), encoding="utf-8")
    try:
        said = follow(shown, tmp_path, on_a_board)
        on_a_board(f"python -c {shlex.quote(chr(10).join(script.lines))}", tmp_path)
        kept = json.loads(on_a_board(f"dtwin analogue status {PORT} --json", tmp_path))
    except MissingPart as error:
        if os.environ.get("DTWIN_REQUIRE_ALL"):
            raise
        pytest.skip(f"{error}: {error.hint}")
    assert (tmp_path / "analogue_correction.elf").stat().st_size > 1000
    assert any("then released" in text for _, text in said)
    # The page says that x was neutral at 5.0174 V.
    assert kept["applied"][0] == pytest.approx(0.50174 * 65536, abs=1)


def test_the_page_states_the_steps_that_the_program_computes() -> None:
    known = AxisCalibration()
    for output, words in (("pwm", "**{:.2f} µm**"), ("dac", "steps of {:.4f} µm")):
        assert words.format(_step_um(known, output)) in PAGE
