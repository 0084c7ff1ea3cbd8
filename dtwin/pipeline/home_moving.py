"""A home from this computer to a shared store, or back: all of it copied and compared before ``home.toml`` changes."""

from __future__ import annotations

import shutil
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from dtwin.atomic import make_folder, write_text, write_toml
from dtwin.bucket import Objects
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.home_file import HOME_FILE, HomeFile, home_file_of
from dtwin.lake.copying import copy_lake
from dtwin.lake.store import Lake
from dtwin.locks import locked
from dtwin.progress import Progress, silent
from dtwin.shared_documents import follow_shared

_COMING = "moving"
"""Folder of a home that holds ``home.toml`` of where it goes while it is being copied."""
_MARK = "moved-from"


@dataclass(frozen=True)
class _Moved:
    """Where a home lies now.

    ``lake_files``, ``registry_rows``: how much was copied or compared.
    ``before``: what is kept of where it lay.
    """

    store: str
    registry: str
    lake_files: int
    registry_rows: int
    before: str


def share(home: Home, stated: Mapping[str, str], progress: Progress = silent) -> _Moved:
    """Copy a local home to a store and a database, and point to them.

    What is local stays where it is. Can be repeated after a kill.

    ``stated``: what ``home.toml`` is going to say.
    Raises ``InputError`` when the home is shared already, or the addresses are not usable.
    Raises ``StoreError`` when something cannot be read or written, or another home lies there.
    """
    target = home_file_of(stated, "dtwin home move")
    bucket = target.bucket
    if home.file.store:
        raise _already("the home is shared already", home, home.file.store)
    if bucket is None:
        raise InputError("no store is named", code="move.store", hint="dtwin home move --store s3://... --registry ...")
    with _alone(home):
        _claim(home, Objects(bucket), str(bucket))
        there = _coming(home, target)
        with Lake(home.lake).at_rest():
            files = copy_lake(home.lake, there.lake, progress)
            rows = _registry(home, there, progress, str(there.mlflow_artifacts))
            follow_shared(home, bucket)
            write_toml(home.root / HOME_FILE, target.as_dict(), "the settings of the home")
        shutil.rmtree(there.root)
    return _Moved(target.store, target.registry, files, rows, str(home.root / "lake"))


def bring_home(home: Home, progress: Progress = silent) -> _Moved:
    """Copy a shared home to this computer, and point to the copy; the store stays as it is.

    A flows database is not copied: Prefect begins a new one here. A registry that is an MLflow server stays the
    registry. Raises as :func:`share`.
    """
    file = home.file
    if not file.store:
        raise _already("the home is local already", home, str(home.root))
    with _alone(home):
        follow_shared(home)
        keeps = HomeFile(registry=file.registry if file.registry.startswith("http") else "")
        there = _coming(home, HomeFile())
        files = copy_lake(home.lake, there.lake, progress)
        artifacts = str(home.root / "mlflow" / "artifacts")
        rows = 0 if keeps.registry else _registry(home, there, progress, artifacts)
        stamp = time.strftime("%Y%m%dT%H%M%S")
        for name in ("lake", "mlflow"):
            if (there.root / name).exists():
                if (home.root / name).exists():
                    (home.root / name).rename(home.root / f"{name}.before-{stamp}")
                (there.root / name).rename(home.root / name)
        (home.root / HOME_FILE).rename(home.root / f"{HOME_FILE}.before-{stamp}")
        if keeps.registry:
            write_toml(home.root / HOME_FILE, keeps.as_dict(), "the settings of the home")
        shutil.rmtree(there.root)
    return _Moved("", keeps.registry, files, rows, file.store)


@contextmanager
def _alone(home: Home) -> Iterator[None]:
    """Hold the lock of moves, and those of the servers and the workbench of this home."""
    busy = InputError(
        "the home is in use, or is being moved",
        code="move.busy",
        where=str(home.root),
        hint="stop dtwin up and other moves of it first",
    )
    with locked(home.root / "locks" / "move.lock") as mine, locked(home.root / "locks" / "up.lock") as stopped:
        if not (mine and stopped):
            raise busy
        yield


def _coming(home: Home, file: HomeFile) -> Home:
    """Return the home that is being made, as one that its settings describe."""
    there = Home(home.root / _COMING)
    make_folder(there.root, private=True)
    if file.as_dict():
        write_toml(there.root / HOME_FILE, file.as_dict(), "the settings of the home")
    else:
        (there.root / HOME_FILE).unlink(missing_ok=True)
    return there


def _claim(home: Home, objects: Objects, where: str) -> None:
    """Mark an empty place as the one of this move; only the same move goes on there."""
    path = home.root / _COMING / _MARK
    if not path.exists():
        write_text(path, uuid.uuid4().hex, "the mark of a move", private=True)
    mine = path.read_bytes()
    if objects.put_new(_MARK, mine) is None:
        if objects.read(_MARK) == mine:
            return
    elif all(stored.name == _MARK or stored.name.startswith("probe/") for stored in objects.list()):
        return
    else:
        objects.delete([_MARK])
    raise InputError(
        "a home lies there already",
        code="move.other",
        where=where,
        hint=f"name a place that is empty; to work on that home, write {HOME_FILE} in an empty DTWIN_HOME",
    )


def _registry(home: Home, there: Home, progress: Progress, artifacts: str) -> int:
    """Copy the registry where it is this home's own; return how many rows."""
    if home.mlflow_uri == there.mlflow_uri:
        return 0
    if home.mlflow_uri.startswith("http") or there.mlflow_uri.startswith("http"):
        if not (home.root / "mlflow" / "mlflow.db").exists() and home.mlflow_uri.startswith("sqlite"):
            return 0
        raise InputError(
            "models are copied from database to database, not through a server",
            code="move.registry",
            where=home.mlflow_uri,
            got=there.mlflow_uri,
            hint="name the server's database: --registry postgresql://...",
        )
    from dtwin.train.registry_copy import copy_registry

    return copy_registry(home, there, artifacts, progress)


def _already(said: str, home: Home, got: str) -> InputError:
    return InputError(said, code="move.already", where=str(home.root), got=got)
