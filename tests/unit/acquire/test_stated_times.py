"""Times of tests: their text begins with the day, whatever form of ISO 8601 stated it."""

from __future__ import annotations

from datetime import date

import pytest

from dtwin.acquire._stated import instrument, iso_time
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named


@pytest.mark.parametrize(
    ("stated", "kept"),
    [
        ("", ""),
        ("2026-03-02T08:00:00Z", "2026-03-02T08:00:00Z"),
        ("2026-03-02 08:00:00", "2026-03-02 08:00:00"),
        ("20260302T080000Z", "2026-03-02T08:00:00+00:00"),
        ("2026-W10-1", "2026-03-02T00:00:00"),
    ],
)
def test_a_time_is_kept_as_stated_where_its_day_can_be_read(stated: str, kept: str) -> None:
    assert iso_time(stated, "started", "file") == kept


@pytest.mark.parametrize(
    "stated", ["yesterday", 5, True, None, "0001-01-01T00:00:00", "1970-01-01T00:00:10Z", "2126-03-02"]
)
def test_what_is_no_time_of_a_test_is_refused(stated: object) -> None:
    with pytest.raises(InputError, match="started"):
        iso_time(stated, "started", "file")
    with pytest.raises(InputError, match="calibrated_on"):
        instrument({"calibrated_on": stated}, kind_named("circular"), "file")
    told = instrument({"calibrated_on": date(2026, 3, 2)}, kind_named("circular"), "file")
    assert told == {"calibrated_on": "2026-03-02"}
