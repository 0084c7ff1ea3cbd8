"""What the machine's end may hold, and what may therefore be sent."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtwin.errors import DeviceError
from dtwin.links.layout import SEQUENCE_LIMIT
from dtwin.serve._in_force import InForce

STEP_UM = 4.0


def toward(out: np.ndarray, wanted: np.ndarray, room_um: float) -> np.ndarray:
    change = wanted - out
    length = float(np.linalg.norm(change))
    return out + change * (min(room_um / length, 1.0) if length else 0.0)


@given(
    st.lists(
        st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.integers(0, 4), st.booleans(), st.booleans()),
        min_size=1,
        max_size=200,
    )
)
def test_no_change_at_the_machine_is_longer_than_a_step_whatever_is_held_up(
    script: list[tuple[float, float, int, bool, bool]],
) -> None:
    """Corrections wait in a queue, arrive late, in bursts, or are overwritten by the next one."""
    known, held = InForce(1), np.zeros(3)
    latched, queue = 0, []
    out = np.zeros(3)
    for x, y, arrive, overwritten, reported in script:
        if reported:
            known.report(latched)
        wanted = np.array([x, y, 0.0])
        out = toward(out, wanted, known.room_um(out, STEP_UM)) if known.engaged else np.zeros(3)
        number = known.sent(out, 0.0)
        if overwritten and queue:
            queue[-1] = (number, out)
        else:
            queue.append((number, out))
        # All of these arrive within one tick of the machine: what counts is where it ends.
        before = held
        for _ in range(min(arrive, len(queue))):
            latched, held = queue.pop(0)
        assert np.linalg.norm(held - before) <= STEP_UM * (1 + 1e-9)


def test_zeros_until_the_machine_has_one_of_ours_and_again_after_it_let_go() -> None:
    known = InForce(first_sequence=8)
    assert not known.report(7)
    assert not known.engaged, "what it held when we came"
    assert known.sent(np.zeros(3), 1.0) == 8
    assert not known.report(8)
    assert known.engaged
    known.sent(np.ones(3), 1.1)
    assert known.report(0), "it let go"
    assert not known.engaged
    assert not known.report(0), "once"
    # What was on its way when it let go is none of those that begin at zero.
    known.report(9)
    assert not known.engaged
    assert known.sent(np.zeros(3), 1.2) == 10
    known.report(10)
    assert known.engaged


def test_what_does_not_come_into_force_is_overdue() -> None:
    known = InForce(1)
    known.sent(np.zeros(3), 1.0)
    known.report(1)
    assert known.overdue_s(9.0) == 0.0, "nothing is on its way"
    known.sent(np.zeros(3), 2.0)
    known.sent(np.zeros(3), 2.5)
    assert known.overdue_s(3.0) == pytest.approx(1.0)
    known.report(2)
    assert known.overdue_s(3.0) == pytest.approx(0.5)
    assert known.since_s(3.0) == pytest.approx(0.5)
    assert InForce(1).since_s(3.0) == math.inf


def test_nothing_more_may_go_where_nothing_is_confirmed() -> None:
    known = InForce(1)
    known.sent(np.zeros(3), 0.0)
    known.report(1)
    assert known.room_um(np.zeros(3), STEP_UM) == STEP_UM
    known.sent(np.array([STEP_UM, 0.0, 0.0]), 0.0)
    assert known.room_um(np.array([STEP_UM, 0.0, 0.0]), STEP_UM) == 0.0
    for _ in range(1000):
        known.sent(np.zeros(3), 0.0)
    assert known.room_um(np.zeros(3), STEP_UM) == 0.0


def test_a_number_of_somebody_else_is_a_fault_and_numbers_begin_again() -> None:
    known = InForce(SEQUENCE_LIMIT - 1)
    for number in (SEQUENCE_LIMIT - 1, SEQUENCE_LIMIT, 1, 2):
        assert known.sent(np.zeros(3), 0.0) == number
        known.report(number)
        assert known.engaged
    with pytest.raises(DeviceError, match="another client"):
        known.report(5000)
