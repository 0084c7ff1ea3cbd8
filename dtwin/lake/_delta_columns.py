"""What the log of a Delta table says: columns by sort, files that are live, hashes of both."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator

import pyarrow as pa
from blake3 import blake3
from deltalake.schema import Field, PrimitiveType

from dtwin.errors import StoreError
from dtwin.lake.parquet import NUMBERS
from dtwin.units import unit_of

LIVE = "dtwin.live_blake3"
"""Under this name every commit carries a hash of the files that are live after it."""

# A column is declared as the widest type of its sort; each file keeps the type it was
# written with, and readers cast. So no campaign fixes the width of a column for the others.
_SORTS = {pa.string(): "string", pa.bool_(): "boolean", **dict.fromkeys(NUMBERS, "double")}


def live_hash(names: Iterable[str]) -> dict[str, str]:
    """Return the custom entry of a commit after which these files are live."""
    return {LIVE: content_hash("\n".join(sorted(names)).encode())}


def content_hash(data: bytes | memoryview) -> str:
    """Return the BLAKE3 hash of bytes, in hexadecimal."""
    return str(blake3(data).hexdigest())


def added(entry: str) -> Iterator[str]:
    """Yield the files that a log entry adds."""
    for line in entry.splitlines():
        action = json.loads(line)
        if "add" in action:
            yield str(action["add"]["path"])


def sort_of(field: pa.Field, folder: object) -> str:
    """Return the Delta type that a column is declared as."""
    if field.type not in _SORTS:
        raise StoreError(
            "a column has a type that the lake does not keep",
            code="store.schema",
            where=f"{folder} {field.name}",
            got=str(field.type),
            allowed=", ".join(map(str, _SORTS)),
        )
    return _SORTS[field.type]


def declared(field: pa.Field, folder: object) -> Field:
    """Return the Delta field of a column, with its unit."""
    unit = unit_of(field.name)
    metadata = {} if unit is None else {"unit": unit}
    return Field(field.name, PrimitiveType(sort_of(field, folder)), nullable=True, metadata=metadata)
