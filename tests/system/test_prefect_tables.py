"""The tables that a new home gets at once are those that Prefect's own server would make."""

from __future__ import annotations

import os
import re
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

_BY_PREFECT = "import asyncio; from prefect.server.database import provide_database_interface as d; " + (
    "asyncio.run(d().create_db())"
)
_AT_ONCE = "import sys; from pathlib import Path; from flows._prefect_tables import make_tables; make_tables(Path(sys.argv[1]))"


def made(path: Path, code: str) -> Path:
    """Run what makes the tables in a process of its own, as the server would."""
    env = os.environ | {"PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{path}"}
    subprocess.run([sys.executable, "-c", code, str(path)], env=env, check=True)
    return path


def schema(path: Path) -> dict[tuple[str, str], list[str]]:
    """Return what makes each table and index; the order of constraints is left to chance by Prefect."""
    with sqlite3.connect(path) as connection:
        rows = connection.execute("select type, name, sql from sqlite_master").fetchall()
    return {
        (kind, name): sorted(re.split(r"[,()\s]+CONSTRAINT ", (sql or "").rstrip(" )\n"))) for kind, name, sql in rows
    }


def revision(path: Path) -> list[tuple[str]]:
    """Return the revision that the tables are of."""
    with sqlite3.connect(path) as connection:
        return connection.execute("select version_num from alembic_version").fetchall()


@pytest.mark.long
def test_tables_made_at_once_are_prefects_own_and_of_the_same_revision(tmp_path: Path) -> None:
    theirs = made(tmp_path / "theirs.db", _BY_PREFECT)
    ours = made(tmp_path / "ours.db", _AT_ONCE)
    assert [file.name for file in tmp_path.glob("*.partial")] == []
    found = schema(ours)
    assert found == schema(theirs)
    assert len(found) > 200
    assert revision(ours) == revision(theirs)
