"""Signal files: one file per device and run, on the device's own clock; Parquet, or a table of text for slow ones."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dtwin.acquire._parquet_file import require_moderate
from dtwin.acquire._readings import usable
from dtwin.acquire.foreign_columns import below_heads, header_row
from dtwin.acquire.foreign_columns import columns_of as named_columns
from dtwin.acquire.repeated_heads import require_heads_for_all
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.table_dialect import decoded, rows_of
from dtwin.acquire.time_stamps import FORMS, seconds_of
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError, StoreError
from dtwin.lake.parquet import NUMBERS, columns_of, read_encoded, table_of, write_parquet
from dtwin.schema import Encoded, SignalGroup, require_name
from dtwin.units import require_units, shown_number

_KEY = b"dtwin.signals"
_TABLES = (".csv", ".txt", ".tsv", ".dat", *SPREADSHEETS)
_MOST_BYTES = 256 * 1024**2
_MOST_VALUES = 2**29


def write_signals(path: Path, group: SignalGroup) -> int:
    """Write one device's signals during one run as a ``.parquet`` file, and return the size in bytes."""
    floats = [name for name, values in group.columns.items() if values.dtype.kind == "f"]
    require_units(floats, str(path))
    head = {"group": group.name, "rate_hz": group.rate_hz, "start_s": group.start_s}
    table = table_of(group.columns)
    kept = table.schema.metadata or {}
    return write_parquet(path, table.replace_schema_metadata(kept | {_KEY: json.dumps(head)}))


def is_table_of_signals(path: Path) -> bool:
    """Return whether a signal file is a table of text or a spreadsheet, which has no header of dtwin's."""
    return path.suffix.lower() in _TABLES


def read_signals(path: Path) -> list[SignalGroup]:
    """Read a signal file.

    A file without dtwin's own header needs a ``t_s`` column from which the rate is taken; in a table of text it may be time stamps.

    ``path``: ``.parquet``, or a table of text or a spreadsheet with a unit in each head.
    Raises ``InputError`` when the file is missing, damaged, or does not say its rate.
    """
    if is_table_of_signals(path):
        return [_group(_from_text(path), path)]
    # What is wrong with a damaged file is said below.
    with suppress(pa.ArrowException, OSError, ValueError):
        require_moderate(path, most_values=_MOST_VALUES)
    try:
        table, data = read_encoded(path)
    except StoreError as error:
        if path.suffix.lower() != ".parquet":
            raise InputError(
                "a file of signals is of no form that is read",
                code="signals.type",
                where=str(path),
                got=path.suffix or "no ending",
                allowed=", ".join((".parquet", *_TABLES)),
                hint="export it as text with a column of times and a unit in each head, such as Time [s], bed x [g]",
            ) from error
        raise InputError(
            "the signal file cannot be read", code="signals.unreadable", where=str(path), got=error.got, hint=error.hint
        ) from error
    header = (table.schema.metadata or {}).get(_KEY)
    _require_numbers(table.schema, path)
    require_units([n for n in table.column_names if _is_float(table, n)], str(path))
    columns = columns_of(table)
    group = _group(columns, path) if header is None else _from_header(header, columns, data, path)
    beyond = next((name for name, values in columns.items() if not (usable(values) | np.isnan(values)).all()), "")
    if beyond or not group.n_samples:
        raise InputError(
            "signals hold numbers that cannot be computed with" if beyond else "the signal file holds no reading",
            code="signals.values",
            where=str(path),
            got=beyond or "no rows, or t_s alone",
            allowed="a column of finite numbers beside t_s; NaN where nothing was read",
            hint="write NaN for what is none" if beyond else "take the file out of signals",
        )
    return [group]


def _from_text(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a table of text, NaN where a cell holds no number; columns without a unit that is known are refused."""
    text = decoded(table_bytes(path, _MOST_BYTES))
    require_heads_for_all(text, path)
    rows = rows_of(text)
    at = header_row(rows, path)
    below, body = below_heads(rows, at)
    heads = [head.strip() for head in rows[at]]
    cells = [[row[n].strip() if n < len(row) else "" for row in body] for n in range(len(heads))]
    known = named_columns(heads, below, {})
    columns = {
        c.name: np.array(
            [np.nan if (v := number_or_none(cell)) is None else c.factor * (v - c.zero) for cell in cells[n]]
        )
        for n, c in enumerate(known)
        if c.name
    }
    unknown = {n: c for n, c in enumerate(known) if not c.name and any(cells[n])}
    if "t_s" not in columns:
        for n in list(unknown):
            t_s, _ = seconds_of(cells[n], f"{path} {heads[n]}", heads[n])
            if np.isfinite(t_s).all():
                columns["t_s"] = t_s
                del unknown[n]
                break
    if unknown:
        raise InputError(
            "a column of signals does not say a unit that is known",
            code="signals.unit",
            where=str(path),
            got="; ".join(f"{c.head}: {c.why_not}" for c in unknown.values())[:200],
            allowed=f"a unit in each head, such as bed_1_c or bed 1 [°C]; times in seconds, or {FORMS}",
        )
    return columns


def _group(columns: dict[str, NDArray[Any]], path: Path) -> SignalGroup:
    if "t_s" not in columns or len(columns["t_s"]) < 2:
        raise InputError(
            "the signal file does not say its rate", code="signals.rate", where=str(path), hint="add a column t_s"
        )
    t_s = columns.pop("t_s")
    span = float(t_s[-1] - t_s[0])
    if not 0 < span < math.inf:
        raise InputError("the clock of the signals stands or runs back", code="clock", where=str(path))
    _require_even(t_s, path)
    stem = path.name.removesuffix(".gz").rpartition(".")[0]
    name = require_name(stem.split(".")[-1], f"the signal group of {path.name}")
    return SignalGroup(name, (len(t_s) - 1) / span, columns, float(t_s[0]))


def _require_even(t_s: NDArray[Any], path: Path) -> None:
    """Refuse a clock that jumps, or has lost readings: of signals the first time and a rate are kept.

    Rows that have one stamp, as those of a coarse clock, may be off by as many of them.
    """
    even_s = np.linspace(t_s[0], t_s[-1], len(t_s))
    step_s, steps_s = even_s[1] - even_s[0], np.diff(t_s)
    most_s = 2.0 * step_s * np.unique(t_s, return_counts=True)[1].max()
    if not (steps_s >= 0.0).all() or not (np.abs(t_s - even_s) <= most_s).all():
        at = int(np.argmax(np.abs(steps_s - step_s)))
        raise InputError(
            "the readings of the signals do not follow each other evenly: the clock jumps, or readings are lost",
            code="signals.clock",
            where=f"{path} reading {at + 2}",
            got=f"{t_s[at + 1]:g} s after {t_s[at]:g} s; a reading every {shown_number(step_s, 4)} s on average",
            allowed="readings at a fixed rate, in the order of their times",
            hint="interpolate lost readings; where t_s is when a block arrived, write when each reading was taken",
        )


def _from_header(header: bytes, columns: dict[str, NDArray[Any]], data: memoryview | None, path: Path) -> SignalGroup:
    try:
        head = json.loads(header)
        name, rate_hz, start_s = str(head["group"]), float(head["rate_hz"]), float(head["start_s"])
        if not (0.0 < rate_hz < math.inf and math.isfinite(start_s)):
            raise ValueError(f"rate_hz {rate_hz}, start_s {start_s}")
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(
            "the signal header is damaged",
            code="signals.header",
            where=str(path),
            got=str(error)[:120],
            allowed="group, a rate_hz above 0, a finite start_s",
        ) from error
    # After an @ stands the direction of the run that the signals belong to.
    require_name(name.rsplit("@", 1)[0], f"the signal group of {path.name}")
    return SignalGroup(
        name=name,
        rate_hz=rate_hz,
        columns=columns,
        start_s=start_s,
        encoded=None if data is None else Encoded(data, columns),
    )


def _require_numbers(schema: pa.Schema, path: Path) -> None:
    """Refuse columns that hold no numbers, or have one name."""
    twice = sorted({name for name in schema.names if schema.names.count(name) > 1})
    strange = [f"{field.name}: {field.type}" for field in schema if field.type not in NUMBERS]
    if twice or strange:
        raise InputError(
            "two columns of signals have one name" if twice else "a column of signals does not hold numbers",
            code="signals.columns",
            where=str(path),
            got=", ".join(twice or strange)[:120],
            allowed="a name for each column" if twice else ", ".join(map(str, NUMBERS)),
            hint="leave words and switches out, and write numbers as double; t_s in seconds",
        )


def _is_float(table: pa.Table, name: str) -> bool:
    return bool(pa.types.is_floating(table.schema.field(name).type))
