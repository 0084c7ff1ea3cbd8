"""Prefect's tables in a home that has none, made by Prefect's own migrations in one thread.

Prefect runs them over ``aiosqlite``, which takes each of some 30 000 statements to another thread and back: some 6 s
before a first page, where one thread takes 2.5 s. A server that finds the tables has nothing to migrate.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from sqlite3 import Connection

import sqlalchemy as sa
from alembic.runtime.environment import EnvironmentContext
from alembic.script import ScriptDirectory
from prefect.server.database.alembic_commands import alembic_config
from prefect.server.database.dependencies import provide_database_interface

from dtwin.atomic import whole_file
from dtwin.config import home
from dtwin.locks import locked


def make_missing_tables() -> None:
    """Make the tables of the database that Prefect's settings name, where it is a file that is not there yet."""
    url = sa.make_url(str(provide_database_interface().database_config.connection_url))
    if url.get_backend_name() != "sqlite" or not url.database or Path(url.database).exists():
        return
    # Of two that begin at once, the second must not put its file in the place of one that is in use.
    with locked(home().made().root / "locks" / "prefect-tables.lock", wait=True):
        if not Path(url.database).exists():
            make_tables(Path(url.database))


def make_tables(path: Path) -> None:
    """Make an SQLite file with all of Prefect's tables; it is there whole or not at all."""
    with whole_file(path, "Prefect's database") as begun:
        begun.unlink(missing_ok=True)
        engine = sa.create_engine(f"sqlite:///{begun}")
        sa.event.listen(engine, "connect", _begin_nothing)
        with engine.connect() as connection:
            _migrate(connection)
        engine.dispose()


def _migrate(connection: sa.Connection) -> None:
    """Run all migrations; the arguments are those of Prefect's ``_migrations/env.py``."""
    database, config = provide_database_interface(), alembic_config()
    script = ScriptDirectory.from_config(config)
    script.version_locations = [str(database.orm.versions_dir)]
    environment = EnvironmentContext(config, script, fn=lambda now, _context: script._upgrade_revs("head", now))
    with environment, warnings.catch_warnings():
        # Indexes of expressions are not reflected; Prefect ignores the warning, too.
        warnings.simplefilter("ignore", sa.exc.SAWarning)
        environment.configure(
            connection=connection,
            target_metadata=database.Base.metadata,
            include_schemas=True,
            render_as_batch=True,
            transaction_per_migration=True,
        )
        with environment.begin_transaction():
            environment.run_migrations()
    connection.commit()


def _begin_nothing(connection: Connection, _record: object) -> None:
    """Leave transactions to the statements, as Prefect's engine does; a file that is not there yet needs no syncs."""
    connection.isolation_level = None
    connection.execute("PRAGMA synchronous=OFF")
