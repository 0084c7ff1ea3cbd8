"""What a home holds, and whether all of it is what was written."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtwin.bucket import Objects
from dtwin.config import Home
from dtwin.documents import read_document
from dtwin.errors import DtwinError, InputError, StoreError
from dtwin.lake.store import Lake
from dtwin.machine_record import read_record, recorded
from dtwin.people import AUDIT, audit, damaged_in
from dtwin.progress import Progress, silent
from dtwin.serve.pointer import resolve
from dtwin.serve.sealed import CHAMPION, MACHINE
from dtwin.shared_documents import shared_content, shared_units
from dtwin.train.promotion_books import HISTORY, damaged_in_history

_MOST_LINES = 10


@dataclass(frozen=True)
class _HomeCheck:
    """What was looked at, and what is wrong.

    ``looked_at``: number of runs, documents, records, databases, served bundles and histories; of a shared home also what the
    store has, and models.
    ``wrong``: by file, run or machine.
    """

    looked_at: dict[str, int]
    wrong: dict[str, str]


def home_parts(home: Home) -> dict[str, dict[str, int]]:
    """Return files and bytes of every part of a home, by the name of its folder or file."""
    parts: dict[str, dict[str, int]] = {}
    for entry in sorted(home.root.iterdir()) if home.root.is_dir() else []:
        paths = [entry] if entry.is_file() else [Path(f) / n for f, _, names in os.walk(entry) for n in names]
        sizes = [path.lstat().st_size for path in paths if path.is_file()]
        parts[entry.name] = {"files": len(sizes), "bytes": sum(sizes)}
    return parts


def shared_parts(home: Home) -> dict[str, dict[str, int]]:
    """Return objects and bytes of every part of a home on a shared store; empty for a local one."""
    bucket = home.file.bucket
    parts: dict[str, dict[str, int]] = {}
    for stored in [] if bucket is None else Objects(bucket).list():
        part = parts.setdefault(stored.name.split("/")[0], {"files": 0, "bytes": 0})
        part["files"] += 1
        part["bytes"] += stored.size
    return parts


def check_home(home: Home, progress: Progress = silent) -> _HomeCheck:
    """Read everything that a home has a hash of, and ask its databases."""
    looked_at: dict[str, int] = {}
    wrong: dict[str, str] = {}
    steps = {
        "runs": _runs(home, progress),
        "documents": _documents(home),
        "records": _records(home),
        "databases": _databases(home),
        "served": _served(home),
        "histories": _histories(home),
        **({"shared": _shared(home), "models": _models(home)} if home.file.store else {}),
    }
    for name, findings in steps.items():
        looked_at[name] = 0
        for what, said in findings:
            looked_at[name] += 1
            if said:
                wrong[what] = said
    return _HomeCheck(looked_at, wrong)


def _runs(home: Home, progress: Progress) -> Iterator[tuple[str, str]]:
    lake = Lake(home.lake)
    try:
        rows = lake.runs(left_out=True)
    except DtwinError as error:
        yield "lake", error.message
        return
    for done, row in enumerate(rows, start=1):
        name = f"{row['campaign']}/{row['run_id']}"
        yield name, _said(lake.load, row)
        progress(done, len(rows), name)


def _documents(home: Home) -> Iterator[tuple[str, str]]:
    for folder in ("twins", "kept", "fleet"):
        for path in sorted((home.root / folder).rglob("*.json")):
            yield str(path.relative_to(home.root)), _said(read_document, path)


def _records(home: Home) -> Iterator[tuple[str, str]]:
    for machine in recorded(home):
        yield f"machines/{machine}", _said(read_record, home, machine)


def _databases(home: Home) -> Iterator[tuple[str, str]]:
    for path in sorted(home.root.glob("*/**/*.db")):
        yield str(path.relative_to(home.root)), database_fault(path)


def database_fault(path: Path) -> str:
    """Return what is wrong with a database, empty when nothing is.

    Raises ``StoreError`` when another process holds it.
    """
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as file:
            return "; ".join(row[0] for row in file.execute("PRAGMA integrity_check") if row[0] != "ok")[:300]
    except sqlite3.DatabaseError as error:
        if error.sqlite_errorname.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
            raise StoreError(
                "another process holds a database",
                code="home.busy",
                where=str(path),
                got=str(error),
                hint="run this again when that has ended",
            ) from error
        return str(error)[:300]


def _served(home: Home) -> Iterator[tuple[str, str]]:
    # A machine that has told nothing of itself, as a virtual one, may have a champion all the same.
    for folder in sorted({path.parent for name in (MACHINE, CHAMPION) for path in home.bundles.glob(f"*/{name}")}):
        try:
            served = resolve("latest", folder.name, home)
        except DtwinError as error:
            # That nothing may be served is no damage.
            damaged = not error.code.startswith("serve.")
            yield f"bundles/{folder.name}", error.message if damaged else ""
        else:
            yield f"bundles/{folder.name}", _unregistered(home, folder.name, served.version)


def _unregistered(home: Home, machine: str, version: int) -> str:
    """Return what is wrong with a served version in the registry, empty when nothing is; a host that only serves has none."""
    if not (home.root / "mlflow").is_dir():
        return ""
    from dtwin.train.registry import Registry

    try:
        Registry(home, reads=True).version(machine, str(version))
    except InputError:
        return f"version {version} is served, and the model registry does not know it: nothing can withdraw it"
    except DtwinError as error:
        return f"whether the model registry knows version {version}, which is served, cannot be said: {error.message}"
    return ""


def _histories(home: Home) -> Iterator[tuple[str, str]]:
    """Look at the lines of what only grows: who did what, and what was promoted."""
    if (home.root / AUDIT).exists():
        yield (
            AUDIT,
            _in_lines(
                damaged_in(audit(home)), "a line is cut, or one was changed, taken out or put in, there or before"
            ),
        )
    for path in sorted(home.bundles.glob(f"*/{HISTORY}")):
        damaged = damaged_in_history(home, path.parent.name)
        yield str(path.relative_to(home.root)), _in_lines(damaged, "says nothing; the other lines are read")


def _in_lines(damaged: list[int], what: str) -> str:
    """Return where damaged lines stand, empty when there are none."""
    if not damaged:
        return ""
    more = f" and {len(damaged) - _MOST_LINES} more" if len(damaged) > _MOST_LINES else ""
    return f"line {', '.join(map(str, damaged[:_MOST_LINES]))}{more}: {what}; compare it with a backup"


def _shared(home: Home) -> Iterator[tuple[str, str]]:
    """Compare what the store has of twins, records and bundles with its hashes."""
    bucket = home.file.bucket
    if bucket is not None:
        for unit, files in shared_units(bucket).items():
            for name, digest in files.items():
                yield f"{unit}/{name}".rstrip("/"), _said(shared_content, bucket, digest)


def _models(home: Home) -> Iterator[tuple[str, str]]:
    """Read the bundle of every version in a shared registry."""
    from dtwin.train.registry import Registry

    registry = Registry(home)
    for machine in registry.machines():
        for version in registry.versions(machine):
            if "candidate" in version.tags:
                yield f"model {machine} version {version.version}", _said(registry.bundle, version)


def _said(read: Any, *arguments: Any) -> str:
    """Return why something cannot be read, empty when it can."""
    try:
        read(*arguments)
    except DtwinError as error:
        return f"{error.message}{': ' + error.got if error.got else ''}"[:300]
    return ""
