"""Data files of one table that are written one by one and committed together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from dtwin.lake.delta import DeltaFiles, Written
from dtwin.lake.parquet import table_of
from dtwin.schema import Encoded


class Batch:
    """Files of one table; their columns are accepted by it before the first is written.

    ``parts``: columns of every file that will be written.
    """

    def __init__(self, table: DeltaFiles, parts: Sequence[Mapping[str, NDArray[Any]]]) -> None:
        self.table = table
        self.written: list[Written] = []
        self.schema = table.accepted([table_of(columns).schema for columns in parts])

    def write(self, stem: str, columns: Mapping[str, NDArray[Any]], encoded: Encoded | None = None) -> str:
        """Write one file, as it was read where its columns were not replaced; return its name."""
        table = table_of(columns)
        if encoded is not None and encoded.columns is columns:
            self.written.append(self.table.write_encoded(stem, encoded.data, table.num_rows))
        else:
            self.written.append(self.table.write(stem, table))
        return self.written[-1].name

    def commit(self) -> None:
        """Make the files live in one step."""
        if self.written:
            self.table.commit(self.written, self.schema)
