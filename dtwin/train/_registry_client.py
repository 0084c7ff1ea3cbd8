"""The client of a home's model registry: its database is made, asked whether it answers, and only then used."""

from __future__ import annotations

import json
import logging
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from mlflow.store.entities import PagedList
from mlflow.utils.credentials import get_default_host_creds
from mlflow.utils.rest_utils import http_request
from sqlalchemy import create_engine, text
from sqlalchemy.exc import SQLAlchemyError

from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.home_file import brought_here
from dtwin.locks import locked
from dtwin.processes import within

_CONNECT_S = 10
# A server that is under load answers late.
_ANSWER_S = 30
# One call is at most some requests, or a file that is sent or fetched.
_CALL_S, _LONGEST_ANSWER = 300, 1_000_000
# Other computers make tables for some seconds; the number is any that nobody else has.
_TABLES_S, _TABLES_LOCK = 60, 7_236_541_009
_Found = TypeVar("_Found")


def client_of(home: Home, *, reads: bool = False) -> MlflowClient:
    """Return MLflow's client of a home.

    ``reads``: nothing will be written, so the home need not be writable; a registry that is not there is an empty one.
    Raises ``StoreError`` when its database cannot be written, or does not answer.
    """
    logging.getLogger("mlflow").setLevel(logging.WARNING)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    # It prints the traceback of an error that is raised all the same.
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
    uri = home.mlflow_uri
    database = Path(uri.removeprefix("sqlite:///")) if uri.startswith("sqlite:///") else None
    if reads and database is not None and not database.exists():
        uri, database = "sqlite://", None
    only_reads = reads and database is not None and not os.access(database.parent, os.W_OK)
    if database is not None:
        try:
            if not only_reads:
                home.made()
                database.parent.mkdir(parents=True, exist_ok=True)
                database.touch(mode=0o600)
            with closing(sqlite3.connect(database)) as opened:
                opened.execute("PRAGMA schema_version")
        except OSError as error:
            raise StoreError(
                "the model registry cannot be written", code="registry.write", where=uri, got=str(error)
            ) from error
        except sqlite3.DatabaseError as error:
            raise _not_usable(database, error) from error
    if home.file.endpoint:
        # MLflow asks the environment only.
        os.environ.setdefault("MLFLOW_S3_ENDPOINT_URL", home.file.endpoint)
    if uri.startswith("http"):
        # What is logged goes where its user said, and nowhere else.
        os.environ.setdefault("MLFLOW_ALLOW_HTTP_REDIRECTS", "false")
        _require_server(uri)
    # The first client of an empty database makes its tables; two at once would both make them.
    alone = uri.startswith(("sqlite:///", "postgresql")) and not only_reads
    with ExitStack() as held:
        if alone:
            held.enter_context(locked(home.made().root / "locks" / "registry-tables.lock", wait=True))
        if uri.startswith("postgresql"):
            held.enter_context(_alone_at(uri))
        if alone and database is not None and not database.stat().st_size:
            _make_tables(database)
        if alone and database == home.root / "mlflow" / "mlflow.db" and isinstance(home.mlflow_artifacts, Path):
            brought_here(database, home.mlflow_artifacts)
        client = MlflowClient(tracking_uri=uri, registry_uri=uri)
        return cast(MlflowClient, _InTime(client, uri)) if uri.startswith("http") else client


def _make_tables(database: Path) -> None:
    """Make the tables of an empty database beside it, and copy them in one step: MLflow cannot go on with a part of them."""
    begun = database.with_name(f"{database.name}.begun")
    for left in (begun, begun.with_name(f"{begun.name}-journal")):
        left.unlink(missing_ok=True)
    begun.touch(mode=0o600)
    MlflowClient(tracking_uri=f"sqlite:///{begun}", registry_uri=f"sqlite:///{begun}")
    with closing(sqlite3.connect(begun)) as source, closing(sqlite3.connect(database)) as target:
        source.backup(target)
    begun.unlink()


def _not_usable(database: Path, error: sqlite3.DatabaseError) -> StoreError:
    """Say why a database cannot be used: one that another process holds is not damaged."""
    why = getattr(error, "sqlite_errorname", "")
    if why.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return StoreError(
            "another process holds the model registry",
            code="registry.busy",
            where=str(database),
            got=str(error),
            hint="run this again when that has ended",
        )
    if why and not why.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
        return StoreError(
            "the model registry cannot be used",
            code="registry.write",
            where=str(database),
            got=str(error),
            hint="check permissions and free space",
        )
    return StoreError(
        "the database of the model registry is damaged, or none",
        code="registry.damaged",
        where=str(database),
        got=str(error),
        hint="restore it from a backup; moved away, it begins anew, and dtwin repair logs the twins in it",
    )


@contextmanager
def _alone_at(uri: str) -> Iterator[None]:
    """Ask a database whether it answers, where MLflow would try again for minutes and end in a traceback, and be the only client that makes tables there."""
    engine = create_engine(uri, connect_args={"connect_timeout": _CONNECT_S})
    try:
        with engine.begin() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = '{_TABLES_S}s'"))
            # It ends with the transaction, however that ends.
            connection.execute(text(f"SELECT pg_advisory_xact_lock({_TABLES_LOCK})"))
            yield
    except SQLAlchemyError as error:
        raise StoreError(
            "the model registry does not answer",
            code="registry.away",
            where=uri,
            got=str(error).split("\n")[0][:200],
            hint="run this again when it is back; its password: PGPASSWORD or ~/.pgpass",
        ) from error
    finally:
        engine.dispose()


def _require_server(uri: str) -> None:
    """Ask a server for one model: MLflow would try again for minutes, and another server's answer end in a traceback."""
    try:
        got = within(_ANSWER_S, lambda: _said_by(uri))
    except TimeoutError:
        got = f"no whole answer within {_ANSWER_S} s"
    except (ValueError, RecursionError):
        got = "an answer that is not MLflow's"
    except (MlflowException, OSError) as error:
        got = str(error).split("\n")[0].rpartition("with exception ")[2]
    if got:
        raise _away(uri, got)


def _said_by(uri: str) -> str:
    """Return what is wrong with the answer of a server; empty when it is MLflow's."""
    answer = http_request(  # type: ignore[no-untyped-call]
        get_default_host_creds(uri),  # type: ignore[no-untyped-call]
        "/api/2.0/mlflow/registered-models/search",
        "GET",
        params={"max_results": 1},
        max_retries=0,
        timeout=_ANSWER_S,
        raise_on_status=False,
        allow_redirects=False,
        stream=True,
    )
    with answer:
        if answer.status_code != 200:
            to = answer.headers.get("Location", "")
            return f"HTTP {answer.status_code}" + (f", it sends to {to}" if to else "")
        said = b""
        for part in answer.iter_content(65536):
            said += part
            if len(said) > _LONGEST_ANSWER:
                return f"an answer of more than {_LONGEST_ANSWER} bytes"
    return "" if isinstance(json.loads(said), dict) else "an answer that is not MLflow's"


def _away(uri: str, got: str) -> StoreError:
    return StoreError(
        "the model registry does not answer",
        code="registry.away",
        where=uri.rpartition("@")[2],
        got=got[:200],
        hint="its address (MLFLOW_TRACKING_URI, or registry in `home.toml`), and whether it runs; run this again when it is back",
    )


class _InTime:
    """A client whose every call ends within a time: MLflow waits for each byte anew, and a line that is nearly dead sends one now and then."""

    def __init__(self, client: MlflowClient, uri: str) -> None:
        self._client, self._uri = client, uri

    def __getattr__(self, name: str) -> Any:
        call = getattr(self._client, name)

        def in_time(*given: Any, **named: Any) -> Any:
            try:
                return within(_CALL_S, lambda: call(*given, **named))
            except TimeoutError as error:
                raise _away(self._uri, f"{name.replace('_', ' ')} did not end within {_CALL_S} s") from error

        return in_time if callable(call) else call


def every(search: Callable[..., PagedList[_Found]], wanted: str) -> list[_Found]:
    """Return what a search of MLflow finds on all its pages: one holds no more than a hundred models."""
    page = search(filter_string=wanted)
    entries = list(page)
    while page.token:
        page = search(filter_string=wanted, page_token=page.token)
        entries += page
    return entries
