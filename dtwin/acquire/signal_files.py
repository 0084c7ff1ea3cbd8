"""High-rate signal files: one Parquet file per device and run, on the device's own clock."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from dtwin.errors import InputError, StoreError
from dtwin.lake.parquet import columns_of, read_encoded, table_of, write_parquet
from dtwin.schema import Encoded, SignalGroup, require_name
from dtwin.units import require_units

_KEY = b"dtwin.signals"


def write_signals(path: Path, group: SignalGroup) -> int:
    """Write one device's signals and return the size in bytes.

    Parameters
    ----------
    path : Path
        A ``.parquet`` file.
    group : SignalGroup
        Signals of one device during one run.
    """
    floats = [name for name, values in group.columns.items() if values.dtype.kind == "f"]
    require_units(floats, str(path))
    head = {"group": group.name, "rate_hz": group.rate_hz, "start_s": group.start_s}
    table = table_of(group.columns)
    kept = table.schema.metadata or {}
    return write_parquet(path, table.replace_schema_metadata(kept | {_KEY: json.dumps(head)}))


def read_signals(path: Path) -> list[SignalGroup]:
    """Read a signal file.

    A file without dtwin's own header needs a ``t_s`` column from which the rate is taken.

    ``path``: a ``.parquet`` file.
    Raises ``InputError`` when the file is missing, damaged, or does not say its rate.
    """
    try:
        table, data = read_encoded(path)
    except StoreError as error:
        raise InputError(
            "the signal file cannot be read", code="signals.unreadable", where=str(path), got=error.got, hint=error.hint
        ) from error
    header = (table.schema.metadata or {}).get(_KEY)
    require_units([n for n in table.column_names if _is_float(table, n)], str(path))
    columns = columns_of(table)
    if header is not None:
        return [_from_header(header, columns, data, path)]
    if "t_s" not in columns or len(columns["t_s"]) < 2:
        raise InputError(
            "the signal file does not say its rate", code="signals.rate", where=str(path), hint="add a column t_s"
        )
    t_s = columns.pop("t_s")
    span = float(t_s[-1] - t_s[0])
    if not 0 < span < math.inf:
        raise InputError("the clock of the signals stands or runs back", code="clock", where=str(path))
    name = require_name(path.stem.split(".")[-1], f"the signal group of {path.name}")
    return [SignalGroup(name, (len(t_s) - 1) / span, columns, float(t_s[0]))]


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


def _is_float(table: pa.Table, name: str) -> bool:
    return bool(pa.types.is_floating(table.schema.field(name).type))
