"""Which column of a table is its clock, and times of rows as loggers and spreadsheets write them: dates, times of day, days of a spreadsheet, seconds of Unix."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timedelta

import numpy as np

from dtwin.acquire.foreign_columns import columns_of, in_english, is_number
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.local_time import was_set
from dtwin.schema import Floats

FORMS = "ISO 8601, 31.12.2026 08:00, 12/31/2026 8:00:00 PM, 31-Dec-2026 08:00:00, 14:03:05, a date as days of a spreadsheet, or seconds of Unix"
_OF_DAY = r"(\d{1,3}):(\d\d)(?::(\d\d)(?:[.,:](\d+))?)?\s*([ap]\.?m\.?)?"
_STAMP = re.compile(rf"(\d{{1,4}})([./-])(\d{{1,2}})\2(\d{{1,4}})(?:[ T,-]+{_OF_DAY})?", re.I)
_CLOCK = re.compile(_OF_DAY, re.I)
_EASTERN = re.compile(r"(\d{4})年(\d{1,2})月(\d{1,2})日")
_DATED, _ORDER = re.compile(r"date|datum", re.I), re.compile(r"(?<![a-z])(dd?\W?mm?|mm?\W?dd?)\W?yy", re.I)
_HOURS = re.compile(r"uhr|clock|of day|h:mm", re.I)
_NAMED = ("%d-%b-%Y %H:%M:%S", "%d %b %Y %H:%M:%S", "%d-%b-%Y %H:%M", "%b %d, %Y %I:%M:%S %p")
_DAY_S, _PIVOT = 86_400.0, 70
# Days since the 30th December 1899, from 1995 to 2064.
_SPREADSHEET = (34_700.0, 60_200.0)
# From 2015 to 2033, in seconds and their thousandths.
_UNIX = (1.42e9, 2e9)
_UNIX_PARTS = (1.0, 1e3, 1e6, 1e9)
_FIRST_DAY, _FIRST_SECOND = datetime(1899, 12, 30), datetime(1970, 1, 1)


def seconds_of(cells: Sequence[str], where: str, head: str = "") -> tuple[Floats, str]:
    """Return times (n,) in seconds after the first one, NaN where a cell holds none, and the first as ISO 8601; empty where no date tells.

    Numbers are taken only for what they can be nothing else by their size. Of dates with strokes or hyphens the file must settle whether the
    day or the month stands first, by a number above 12 or in its head, unless it makes no difference.

    ``head``: where it says that a date stands there, numbers may be days of a spreadsheet; ``dd/mm/yyyy`` in it
    tells the order.

    Raises ``InputError`` when days and months may be exchanged.
    """
    told = [_EASTERN.sub(r"\1-\2-\3", cell.strip()) for cell in cells]
    numbers = np.array([float(cell) if is_number(cell) else math.nan for cell in told])
    if np.isfinite(numbers).any():
        return _of_numbers(numbers, dated=_DATED.search(head) is not None)
    if (clock := _of_clock(told, hours=_HOURS.search(head) is not None)) is not None:
        return clock, ""
    parted = [_STAMP.fullmatch(cell) for cell in told]
    said = _ORDER.search(head)
    orders = (True, False) if said is None else (said[0][0].lower() == "d",)
    ways = [_of_dates(told, parted, day_first=first) for first in orders]
    # Every date of three numbers is one in the order of the file.
    stamps = [
        _after(times)
        for times in ways
        if any(time is not None for time in times)
        and all(time is not None for time, match in zip(times, parted, strict=True) if match is not None)
    ]
    if not stamps:
        return np.full(len(cells), math.nan), ""
    if len(stamps) > 1 and not np.array_equal(stamps[0][0], stamps[1][0], equal_nan=True):
        raise InputError(
            "days and months cannot be told apart",
            code="time.day_or_month",
            where=where,
            got=next(cell for cell in told if cell)[:40],
            allowed="a date with a day above 12 in the file, or 2026-12-31, or 31.12.2026",
            hint="write the dates as 2026-12-31",
        )
    return stamps[0][0], stamps[0][1] if len({start for _, start in stamps}) == 1 else ""


def _of_numbers(numbers: Floats, *, dated: bool) -> tuple[Floats, str]:
    """Return days of a spreadsheet or parts of seconds of Unix as seconds; NaN where their size does not tell."""
    there = numbers[np.isfinite(numbers)]
    low, high = float(there.min()), float(there.max())
    if dated and _SPREADSHEET[0] < low and high < _SPREADSHEET[1]:
        # To the microsecond, of which a day as a number has no more.
        start = _FIRST_DAY + timedelta(days=float(there[0]))
        return np.round((numbers - there[0]) * _DAY_S, 6), start.isoformat(timespec="seconds")
    for parts in _UNIX_PARTS:
        if _UNIX[0] * parts < low and high < _UNIX[1] * parts:
            start = _FIRST_SECOND + timedelta(seconds=float(there[0] / parts))
            return (numbers - there[0]) / parts, f"{start.isoformat(timespec='seconds')}+00:00"
    return np.full(numbers.size, math.nan), ""


def _of_clock(cells: Sequence[str], *, hours: bool) -> Floats | None:
    """Return times of day as seconds after the first, over midnight too; None when a cell is none.

    ``hours``: whether the head says that ``08:15`` are hours and minutes; else it may be minutes and seconds.
    """
    clocks = [_CLOCK.fullmatch(cell) for cell in cells]
    told = [match for match in clocks if match is not None]
    if not told or any(match is None and cell for match, cell in zip(clocks, cells, strict=True)):
        return None
    if not hours and any(match[3] is None and match[5] is None for match in told):
        return None
    times = np.array([math.nan if match is None else _second(match, 1) for match in clocks])
    there = np.flatnonzero(np.isfinite(times))
    times[there] += _DAY_S * np.cumsum(np.diff(times[there], prepend=times[there[0]]) < -_DAY_S / 2.0)
    return times - times[there[0]]


def _second(match: re.Match[str], at: int) -> float:
    """Return the second of the day of groups from ``at`` on; NaN when it is none."""
    hour, half = int(match[at]), (match[at + 4] or "").lower()
    if half:
        hour = hour % 12 + (12 if half.startswith("p") else 0) if 1 <= hour <= 12 else 1000
    minute, second = int(match[at + 1]), int(match[at + 2] or 0)
    if hour >= 1000 or minute > 59 or second > 60:
        return math.nan
    return hour * 3600.0 + minute * 60.0 + second + float(f"0.{match[at + 3] or 0}")


def _of_dates(
    cells: Sequence[str], parted: Sequence[re.Match[str] | None], *, day_first: bool
) -> list[datetime | None]:
    return [
        _dated(match, day_first=day_first) if match is not None else _iso(cell)
        for cell, match in zip(cells, parted, strict=True)
    ]


def _iso(cell: str) -> datetime | None:
    with suppress(ValueError):
        return datetime.fromisoformat(cell)
    for form in _NAMED if any(letter.isalpha() for letter in cell) else ():
        with suppress(ValueError):
            return datetime.strptime(cell, form)
    return None


def _dated(match: re.Match[str], *, day_first: bool) -> datetime | None:
    """Return a date of three numbers; dots say that the day stands first, four digits where the year does."""
    first, mark, second, third = match[1], match[2], int(match[3]), match[4]
    if len(first) == 4:
        year, month, day = int(first), second, int(third)
    elif len(third) == 4 or (mark == "." and len(third) == 2):
        year = int(third) if len(third) == 4 else int(third) + (2000 if int(third) < _PIVOT else 1900)
        day, month = (int(first), second) if day_first or mark == "." else (second, int(first))
    else:
        return None
    seconds = 0.0 if match[5] is None else _second(match, 5)
    try:
        return datetime(year, month, day) + timedelta(seconds=seconds)
    except (ValueError, OverflowError):
        return None


def _after(times: Sequence[datetime | None]) -> tuple[Floats, str]:
    """Return seconds after the first, and that one where the clock was set; of some with a time zone and some without, NaN."""
    first = next(time for time in times if time is not None)
    out = np.full(len(times), math.nan)
    for n, time in enumerate(times):
        if time is not None and (time.tzinfo is None) == (first.tzinfo is None):
            out[n] = (time - first).total_seconds()
    return out, first.isoformat() if was_set(first) else ""


_STAMP_HEAD = re.compile(
    r"((local |utc )?time ?_?stamp|date[ _/&+]*time|date|datum([ _/&+]*(uhr)?zeit)?|zeitstempel|epoch|unix[ _]?time|(local |utc )?time|(uhr)?zeit|clock|elapsed([ _]time)?|time[ _]elapsed|verstrichene zeit)",
    re.I,
)
FORM = re.compile(r"\s*[\[(]\s*(utc|local|[hdmsyt:./ -]*[:./-][hdmsyt:./ -]*)\s*[\])]\s*$", re.I)
"""Behind the head of stamps: their form, such as hh:mm:ss."""


def of_stamps(head: str) -> bool:
    """Return whether a head in English is that of a time without a unit: of stamps, for numbers might be of minutes."""
    return _STAMP_HEAD.fullmatch(FORM.sub("", head)) is not None


def numbers_of(cells: Sequence[str]) -> Floats:
    """Return cells as numbers, NaN where one is none."""
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if (value := number_or_none(cell)) is not None:
            out[i] = value
    return out


def times_of_cells(cells: Sequence[str], unit_s: float, where: str, head: str, *, stamps: bool) -> Floats | None:
    """Return times in seconds: numbers of ``unit_s``, or stamps; ``stamps``: numbers have no unit. None where most tell none.

    Raises ``InputError`` when days and months of stamps may be exchanged.
    """
    there = sum(bool(cell.strip()) for cell in cells)
    numbers = numbers_of(cells) * unit_s
    if not stamps and 2 * np.isfinite(numbers).sum() > there:
        return numbers
    times = seconds_of(cells, where, head)[0]
    return times if 2 * np.isfinite(times).sum() > there else None


def clock_of(
    heads: Sequence[str], units: Sequence[str] | None, body: Sequence[Sequence[str]], where: str
) -> Floats | None:
    """Return the times of the rows by the first head that tells a unit of time, else by heads of stamps; None without one.

    ``units``: of a row below the heads.
    """
    told = next(((n, c.factor) for n, c in enumerate(columns_of(heads, units, {})) if c.name == "t_s"), None)
    if told is not None:
        number, unit_s = told
        return times_of_cells([row[number] for row in body], unit_s, where, heads[number], stamps=False)
    stamped = [n for n, head in enumerate(heads) if of_stamps(in_english(head))]
    if not stamped:
        return None
    # Day and time may stand apart; behind an apostrophe a spreadsheet leaves a stamp as it is.
    cells = [" ".join(row[n].strip().lstrip("'") for n in stamped) for row in body]
    return times_of_cells(cells, 1.0, where, " ".join(heads[n] for n in stamped), stamps=True)


def newest_first(t_s: Floats | None) -> bool:
    """Return whether rows stand in the opposite order of their times, as loggers that show the newest reading first write them."""
    if t_s is None:
        return False
    there = t_s[np.isfinite(t_s)]
    return there.size > 1 and bool(there[0] > there[-1])
