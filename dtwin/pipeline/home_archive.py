"""A home as one file, and back: every file hashed, databases copied as of one moment."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import IO, Any

from dtwin import __version__
from dtwin.atomic import make_folder, sync, whole_file
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.home_file import HOME_FILE, moved
from dtwin.lake.store import Lake
from dtwin.pipeline.home_check import database_fault
from dtwin.progress import Progress, silent

_MANIFEST = "dtwin-home.json"
# Made again when missing, of one computer or one start alone, or a secret of its own servers.
_LEFT_OUT = (HOME_FILE, "logs", "reduced", "locks", "servers.json", "prefect-auth", "shared.json")
_SQLITE = b"SQLite format 3\x00"
_OF_SQLITE = ("-wal", "-shm", "-journal")
_MOST_MANIFEST = 500_000_000
_BLOCK = 1 << 20


@dataclass(frozen=True)
class _Archived:
    """A home that was written to a file, or read from one.

    ``path``: the file, or the home that was made.
    ``files``, ``bytes``: what it holds.
    ``left``: folders that killed restores of this home left beside it; nothing else removes them.
    """

    path: Path
    files: int
    bytes: int
    left: tuple[str, ...] = ()


def backup(home: Home, out: Path, progress: Progress = silent) -> _Archived:
    """Write all that a home holds to one file, which only its owner can read.

    Ingests wait meanwhile; databases are copied as of one moment. Caches, logs and locks are left out.

    Raises ``InputError`` when there is no home, or the file is there already.
    Raises ``StoreError`` when something cannot be read or written, or a database is damaged; nothing is left behind.
    """
    if not home.root.is_dir():
        raise InputError("there is no home to back up", code="home.none", where=str(home.root), hint="set DTWIN_HOME")
    if out.exists():
        raise InputError("the file is there already", code="home.exists", where=str(out), hint="give another name")
    entries: dict[str, list[Any]] = {}
    _require_local(home)
    # Where it can only be read nobody writes, and no lock can be made.
    at_rest = Lake(home.lake).at_rest() if os.access(home.root / "lake", os.W_OK) else nullcontext()
    with at_rest, whole_file(out, "the backup") as partial:
        partial.touch(mode=0o600)
        files = list(_files(home.root, partial))
        with tarfile.open(partial, "w", format=tarfile.PAX_FORMAT) as archive:
            for done, path in enumerate(files, start=1):
                name = path.relative_to(home.root).as_posix()
                try:
                    entries[name] = _added(archive, path, name)
                except FileNotFoundError:
                    continue
                progress(done, len(files), name)
            about = {
                "dtwin": __version__,
                "root": str(home.root),
                "made": datetime.now(UTC).isoformat(timespec="seconds"),
            }
            text = json.dumps(about | {"files": entries}, indent=0).encode()
            archive.addfile(_head(_MANIFEST, len(text), 0.0), BytesIO(text))
    return _Archived(out, len(entries), sum(size for size, _ in entries.values()))


def restore(archive: Path, home: Home, progress: Progress = silent) -> _Archived:
    """Make a home from a backup; every file is compared with its hash before the home gets its name.

    Raises ``InputError`` when the home is there already, or the file is no backup.
    Raises ``StoreError`` when a file is damaged, missing or not of the backup; nothing is left behind.
    """
    if home.root.exists() and any(home.root.iterdir()):
        raise InputError(
            "there is a home already", code="home.exists", where=str(home.root), hint="set DTWIN_HOME to a new folder"
        )
    made = home.root.with_name(f".{home.root.name}.{os.getpid()}.restoring")
    make_folder(made, private=True)
    try:
        about = _extracted(archive, made, progress)
        for name in about["files"]:
            if _is_sqlite(made / name):
                moved(made / name, str(about["root"]), str(home.root))
        make_folder(home.root.parent)
        if home.root.exists():
            home.root.rmdir()
        made.rename(home.root)
        sync(home.root.parent)
    except sqlite3.Error as error:
        raise _damaged(archive, f"a database: {error}"[:120], "what was backed up") from error
    except OSError as error:
        raise StoreError(
            "the home cannot be written",
            code="store.write",
            where=str(home.root),
            got=str(error),
            hint="check free space",
        ) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)
    left = tuple(map(str, sorted(home.root.parent.glob(f".{home.root.name}.*.restoring"))))
    return _Archived(home.root, len(about["files"]), sum(size for size, _ in about["files"].values()), left)


def _require_local(home: Home) -> None:
    """Refuse to take for whole what lies here of a home that lies elsewhere."""
    if home.file.as_dict():
        raise InputError(
            "what this home holds lies on a shared store and in shared databases",
            code="home.shared",
            where=str(home.root),
            got=", ".join(home.file.as_dict().values())[:200],
            hint="keep versions of the bucket and copies of the databases there; or dtwin home move --local, then backup",
        )


def _files(root: Path, but: Path) -> Iterator[Path]:
    """Yield what is to be kept, in order.

    A part of the home may be a link, as to a larger disk; one further down could lead anywhere.
    """
    for folder, folders, names in os.walk(root, followlinks=True):
        here = Path(folder)
        if here == root:
            folders[:] = [name for name in folders if name not in _LEFT_OUT]
            names = [name for name in names if name not in _LEFT_OUT]
        elif links := [here / name for name in (*folders, *names) if (here / name).is_symlink()]:
            raise InputError(
                "a link inside a part of the home is not backed up",
                code="home.link",
                where=str(links[0]),
                got=str(links[0].readlink())[:200],
                hint="put what it leads to in its place; a whole part, such as lake, may be a link",
            )
        folders.sort()
        for name in sorted(names):
            path = here / name
            spoilt = name.endswith((".partial", ".lock", *_OF_SQLITE)) or name in (".lock", ".writing")
            if not spoilt and path != but and path.is_file():
                yield path


def _added(archive: tarfile.TarFile, path: Path, name: str) -> list[Any]:
    """Add a file, and return its size and hash; a database that is damaged is refused: its copy would be taken for a sound one."""
    if not (path.suffix == ".db" or _is_sqlite(path)):
        return _written(archive, path, name, path.stat().st_mtime)
    if fault := database_fault(path):
        raise StoreError(
            "a database of the home is damaged, and nothing was backed up",
            code="home.damaged",
            where=str(path),
            got=fault,
            hint="put it back from an older backup; moved away, mlflow.db begins anew, and dtwin repair logs the twins in it",
        )
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.db"
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as live, closing(sqlite3.connect(copy)) as kept:
            live.backup(kept)
        return _written(archive, copy, name, path.stat().st_mtime)


def _written(archive: tarfile.TarFile, path: Path, name: str, changed: float) -> list[Any]:
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        digested = _Digested(file)
        archive.addfile(_head(name, size, changed), digested)
    return [size, digested.digest.hexdigest()]


class _Digested:
    """A file that is hashed as it is read."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.digest = file, hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        block = self.file.read(size)
        self.digest.update(block)
        return block


def _head(name: str, size: int, changed: float) -> tarfile.TarInfo:
    head = tarfile.TarInfo(name)
    head.size, head.mtime, head.mode = size, int(changed), 0o600
    return head


def _is_sqlite(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_SQLITE)) == _SQLITE


def _extracted(archive: Path, into: Path, progress: Progress) -> Mapping[str, Any]:
    """Write the files of a backup, and return its manifest after comparing them."""
    hashes: dict[str, list[Any]] = {}
    about: Mapping[str, Any] | None = None
    try:
        with tarfile.open(archive, "r:") as members:
            for member in members:
                # A sparse one of some bytes may say that it holds a whole disk.
                held = members.extractfile(member) if member.isreg() and not member.issparse() else None
                if held is None:
                    raise _damaged(archive, member.name, "a regular file")
                if member.name == _MANIFEST:
                    about = _manifest(archive, held.read(_MOST_MANIFEST))
                    continue
                hashes[member.name] = _copied(held, _place(archive, into, member.name))
                progress(len(hashes), len(hashes), member.name)
    except (OSError, tarfile.TarError, EOFError) as error:
        raise StoreError(
            "the backup cannot be read", code="home.backup", where=str(archive), got=str(error)[:120]
        ) from error
    if about is None:
        raise _damaged(archive, "no manifest", "a file that dtwin home backup made, whole")
    differs = sorted(n for n in {*hashes, *about["files"]} if hashes.get(n) != about["files"].get(n))
    if differs:
        raise _damaged(archive, ", ".join(differs[:3]), "what was backed up")
    return about


def _place(archive: Path, into: Path, name: str) -> Path:
    """Return where a file of a backup belongs; a name that leads elsewhere is refused."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\0" in name:
        raise _damaged(archive, name[:80], "a name below the home")
    # It may name servers elsewhere, and backup writes none.
    if parts == (HOME_FILE,):
        raise _damaged(archive, name, "what dtwin home backup writes")
    return into.joinpath(*parts)


def _copied(held: IO[bytes], path: Path) -> list[Any]:
    digest, size = hashlib.sha256(), 0
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with path.open("xb") as file:
        path.chmod(0o600)
        while block := held.read(_BLOCK):
            digest.update(block)
            size += file.write(block)
    return [size, digest.hexdigest()]


def _manifest(archive: Path, text: bytes) -> Mapping[str, Any]:
    try:
        about = json.loads(text)
        files = about["files"]
        good = isinstance(about["root"], str) and all(
            isinstance(size, int) and isinstance(digest, str) for size, digest in files.values()
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        good = False
    if not good:
        raise _damaged(archive, _MANIFEST, "a manifest")
    return dict(about)


def _damaged(archive: Path, got: str, allowed: str) -> StoreError:
    return StoreError(
        "the backup is damaged, or none",
        code="home.backup",
        where=str(archive),
        got=got,
        allowed=allowed,
        hint="take an older one; nothing was restored",
    )
