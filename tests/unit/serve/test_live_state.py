"""What the live page says of a machine follows from its newest ticks."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from dtwin.config import Home
from dtwin.links import layout
from dtwin.serve import safety
from dtwin.serve.live_board import live_board, live_state, read_board


def told(
    home: Home, reasons: list[int], later_s: float = 0.0, restarted: int = 0, corrects: bool = True
) -> tuple[str, str]:
    """Write a board of ticks at 100 Hz with these reasons, the first of them before a restart of the controller; what is said of it."""
    with live_board("mill", home, clamp_um=90.0, period_s=0.01, corrects=corrects) as board:
        assert board is not None
        for n, reason in enumerate(reasons):
            state = np.zeros(layout.N)
            state[layout.TIMESTAMP] = n * 0.01 + (9000.0 if n < restarted else 0.0)
            board.show(state, np.zeros(3), reason, (0.01, 0.001, 0.0), (0, 0), np.full(3, np.nan))
        found = live_state(read_board("mill", home), time.monotonic() + later_s)
    return found.word, found.said


@pytest.mark.parametrize(
    ("reasons", "word", "said"),
    [
        ([], "starting", "no tick yet"),
        ([safety.OK] * 50, "correcting", "is being corrected"),
        ([safety.CLAMPED] * 50, "correcting", "is being corrected"),
        (
            [safety.OK] * 60 + [safety.OUTSIDE] * 40,
            "outside",
            "is not corrected now: outside the model's range for 40 %",
        ),
        ([safety.OUTSIDE] * 87 + [safety.OK] * 13, "outside", "for 87 %"),
        ([safety.STALE] * 30 + [safety.LATCHED] * 70, "held", "latched"),
        ([safety.OUTSIDE] * 900 + [safety.OK] * 501, "correcting", "is being corrected"),
        ([safety.OK] * 400 + [safety.STALE] * 90 + [safety.LATCHED], "held", "latched"),
        ([safety.OK] * 440 + [safety.DEVICE] * 60, "held", "device stopped"),
        ([safety.DEVICE] * 440 + [safety.OK] * 60, "correcting", "is being corrected"),
        (
            [safety.OUTSIDE] * 435 + [safety.OK] * 65,
            "correcting",
            "is being corrected, outside the model's range for 87 %",
        ),
    ],
)
def test_what_is_said_is_what_the_newest_seconds_show(tmp_path: Path, reasons: list[int], word: str, said: str) -> None:
    found = told(Home(tmp_path), reasons)
    assert found[0] == word
    assert said in found[1]


def test_what_was_before_a_restart_of_the_controller_is_not_among_the_newest_seconds(tmp_path: Path) -> None:
    reasons = [safety.OK] * 900 + [safety.STALE] * 100
    assert told(Home(tmp_path), reasons, restarted=900) == ("held", "is not corrected now: stale")


def test_a_loop_that_shows_no_new_tick_is_not_said_to_correct(tmp_path: Path) -> None:
    word, said = told(Home(tmp_path), [safety.OK] * 50, later_s=7.0)
    assert word == "silent"
    assert "7 s" in said


def test_a_dry_run_is_not_said_to_correct(tmp_path: Path) -> None:
    said = "is not corrected: a dry run sends zeros"
    assert told(Home(tmp_path), [safety.OK] * 50, corrects=False) == ("held", said)


def test_without_a_board_nothing_is_claimed() -> None:
    assert live_state(None, 0.0).word == "starting"
