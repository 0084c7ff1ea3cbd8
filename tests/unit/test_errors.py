"""What a refusal says."""

from __future__ import annotations

from dtwin.errors import InputError


def test_a_slip_is_answered_with_the_name_that_was_meant() -> None:
    error = InputError("no such effect", got="squarness", allowed="backlash, squareness, scale_mismatch")
    assert error.meant == "squareness"
    assert "did you mean: squareness" in error.render()
    assert error.as_dict()["meant"] == "squareness"


def test_nothing_is_guessed_where_no_name_is_near_or_no_names_are_listed() -> None:
    assert InputError("no such effect", got="flux", allowed="backlash, squareness").meant is None
    assert InputError("not a number", got="abov 0", allowed="above 0").meant is None
    assert "meant" not in InputError("broken", got="x").as_dict()
