"""What a refusal says."""

from __future__ import annotations

import traceback

from dtwin.errors import InputError, in_a_line


def test_a_slip_is_answered_with_the_name_that_was_meant() -> None:
    error = InputError("no such effect", got="squarness", allowed="backlash, squareness, scale_mismatch")
    assert error.meant == "squareness"
    assert "did you mean: squareness" in error.render()
    assert error.as_dict()["meant"] == "squareness"


def test_nothing_is_guessed_where_no_name_is_near_or_no_names_are_listed() -> None:
    # Of three letters one is much: two exchanged, or one wrong; another number is another name.
    names = "bar, laser, t07"
    assert [InputError("no", got=got, allowed=names).meant for got in ("bra", "bsr", "t70", "t77", "rab")] == [
        "bar",
        "bar",
        "t07",
        None,
        None,
    ]
    assert InputError("no such effect", got="flux", allowed="backlash, squareness").meant is None
    assert InputError("not a number", got="abov 0", allowed="above 0").meant is None
    assert InputError("too many", got="5001", allowed="5000").meant is None
    assert InputError("too slow", got="1 mm/min", allowed="mm/min, such as 1000").meant is None
    assert "meant" not in InputError("broken", got="x").as_dict()


def test_of_very_many_names_a_terminal_shows_the_nearest() -> None:
    names = [f"c{number:04d}" for number in range(1000)]
    error = InputError("no such campaign", got="c05000", allowed=", ".join(names))
    (told,) = [line for line in error.render().splitlines() if line.startswith("  allowed: ")]
    assert told.endswith(" and 988 more")
    assert {"c0500", "c5000"} & set(told.removeprefix("  allowed: ").split(" and ")[0].split(", "))
    assert error.as_dict()["allowed"] == ", ".join(names)


def test_what_would_steer_a_terminal_is_not_printed() -> None:
    shown = InputError("no", got="a\x1b]0;title\x07b\x9b2J\u202e", where="one\ttwo").render()
    assert "a\ufffd]0;title\ufffdb\ufffd2J" in shown
    assert "one\ttwo" in shown


def test_of_a_very_long_name_a_terminal_shows_both_ends() -> None:
    error = InputError("no such file", code="x", where="a" * 1000 + "m" * 1000 + "z" * 1000, got="short")
    said = error.render()
    assert len(said) < 600
    assert "at: " + "a" * 100 in said
    assert "z" * 100 + "\n  got: short" in said
    assert "m" not in said.split("at: ")[1]
    assert error.as_dict()["where"] == error.where


def test_a_name_that_is_there_beside_others_is_not_proposed() -> None:
    assert InputError("no", got="position_mm, steps", allowed="linear: t_s, position_mm, direction").meant is None


def test_a_traceback_says_what_a_terminal_says() -> None:
    error = InputError(
        "no such effect", where="here", got="squarness", allowed="backlash, squareness", hint="look again"
    )
    shown = "".join(traceback.format_exception(error)).splitlines()
    assert shown[-5:] == error.render().splitlines()[1:]
    assert shown[-1] == "  try: look again"


def test_what_a_database_says_is_a_line() -> None:
    said = "(raised as a result of a flush)\n(sqlite3.OperationalError) database or disk is full\n[SQL: CREATE TABLE"
    assert in_a_line(RuntimeError(said)) == "(sqlite3.OperationalError) database or disk is full"
    assert in_a_line(RuntimeError("gone\nfor good")) == "gone"
