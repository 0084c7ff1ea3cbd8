"""Host, firmware and watchdog together: the real firmware in simavr behind a pseudo-terminal."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from simulated_analogue_board import AnalogueBoard

from dtwin.errors import DeviceError
from dtwin.links.analogue import AnalogueOutput, AxisCalibration

pytest_plugins = ["simulated_board"]
pytestmark = pytest.mark.system
NEUTRAL_V = (5.0, 5.0, 5.0)
# Longer than any pause of a test computer; the board's own clock counts it.
PATIENT_MS = 1000


@pytest.fixture
def board(programs: Path, tmp_path: Path) -> Iterator[AnalogueBoard]:
    with started(programs, tmp_path) as running:
        yield running


def started(programs: Path, folder: Path, stuck_bits: int = 0) -> AnalogueBoard:
    for program in programs.iterdir():
        if not (folder / program.name).exists():
            shutil.copy2(program, folder)
    return AnalogueBoard(folder, stuck_bits=stuck_bits)


def um(*values: float) -> np.ndarray:
    return np.array(values, dtype=float)


def test_a_correction_arrives_as_a_voltage_and_is_read_back(board: AnalogueBoard) -> None:
    assert board.wait_for(NEUTRAL_V)
    with AnalogueOutput(board.port, watchdog_ms=PATIENT_MS) as output:
        answer = output.engage()
        assert (answer.engaged, answer.tripped, answer.applied) == (True, False, (32768,) * 3)
        output.send(um(25.0, -50.0, 10.0))
        output.settle()
        assert board.wait_for((6.0, 3.0, 5.4))
        output.send(um(1e6, -1e6, 0.0))
        output.settle()
        assert output.clamped == 1
        assert board.wait_for((9.99985, 0.0, 5.0))
    assert board.wait_for(NEUTRAL_V), "leaving did not release"


def test_a_stream_of_corrections_keeps_its_order(board: AnalogueBoard) -> None:
    with AnalogueOutput(board.port, watchdog_ms=PATIENT_MS) as output:
        output.engage()
        for i in range(300):
            output.send(um(np.sin(i / 20.0), 0.0, 0.1 * i))
        output.settle()
        assert (output.sent, output.answered) == (300, 300)
        assert output.status().bad_frames == 0
        # 29.9 um are 1.196 V.
        assert board.wait_for((5.0 + np.sin(299 / 20.0) / 25.0, 5.0, 6.196))


def test_a_second_session_is_obeyed_by_a_board_that_did_not_restart(board: AnalogueBoard) -> None:
    for corrections in (20, 1):
        with AnalogueOutput(board.port, watchdog_ms=PATIENT_MS) as output:
            output.engage()
            for _ in range(corrections):
                output.send(um(25.0, 0.0, 0.0))
            output.settle()
            assert board.wait_for((6.0, 5.0, 5.0))


def test_silence_drops_the_correction_and_says_so(board: AnalogueBoard) -> None:
    output = AnalogueOutput(board.port, watchdog_ms=200)
    output.open()
    output.engage()
    output.send(um(100.0, 0.0, 0.0))
    output.settle()
    assert board.wait_for((9.0, 5.0, 5.0))
    # The host is killed here: nothing is sent any more.
    assert board.wait_for(NEUTRAL_V)
    output.send(um(50.0, 0.0, 0.0))
    with pytest.raises(DeviceError, match="watchdog dropped") as caught:
        output.settle()
    assert caught.value.code == "analogue.tripped"
    assert board.volts() == NEUTRAL_V
    again = output.engage()
    assert (again.tripped, again.trips) == (False, 1)
    output.close()


def test_garbage_and_cut_frames_move_nothing(board: AnalogueBoard) -> None:
    with AnalogueOutput(board.port, watchdog_ms=PATIENT_MS) as output:
        output.engage()
        output.send(um(10.0, 0.0, 0.0))
        output.settle()
        rng = np.random.default_rng(0)
        line = output.link._device
        for _ in range(20):
            line.write(bytes(rng.integers(0, 256, 40, dtype=np.uint8)) + b"\x00")
            line.flush()
            output.link.discard()
            answer = output.status()
            assert answer.applied == (output.calibration[0].code(10.0), 32768, 32768)
        assert output.status().bad_frames >= 20


def test_before_engaging_and_after_release_nothing_is_obeyed(board: AnalogueBoard) -> None:
    output = AnalogueOutput(board.port, watchdog_ms=PATIENT_MS)
    output.open()
    for prepare in (lambda: None, lambda: (output.engage(), output.release())):
        prepare()
        output.send(um(100.0, 0.0, 0.0))
        with pytest.raises(DeviceError, match="refused") as caught:
            output.settle()
        assert caught.value.got == "not engaged"
        assert board.volts() == NEUTRAL_V
    output.close()


def test_a_broken_converter_is_noticed_and_released(programs: Path, tmp_path: Path) -> None:
    with started(programs, tmp_path, stuck_bits=0x4000) as board:
        output = AnalogueOutput(board.port, watchdog_ms=PATIENT_MS)
        output.open()
        output.engage()
        output.send(um(70.0, 0.0, 0.0))
        with pytest.raises(DeviceError, match="does not hold") as caught:
            output.settle()
        assert caught.value.code == "analogue.read_back"
        assert board.wait_for(NEUTRAL_V)
        output.close()


def test_neutral_codes_survive_without_power(programs: Path, tmp_path: Path) -> None:
    shifted = (AxisCalibration(25.0, 5.1), AxisCalibration(-25.0, 4.9), AxisCalibration())
    with started(programs, tmp_path) as board, AnalogueOutput(board.port, shifted) as output:
        output.store_neutral()
        assert board.wait_for((5.1, 4.9, 5.0))
    with started(programs, tmp_path) as board:
        assert board.wait_for((5.1, 4.9, 5.0))
        with AnalogueOutput(board.port, shifted, watchdog_ms=PATIENT_MS) as output:
            output.engage()
            output.send(um(25.0, 25.0, 0.0))
            output.settle()
            assert board.wait_for((6.1, 3.9, 5.0))


def test_eight_bits_show_their_step(board: AnalogueBoard) -> None:
    with AnalogueOutput(board.port, output="pwm", watchdog_ms=PATIENT_MS) as output:
        output.engage()
        seen = set()
        for offset in np.arange(-2.0, 2.0, 0.1):
            output.send(um(offset, 0.0, 0.0))
            output.settle()
            time.sleep(0.005)
            seen.add(board.volts("pwm")[0])
        steps_um = 25.0 * np.diff(sorted(seen))
        # The thesis's output: a correction of a few micrometres comes in steps of one.
        assert len(seen) <= 6
        assert steps_um == pytest.approx(0.98, abs=0.01)
