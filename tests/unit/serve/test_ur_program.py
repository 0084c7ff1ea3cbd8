"""The robot's program for corrections, evaluated tick by tick; it has not run on a controller."""

from __future__ import annotations

import itertools
import re
from typing import Any

import pytest
from emitted import URScript
from hypothesis import given
from hypothesis import strategies as st

from dtwin.errors import InputError
from dtwin.links import ur_registers
from dtwin.links.ur_program import _TICK_HZ, _correction_functions, correction_program

LIMIT_UM, SLEW_UM_S, WATCHDOG_S = 200.0, 10_000.0, 0.02
STEP_UM = SLEW_UM_S / _TICK_HZ
IDLE = [0.0] * 6


def tick(state: list[Any], sequence: int, *offset: float) -> list[Any]:
    found = SCRIPT.functions["dtwin_correct"](state, sequence, *offset)
    return list(found)


SCRIPT = URScript(_correction_functions(LIMIT_UM, SLEW_UM_S, WATCHDOG_S))


def in_force(state: list[Any]) -> int:
    return int(SCRIPT.functions["dtwin_in_force"](state))


def start(sequence: int = 7) -> list[Any]:
    return [*IDLE, sequence, round(WATCHDOG_S * _TICK_HZ)]


def test_an_offset_is_latched_when_the_sequence_changes_and_not_before() -> None:
    state = tick(start(), 7, 100.0, 50.0, -30.0)
    assert state[:3] == [0.0, 0.0, 0.0], "values from before were taken"
    for sequence in range(8, 18):
        state = tick(state, sequence, 100.0, 50.0, -30.0)
    assert state[:3] == [100.0, 50.0, -30.0]
    # New values without a new number are half-written: they wait.
    assert tick(state, 17, -100.0, 0.0, 0.0)[:3] == [100.0, 50.0, -30.0]
    assert tick(state, 18, 90.0, 50.0, -30.0)[0] == 90.0


def test_silence_leads_back_to_zero_at_the_slew_rate() -> None:
    state = start()
    for sequence in range(8, 30):
        state = tick(state, sequence, 200.0, 0.0, 0.0)
    assert state[0] == 200.0
    seen = []
    for _ in range(round(WATCHDOG_S * _TICK_HZ) + round(200.0 / STEP_UM) + 1):
        state = tick(state, 29, 200.0, 0.0, 0.0)
        seen.append(state[0])
    assert seen[round(WATCHDOG_S * _TICK_HZ) - 1] == 200.0
    assert seen[-1] == 0.0
    assert all(a - b <= STEP_UM + 1e-9 for a, b in itertools.pairwise(seen))
    assert in_force(state) == 0


def test_what_was_dropped_comes_back_only_from_zero() -> None:
    state = start()
    for sequence in range(8, 30):
        state = tick(state, sequence, 200.0, 0.0, 0.0)
    assert in_force(state) == 29
    for _ in range(round(WATCHDOG_S * _TICK_HZ) + 1):
        state = tick(state, 29, 200.0, 0.0, 0.0)
    # While it still ramps, and long after: a full vector would be a jump.
    for sequence in range(30, 100):
        before, state = state, tick(state, sequence, 200.0, 0.0, 0.0)
        assert state[0] == max(before[0] - STEP_UM, 0.0)
        assert in_force(state) == 0
    state = tick(state, 100, 0.0, 0.0, 0.0)
    assert in_force(state) == 100
    assert tick(state, 101, 10.0, 0.0, 0.0)[0] == 10.0


def test_a_client_that_left_at_zero_may_come_back_as_it_likes() -> None:
    state = tick(start(), 8, 0.0, 0.0, 0.0)
    for _ in range(50):
        state = tick(state, 8, 0.0, 0.0, 0.0)
    assert in_force(state) == 8
    assert tick(state, 9, 10.0, 0.0, 0.0)[0] == 10.0


finite = st.floats(-1e6, 1e6, allow_nan=False)


@given(st.lists(st.tuples(st.booleans(), finite, finite, finite), min_size=1, max_size=60))
def test_no_input_leaves_the_limits(steps: list[tuple[bool, float, float, float]]) -> None:
    state, sequence = start(), 7
    for new, x, y, z in steps:
        sequence += new
        before, state = state, tick(state, sequence, x, y, z)
        for axis in range(3):
            assert abs(state[axis]) <= LIMIT_UM
            assert abs(state[axis] - before[axis]) <= STEP_UM + 1e-9


def test_the_program_uses_the_registers_that_the_host_writes() -> None:
    text = correction_program(LIMIT_UM, SLEW_UM_S, WATCHDOG_S)
    assert f"read_input_integer_register({ur_registers.INPUT_SEQUENCE})" in text
    floats = re.findall(r"read_input_float_register\((\d+)\)", text)
    first = ur_registers.INPUT_OFFSET_X
    assert floats == [str(first), str(first + 1), str(first + 2)]
    assert re.findall(r"write_output_float_register\((\d+)", text) == ["17", "18", "19"]
    assert "Not yet run on a controller" in text
    # Every block that is opened is closed.
    opened = re.findall(r"^\s*(?:def|thread|if|while)\b", text, re.MULTILINE)
    assert len(opened) == len(re.findall(r"^\s*end\b", text, re.MULTILINE))


@pytest.mark.parametrize("limits", [(0.0, 1.0, 0.1), (5000.0, 1.0, 0.1), (10.0, 0.0, 0.1), (10.0, 1.0, 0.0)])
def test_limits_that_are_none_are_refused(limits: tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="no limits"):
        correction_program(*limits)
