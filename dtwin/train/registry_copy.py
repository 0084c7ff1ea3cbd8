"""Models, runs and their artifacts in another registry: row by row, and each artifact by its hash."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mlflow.store.model_registry.dbmodels.models
import mlflow.store.tracking.dbmodels.models  # noqa: F401
from mlflow.store.db.base_sql_model import Base
from sqlalchemy import Connection, Engine, Integer, Table, create_engine, func, inspect, select, text
from sqlalchemy.exc import SQLAlchemyError

from dtwin.atomic import whole_file
from dtwin.bucket import Objects
from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.home_file import PLACES, Bucket
from dtwin.progress import Progress, silent
from dtwin.train.registry import Registry

_ROWS = 1000
_Row = dict[str, Any]


def copy_registry(source: Home, target: Home, artifacts: str, progress: Progress = silent) -> int:
    """Copy all of a registry's database and artifacts, and return how many rows; can be repeated.

    ``artifacts``: where the artifacts are going to lie when the copy is in force.
    Raises ``StoreError`` when the target holds other models, or something cannot be read or written, or differs
    afterwards.
    """
    for home in (source, target):
        # Makes the tables, of the version of MLflow that runs here.
        Registry(home).experiment()
    _copy_artifacts(source.mlflow_artifacts, target.mlflow_artifacts, progress)
    before, now = str(source.mlflow_artifacts), artifacts
    try:
        with _opened(source) as old, _opened(target) as new, old.connect() as reading, new.begin() as writing:
            tables = _tables(old, new)
            if _digests(writing, tables, "", "") != _digests(reading, tables, before, now):
                _require_empty(writing, target)
                _copy_rows(reading, writing, tables, before, now)
                if _digests(writing, tables, "", "") != _digests(reading, tables, before, now):
                    raise StoreError("the copied registry differs", code="move.differs", where=target.mlflow_uri)
            return sum(int(reading.execute(select(func.count()).select_from(table)).scalar_one()) for table in tables)
    except SQLAlchemyError as error:
        raise StoreError(
            "the registry cannot be copied",
            code="move.registry",
            where=target.mlflow_uri,
            got=str(error).split("\n")[0][:200],
            hint="nothing was changed there; run this again",
        ) from error


@contextlib.contextmanager
def _opened(home: Home) -> Iterator[Engine]:
    engine = create_engine(home.mlflow_uri)
    try:
        yield engine
    finally:
        engine.dispose()


def _tables(old: Engine, new: Engine) -> list[Table]:
    """Return the tables of both, each after those that it refers to."""
    there = set(inspect(old).get_table_names()) & set(inspect(new).get_table_names())
    return [table for table in Base.metadata.sorted_tables if table.name in there]


def _require_empty(there: Connection, target: Home) -> None:
    models = there.execute(text("SELECT count(*) FROM registered_models")).scalar_one()
    runs = there.execute(text("SELECT count(*) FROM runs")).scalar_one()
    if models or runs:
        raise StoreError(
            "the registry there holds models already",
            code="move.other",
            where=target.mlflow_uri,
            got=f"{models} models, {runs} runs",
            allowed="an empty database",
            hint="make another database",
        )


def _copy_rows(reading: Connection, writing: Connection, tables: list[Table], before: str, now: str) -> None:
    for table in reversed(tables):
        writing.execute(table.delete())
    for table in tables:
        rows: list[_Row] = []
        for row in _rows(reading, table, before, now):
            rows.append(row)
            if len(rows) == _ROWS:
                writing.execute(table.insert(), rows)
                rows = []
        if rows:
            writing.execute(table.insert(), rows)
        if writing.dialect.name == "postgresql":
            _count_on(writing, table)


def _count_on(writing: Connection, table: Table) -> None:
    """Let a database that numbers rows itself go on after those that were copied."""
    for column in table.primary_key.columns:
        if not isinstance(column.type, Integer):
            continue
        sequence = writing.execute(select(func.pg_get_serial_sequence(table.name, column.name))).scalar_one()
        highest = writing.execute(select(func.max(column))).scalar_one()
        if sequence and highest is not None:
            writing.execute(select(func.setval(sequence, max(int(highest), 1))))


def _rows(reading: Connection, table: Table, before: str, now: str) -> Iterator[_Row]:
    """Yield rows, with addresses of artifacts as they are at the target."""
    for row in reading.execute(table.select()).mappings():
        out = dict(row)
        for name in PLACES:
            value = out.get(name)
            if isinstance(value, str) and before:
                for head in ("file://", ""):
                    if value == head + before or value.startswith(f"{head}{before}/"):
                        out[name] = now + value[len(head + before) :]
        yield out


def _digests(reading: Connection, tables: list[Table], before: str, now: str) -> dict[str, str]:
    """Return a hash of the rows of each table, whatever their order."""
    digests = {}
    for table in tables:
        total, count = 0, 0
        for row in _rows(reading, table, before, now):
            total ^= int.from_bytes(hashlib.sha256(repr(sorted(row.items())).encode()).digest())
            count += 1
        digests[table.name] = f"{count} {total:x}"
    return digests


def _copy_artifacts(source: Path | Bucket, target: Path | Bucket, progress: Progress) -> None:
    names = _names(source)
    for done, name in enumerate(names, start=1):
        content = _read(source, name)
        try:
            there = _read(target, name)
        except FileNotFoundError:
            there = None
        if there != content:
            _write(target, name, content)
            if _read(target, name) != content:
                raise StoreError(
                    "an artifact differs after it was copied", code="move.differs", where=f"{target}/{name}"
                )
        progress(done, len(names), name)


def _names(place: Path | Bucket) -> list[str]:
    if isinstance(place, Bucket):
        return [stored.name for stored in Objects(place).list()]
    return sorted(path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file())


def _read(place: Path | Bucket, name: str) -> bytes:
    return Objects(place).read(name) if isinstance(place, Bucket) else (place / name).read_bytes()


def _write(place: Path | Bucket, name: str, content: bytes) -> None:
    if isinstance(place, Bucket):
        Objects(place).put(name, content)
        return
    with whole_file(place / name, "an artifact") as partial:
        partial.write_bytes(content)
