"""``home.toml``: where the parts of a home lie that are shared with other computers. A home without it is all local. A
database of MLflow names the folder of its artifacts itself, with the whole path of each.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from dtwin.atomic import read_toml
from dtwin.errors import NEWER, InputError

HOME_FILE = "home.toml"
_MAX_BYTES = 10_000
_STORE = re.compile(r"s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9](/[A-Za-z0-9_=-][A-Za-z0-9._=-]*)*")


@dataclass(frozen=True)
class Bucket:
    """A folder of an S3-compatible store.

    ``url``: where the home lies: ``s3://bucket/prefix``.
    ``endpoint``: address of the server; empty for what the usual environment says, else Amazon's.
    ``below``: the folder inside the home; empty for all of it.
    """

    url: str
    endpoint: str = ""
    below: str = ""

    def __truediv__(self, name: str) -> Bucket:
        return Bucket(self.url, self.endpoint, f"{self.below}/{name}".strip("/"))

    def __str__(self) -> str:
        return f"{self.url}/{self.below}".rstrip("/")

    @property
    def name(self) -> str:
        """The bucket."""
        return urlsplit(self.url).netloc

    @property
    def prefix(self) -> str:
        """The folder inside the bucket; empty for all of it."""
        return urlsplit(str(self)).path.strip("/")


@dataclass(frozen=True)
class HomeFile:
    """What ``home.toml`` states; what is empty is local.

    ``store``: ``s3://bucket/prefix``: lake, twins, records of machines, bundles.
    ``endpoint``: address of the store's server.
    ``registry``: ``postgresql://host/database``, or an MLflow server's address: models.
    ``flows``: ``postgresql://host/database``: Prefect's runs and schedules.
    """

    store: str = ""
    endpoint: str = ""
    registry: str = ""
    flows: str = ""

    @property
    def bucket(self) -> Bucket | None:
        """The shared store, None where everything is local."""
        return Bucket(self.store, self.endpoint) if self.store else None

    def as_dict(self) -> dict[str, str]:
        """Return what the file holds."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name))}


def read_home_file(root: Path) -> HomeFile:
    """Return what ``home.toml`` of a home states.

    Raises ``InputError`` when it cannot be read, or states what is not known.
    """
    path = root / HOME_FILE
    try:
        state = path.stat()
    except OSError:
        return HomeFile()
    return _read(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=16)
def _read(path: Path, _changed: int, _size: int) -> HomeFile:
    try:
        stated = read_toml(path, _MAX_BYTES)
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(str(path), str(error)[:120], "a TOML file") from error
    return home_file_of(stated, str(path))


def home_file_of(stated: Mapping[str, Any], where: str) -> HomeFile:
    """Check what is stated of a home.

    Raises ``InputError`` when a key or a value is not usable; a password is refused, too: files are copied.
    """
    known = [f.name for f in fields(HomeFile)]
    for key, value in stated.items():
        if key not in known:
            raise _refused(where, str(key)[:40], ", ".join(known), NEWER)
        if not isinstance(value, str) or not value or len(value) > 500:
            raise _refused(f"{where}: {key}", str(value)[:60], "text")
    settings = HomeFile(**stated)
    if settings.store and not _STORE.fullmatch(settings.store):
        raise _refused(f"{where}: store", settings.store, "s3://bucket or s3://bucket/prefix")
    if settings.endpoint and not settings.store:
        raise _refused(f"{where}: endpoint", settings.endpoint, "a store that it is the address of")
    for key, schemes in _ADDRESSES.items():
        _require_address(f"{where}: {key}", getattr(settings, key), schemes)
    if settings.store and not settings.registry:
        raise _refused(f"{where}: registry", "none", "a registry too: versions of twins and models are counted there")
    if settings.registry.startswith("postgresql") and not settings.store:
        raise _refused(f"{where}: registry", settings.registry, "a store too: there its artifacts lie")
    return settings


_ADDRESSES = {"endpoint": ("http", "https"), "registry": ("postgresql", "http", "https"), "flows": ("postgresql",)}


def _require_address(where: str, address: str, schemes: tuple[str, ...]) -> None:
    if not address:
        return
    parts = urlsplit(address)
    try:
        secret, host = parts.password, parts.hostname
    except ValueError:
        secret, host = None, None
    if secret is not None:
        raise InputError(
            "a password stands in the settings of a home",
            code="home.secret",
            where=where,
            hint="PGPASSWORD, or a file .pgpass that only you can read; AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
        )
    if parts.scheme not in schemes or (not host and "host=" not in parts.query):
        raise _refused(where, address, ", ".join(f"{scheme}://..." for scheme in schemes))


def _refused(where: str, got: str, allowed: str, hint: str | None = None) -> InputError:
    return InputError(
        "the settings of a home are not usable", code="home.file", where=where, got=got, allowed=allowed, hint=hint
    )


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
