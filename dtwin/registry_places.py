"""The folder of its artifacts that a database of MLflow names: it keeps the whole path of each."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

PLACES = ("artifact_location", "artifact_uri", "source", "storage_location")
"""Columns that hold such paths."""
_HEADS = ("", "file://")


def moved(database: Path, before: str, now: str) -> None:
    """Let a database name the folder ``now`` where it named the folder ``before``."""
    if before == now:
        return
    with closing(sqlite3.connect(database)) as file, file:
        tables = [row[0] for row in file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        for table in tables:
            columns = [row[1] for row in file.execute(f'PRAGMA table_info("{table}")')]
            for column in (c for c in columns if c in PLACES):
                for head in _HEADS:
                    old, new = f"{head}{before}/", f"{head}{now}/"
                    file.execute(
                        f'UPDATE "{table}" SET "{column}" = ? || substr("{column}", ?) '
                        f'WHERE substr("{column}", 1, ?) = ?',
                        (new, len(old) + 1, len(old), old),
                    )


def brought_here(database: Path, artifacts: Path) -> None:
    """Let the database of a home that was copied or renamed name the artifacts beside it.

    A copy would go on to write into the home that it was made from, and a renamed home would find none.

    ``artifacts``: where this home keeps them; without that folder nothing is changed.
    """
    if not artifacts.is_dir():
        return
    with closing(sqlite3.connect(database)) as file:
        if not file.execute("SELECT 1 FROM sqlite_master WHERE name = 'experiments'").fetchone():
            return
        named = [str(row[0]) for row in file.execute("SELECT DISTINCT artifact_location FROM experiments")]
    own = f"/{artifacts.parent.name}/{artifacts.name}"
    for before in {place.removeprefix(_HEADS[1]) for place in named}:
        # By a link the same folder has two names, and both are right.
        same = Path(before).is_dir() and Path(before).samefile(artifacts)
        if before.endswith(own) and not same:
            moved(database, before.removesuffix(own) + f"/{artifacts.parent.name}", str(artifacts.parent))
