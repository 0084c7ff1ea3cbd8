"""Logs with one line a reading, ``NAME DATE TIME VALUE``, as EPICS ``camonitor`` writes them."""

from __future__ import annotations

import csv
import io
import re
from datetime import datetime
from pathlib import Path

import numpy as np

from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError

LINE = re.compile(r"^(\S+)\s+(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d(?:[.,]\d+)?)\s+(\S+)")
_FIRST, _FIRST_LINES = 65_536, 50
_MOST_CELLS = 20_000_000


def is_channel_log(text: str) -> bool:
    """Return whether most of the first lines are ``NAME DATE TIME VALUE``."""
    first = [line for line in text[:_FIRST].splitlines()[:_FIRST_LINES] if line.strip() and not line.startswith("#")]
    return bool(first) and 2 * sum(LINE.match(line) is not None for line in first) > len(first)


def as_table(text: str, path: Path) -> str:
    """Return a log as CSV: ``t [s]`` and a column for each channel of numbers, a row at each stamp.

    A channel holds its value until the next one, as ``camonitor`` tells changes only. The table begins when every channel has a value.

    Raises ``InputError`` when the table would be very much larger than the log.
    """
    stamps: dict[str, list[float]] = {}
    values: dict[str, list[float]] = {}
    for line in text.splitlines():
        match = LINE.match(line)
        number = number_or_none(match[4]) if match else None
        if match is None or number is None:
            continue
        try:
            at = datetime.fromisoformat(f"{match[2]} {match[3].replace(',', '.')}")
        except ValueError:
            continue
        stamps.setdefault(match[1], []).append((at - datetime.min).total_seconds())
        values.setdefault(match[1], []).append(number)
    if not stamps:
        return ""
    begin = max(min(told) for told in stamps.values())
    every = np.unique(np.concatenate([np.array(told) for told in stamps.values()]))
    every = every[every >= begin]
    if len(stamps) * every.size > _MOST_CELLS:
        raise InputError(
            "the log has too many channels and stamps for a table",
            code="channel_log.size",
            where=str(path),
            got=f"{len(stamps)} channels at {every.size} stamps",
            allowed=f"{_MOST_CELLS} values in all",
            hint="write a log of the channels that are needed, or of less time",
        )
    columns = [every - begin]
    for name, told in stamps.items():
        order = np.argsort(told, kind="stable")
        columns.append(np.array(values[name])[order][np.searchsorted(np.array(told)[order], every, side="right") - 1])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["t [s]", *stamps])
    writer.writerows([f"{value:.12g}" for value in row] for row in np.stack(columns, axis=1))
    return out.getvalue()
