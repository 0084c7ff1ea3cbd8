"""Times and days as the clock of this computer tells them: times without a zone are of it, and those of other zones are told by it."""

from __future__ import annotations

from datetime import date, datetime, timedelta

_WRITTEN = 2026


def local_time(text: str) -> str:
    """Return an ISO 8601 time with a zone as this computer's clock tells it; one that tells no zone, and what is no time, as it is.

    So texts of times stand in the order of the times, and begin with the day that people here call it.
    """
    try:
        told = datetime.fromisoformat(text)
        here = told.astimezone()
    except (ValueError, OverflowError):
        return text
    return text if told.tzinfo is None or told.utcoffset() == here.utcoffset() else here.isoformat()


def local_day() -> date:
    """Return today, here: in UTC a crash of this morning would be one of yesterday."""
    return datetime.now().astimezone().date()


def is_to_come(text: str) -> bool:
    """Tell whether an ISO 8601 time, which may be empty, lies after today, wherever that is."""
    # The clock of this computer may not be set.
    today = max(local_day(), date(_WRITTEN, 12, 31)) + timedelta(days=1)
    return local_time(text)[:10] > today.isoformat()


def was_set(stamp: date) -> bool:
    """Tell whether a clock that says this was set: one that was not says the first day of some calendar, 1980 the last of them, or a far year."""
    # The clock of this computer may not be set either.
    return 1980 < stamp.year <= max(local_day().year, _WRITTEN) + 1
