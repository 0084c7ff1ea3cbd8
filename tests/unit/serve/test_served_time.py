"""What the journal says of which correction was in force, and when."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.serve._lease import lease
from dtwin.serve.served_time import (
    correction_in_force,
    events_path,
    never_released,
    served_during,
    served_stretches,
    serving_now,
)

BEGIN = datetime(2026, 5, 4, 8, 0, tzinfo=UTC)
A, B = "a" * 64, "b" * 64


def at(seconds: float) -> datetime:
    return BEGIN + timedelta(seconds=seconds)


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path)


def journal(home: Home, *events: tuple[float, str, str] | tuple[float, str, str, dict[str, Any]]) -> None:
    path = events_path(home, "m")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        for seconds, session, what, *more in events:
            line = {"time": at(seconds).isoformat(), "session": session, "event": what}
            file.write(json.dumps(line | (more[0] if more else {})) + "\n")


def live(model: str = A, device: str = "real") -> dict[str, Any]:
    return {"mode": "live", "model_sha256": model, "device": device, "trial": True}


def test_a_session_is_in_force_from_its_beginning_to_its_release(home: Home) -> None:
    journal(home, (10, "s", "serving", live()), (60, "s", "released"), (61, "s", "ended"))
    between = correction_in_force(home, "m")
    assert between(at(20), at(50)) == A
    assert between(at(61), at(90)) == between(at(0), at(9)) == ""
    assert between(at(0), at(20)) == between(at(50), at(70)) == "mixed"
    (stretch,) = served_stretches(home, "m")
    assert (stretch.device, stretch.trial, stretch.end) == ("real", True, at(60))
    assert serving_now(home, "m") == ""


def test_a_lost_link_ends_it_and_a_link_that_comes_back_begins_it(home: Home) -> None:
    journal(
        home,
        (0, "s", "serving", live()),
        (20, "s", "link_lost"),
        (25, "s", "still_lost"),
        (30, "s", "reconnected"),
        (60, "s", "released"),
    )
    between = correction_in_force(home, "m")
    assert between(at(1), at(19)) == between(at(31), at(59)) == A
    assert between(at(21), at(29)) == ""
    assert between(at(10), at(40)) == "mixed"


def test_a_clock_that_is_set_back_makes_no_corrected_run_an_uncorrected_one(home: Home) -> None:
    journal(home, (100, "s", "serving", live()), (75, "s", "clock_set", {"by_s": -40.0}))
    with lease("127.0.0.9", "m", home):
        assert correction_in_force(home, "m")(at(80), at(95)) == A
    journal(home, (98, "s", "released"))
    between = correction_in_force(home, "m")
    assert between(at(80), at(95)) == between(at(101), at(114)) == A
    assert between(at(90), at(120)) == "mixed"
    assert between(at(60), at(70)) == between(at(116), at(120)) == ""


def test_one_model_after_the_other_within_a_run_is_mixed(home: Home) -> None:
    journal(
        home, (0, "s", "serving", live()), (20, "s", "released"), (20, "t", "serving", live(B)), (60, "t", "released")
    )
    between = correction_in_force(home, "m")
    assert between(at(10), at(40)) == "mixed"
    assert between(at(21), at(40)) == B
    with pytest.raises(InputError, match="a part of the run"):
        served_during(served_stretches(home, "m"), at(10), at(40), "r1")


def test_who_looks_on_or_sends_zeros_corrects_nothing(home: Home) -> None:
    journal(
        home,
        (0, "s", "serving", live()),
        (5, "looks", "serving", live(B) | {"mode": "shadow"}),
        (8, "looks", "released"),
        (9, "looks", "ended"),
        (12, "z", "serving", live(B) | {"mode": "dry-run"}),
    )
    with lease("127.0.0.9", "m", home):
        assert correction_in_force(home, "m")(at(1), at(30)) == A
        assert serving_now(home, "m") == A


def test_a_killed_session_and_one_that_never_ended_are_over(home: Home) -> None:
    journal(home, (0, "s", "serving", live()), (20, "s", "killed"))
    assert correction_in_force(home, "m")(at(30), at(40)) == ""
    # A power cut leaves no line at all; the next session holds the lease.
    journal(home, (50, "t", "serving", live()), (100, "u", "serving", live(B)))
    with lease("127.0.0.9", "m", home):
        assert correction_in_force(home, "m")(at(110), at(120)) == B
        assert serving_now(home, "m") == B
    # Nobody holds it: runs from now on are not corrected, though no line says so.
    between = correction_in_force(home, "m")
    begin = datetime.now(UTC) + timedelta(milliseconds=1)
    assert between(begin, begin + timedelta(seconds=9)) == ""
    assert serving_now(home, "m") == ""
    assert never_released(home, "m") == ([at(0), at(50)], at(100))


def test_a_cut_line_and_a_session_of_an_older_version_are_no_evidence(home: Home) -> None:
    journal(home, (0, "s", "serving", {"mode": "live"}), (20, "s", "released"))
    with events_path(home, "m").open("a") as file:
        file.write('{"time": "2026-05-04T08:0')
    (stretch,) = served_stretches(home, "m")
    assert stretch.model_sha256 == ""
    assert served_stretches(home, "other") == []


def test_a_killed_session_is_not_released_until_another_ends(home: Home) -> None:
    journal(home, (0, "s", "serving", live()), (9, "s", "link_lost"), (10, "s", "killed"))
    assert never_released(home, "m") == ([], at(0))
    journal(home, (20, "t", "serving", {"mode": "dry-run"}), (30, "t", "ended"))
    assert never_released(home, "m") == ([], at(0))
    journal(home, (40, "u", "serving", live()), (50, "u", "released"))
    assert never_released(home, "m") == ([at(0)], None)


def test_a_line_of_the_journal_that_is_no_event_is_left_out(home: Home) -> None:
    path = events_path(home, "m")
    path.parent.mkdir(parents=True)
    path.write_text('5\n[1]\n{"time": "2026-05-04T08:00:00", "event": "serving", "mode": "live"}\n', encoding="utf-8")
    journal(home, (0, "s", "serving", live()), (60, "s", "released"))
    assert [(s.begin, s.end) for s in served_stretches(home, "m")] == [(at(0), at(60))]
