"""The tables that a new home gets at once are those that Prefect's own server would make."""

from __future__ import annotations

import json
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

_MADE_AND_USED = f"""{_AT_ONCE}
import json
from alembic.script import ScriptDirectory
from prefect.server.database.alembic_commands import alembic_config
from prefect.server.database.dependencies import provide_database_interface
database, config = provide_database_interface(), alembic_config()
config.set_main_option("version_locations", str(database.orm.versions_dir))
tables = {{t.name: [c.name for c in t.columns] for t in database.Base.metadata.sorted_tables}}
print(json.dumps([ScriptDirectory.from_config(config).get_current_head(), tables]))
"""


def made(path: Path, code: str) -> str:
    """Run what makes the tables in a process of its own, as the server would; return what it says."""
    env = os.environ | {"PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{path}"}
    return subprocess.run(
        [sys.executable, "-c", code, str(path)], env=env, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


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
def test_tables_made_at_once_are_of_the_newest_revision_and_have_what_the_server_uses(tmp_path: Path) -> None:
    ours = tmp_path / "ours.db"
    head, used = json.loads(made(ours, _MADE_AND_USED).splitlines()[-1])
    assert revision(ours) == [(head,)]
    assert len(used) > 30
    with sqlite3.connect(ours) as connection:
        for table, columns in used.items():
            assert set(columns) <= {row[1] for row in connection.execute(f"pragma table_info('{table}')")}, table


@pytest.mark.long
def test_tables_made_at_once_are_prefects_own_and_of_the_same_revision(tmp_path: Path) -> None:
    theirs, ours = tmp_path / "theirs.db", tmp_path / "ours.db"
    made(theirs, _BY_PREFECT)
    made(ours, _AT_ONCE)
    assert [file.name for file in tmp_path.glob("*.partial")] == []
    found = schema(ours)
    assert found == schema(theirs)
    assert len(found) > 200
    assert revision(ours) == revision(theirs)
