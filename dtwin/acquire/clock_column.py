"""Which column of a table is its clock, and its times in seconds: one reader of heads for logs and tables of poses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from dtwin.acquire.foreign_columns import columns_of, in_english
from dtwin.acquire.time_stamps import seconds_of
from dtwin.schema import Floats

_STAMP = re.compile(
    r"((local |utc )?time ?_?stamp|date[ _/&+]*time|date|datum([ _/&+]*(uhr)?zeit)?|zeitstempel|epoch|unix[ _]?time|(local |utc )?time|(uhr)?zeit|clock|elapsed([ _]time)?|time[ _]elapsed|verstrichene zeit)",
    re.I,
)
FORM = re.compile(r"\s*[\[(]\s*(utc|local|[hdmsyt:./ -]*[:./-][hdmsyt:./ -]*)\s*[\])]\s*$", re.I)
"""Behind the head of stamps: their form, such as hh:mm:ss."""


def of_stamps(head: str) -> bool:
    """Return whether a head in English is that of a time without a unit: of stamps, for numbers might be of minutes."""
    return _STAMP.fullmatch(FORM.sub("", head)) is not None


def numbers_of(cells: Sequence[str]) -> Floats:
    """Return cells as numbers, NaN where one is none."""
    out = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        with suppress(ValueError):
            out[i] = float(cell)
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
    # Day and time may stand apart.
    cells = [" ".join(row[n].strip() for n in stamped) for row in body]
    return times_of_cells(cells, 1.0, where, " ".join(heads[n] for n in stamped), stamps=True)
