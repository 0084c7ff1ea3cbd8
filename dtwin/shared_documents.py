"""Twins, records of machines, plans and bundles of a home on a shared store: a working copy here, one truth there.

A twin's folder, a machine's folder of bundles, a record or a plan is one unit. The store has its files by the hash of
their content, and one small list that says which they are. A change is a new list, written on condition that nobody
changed the one that it follows; who comes second takes over what the first did, and adds what does not contradict it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import select
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from dtwin.atomic import whole_file, write_text
from dtwin.bucket import Objects
from dtwin.config import Home
from dtwin.errors import DtwinError, StoreError
from dtwin.home_file import Bucket
from dtwin.locks import locked
from dtwin.processes import process, running_beside

_FOLDERS = ("bundles", "formulas", "machines", "plans", "recipes", "twins")
"""Folders of a home whose entries are shared; others are caches, logs, or of this computer alone."""
_LISTS, _CONTENT = "documents", "content"
_INDEX, _ASIDE = "shared.json", "set-aside"
_EVERY_S, _TRIES, _MAX_LIST = 5.0, 12, 8_000_000
_UNNAMED_FOR = timedelta(days=7)
_NOT_SHARED, _LONGEST = (".lock", ".partial"), 200
_Files = dict[str, str]
"""Hash of the content of each file of a unit."""


@dataclass
class _Known:
    """What the store had of a unit when this home last looked, and what the files looked like then."""

    tag: str = ""
    files: _Files = field(default_factory=dict)
    stamps: dict[str, list[int]] = field(default_factory=dict)


def follow_shared(home: Home, at: Bucket | None = None) -> None:
    """Take over what other computers changed, and give them what changed here; nothing happens in a local home.

    ``at``: the store; the one of the home by default.

    Raises ``StoreError`` when the store does not answer, or another computer changed the same: then what was made here
    lies aside.
    """
    bucket = home.file.bucket if at is None else at
    if bucket is None:
        return
    home.made()
    with locked(home.root / "locks" / "shared.lock", wait=True):
        copy = _Copy(home, Objects(bucket))
        try:
            copy.follow()
        finally:
            copy.keep()


@contextlib.contextmanager
def following(home: Home) -> Iterator[None]:
    """Follow the shared store at the begin, every few seconds, and at the end."""
    if home.file.bucket is None:
        yield
        return
    follow_shared(home)
    over = threading.Event()
    thread = threading.Thread(target=_follow_on, args=(home, over.wait), name="shared store", daemon=True)
    thread.start()
    try:
        yield
    except BaseException:
        over.set()
        thread.join()
        ended = _tried(home)
        if ended is not None:
            print(ended.render(), file=sys.stderr, flush=True)
        raise
    over.set()
    thread.join()
    ended = _tried(home)
    if ended is not None:
        raise ended


@contextlib.contextmanager
def followed_beside(home: Home) -> Iterator[None]:
    """Follow the shared store in a process of its own, for one that has no time for it and needs no store.

    It begins with what is here when the store does not answer.
    """
    if home.file.bucket is None:
        yield
        return
    begun = _tried(home)
    if begun is not None:
        print(begun.render(), file=sys.stderr, flush=True)
    try:
        with running_beside("dtwin.shared_documents", str(home.root)):
            yield
    finally:
        _tried(home)


def _tried(home: Home) -> DtwinError | None:
    try:
        follow_shared(home)
    except DtwinError as error:
        return error
    return None


def _follow_on(home: Home, over: Callable[[float], bool]) -> None:
    said = ""
    while not over(_EVERY_S):
        error = _tried(home)
        text = error.render() if error else ""
        if text and text != said:
            print(text, file=sys.stderr, flush=True)
        said = text


class _Copy:
    """The working copy of one home, while its lock is held."""

    def __init__(self, home: Home, objects: Objects) -> None:
        self.home, self.objects = home, objects
        self.known = self._index()
        self.lost: list[str] = []

    def follow(self) -> None:
        """Bring units of the store and of this home together."""
        tags = {
            unit: stored.tag for stored in self.objects.list(f"{_LISTS}/") if _is_unit(unit := _unit_of(stored.name))
        }
        for unit in sorted({*tags, *self._units()}):
            known = self.known.setdefault(unit, _Known())
            mine = self._seen(unit, known)
            if tags.get(unit, "") == known.tag and mine == known.files:
                continue
            self._joined(unit, known, mine)
        if self.lost:
            raise StoreError(
                "another computer changed the same at the same time, and was first",
                code="shared.conflict",
                where=", ".join(sorted(self.lost))[:300],
                got=f"what was made here lies in {self.home.root / _ASIDE}",
                hint="look at what is there now, and run this again if it is still wanted",
            )

    def _joined(self, unit: str, known: _Known, mine: _Files) -> None:
        for attempt in range(_TRIES):
            theirs, tag = _listed(self.objects, unit)
            merged, lost = _merged(known.files, mine, theirs)
            if lost:
                self._set_aside(unit, lost)
                self.lost.append(unit)
            self._fetched(unit, mine, theirs, merged)
            put = tag if merged == theirs else self._put(unit, merged, tag)
            if put is not None:
                known.tag, known.files = put, merged
                self._seen(unit, known)
                return
            time.sleep(0.05 * (attempt + 1))
            known.files, known.stamps = theirs, {}
            mine = self._seen(unit, known)
        raise StoreError(
            "other computers keep changing the same", code="shared.busy", where=unit, hint="run this again"
        )

    def _put(self, unit: str, merged: _Files, tag: str) -> str | None:
        """Write what the store lacks, then the list; return its tag, None when another computer was faster."""
        folder = self.home.root
        for name, digest in merged.items():
            path = folder / unit / name if name else folder / unit
            data = path.read_bytes()
            if hashlib.sha256(data).hexdigest() == digest:
                self.objects.put_new(f"{_CONTENT}/{digest}", data)
            elif not self.objects.has(f"{_CONTENT}/{digest}"):
                return None
        text = json.dumps(
            {"revision": uuid.uuid4().hex, "who": process(), "files": dict(sorted(merged.items()))}, indent=1
        ).encode()
        name = f"{_LISTS}/{unit}.json"
        return self.objects.replace(name, text, tag) if tag else self.objects.put_new(name, text)

    def _fetched(self, unit: str, mine: _Files, theirs: _Files, merged: _Files) -> None:
        """Write here what the store has anew, and remove what it has no more."""
        place = self.home.root / unit
        for name, digest in merged.items():
            if mine.get(name) == digest:
                continue
            path = place / name if name else place
            if name in theirs and theirs[name] == digest:
                data = _content(self.objects, digest)
            else:
                data = _both_lines(path.read_bytes(), _content(self.objects, theirs[name]))
                merged[name] = hashlib.sha256(data).hexdigest()
            with whole_file(path, "a shared file") as partial:
                partial.touch(mode=0o600)
                partial.write_bytes(data)
        for name in mine.keys() - merged.keys():
            (place / name if name else place).unlink(missing_ok=True)
        if not merged:
            with contextlib.suppress(OSError):
                place.rmdir()

    def _set_aside(self, unit: str, lost: Mapping[str, str]) -> None:
        place = self.home.root / unit
        aside = self.home.root / _ASIDE / f"{time.strftime('%Y%m%dT%H%M%S')}-{uuid.uuid4().hex[:6]}" / unit
        for name in lost:
            path = place / name if name else place
            if path.is_file():
                with whole_file(aside / name if name else aside, "a file set aside") as partial:
                    partial.write_bytes(path.read_bytes())

    def _units(self) -> Iterator[str]:
        """Yield the units that are here or were."""
        yield from self.known
        for folder in _FOLDERS:
            for entry in (self.home.root / folder).glob("*"):
                if _is_unit(f"{folder}/{entry.name}"):
                    yield f"{folder}/{entry.name}"

    def _seen(self, unit: str, known: _Known) -> _Files:
        """Return the hashes of the files of a unit as they were at one moment; those that look as before are not read."""
        place = self.home.root / unit
        while True:
            before = _stamps(place)
            files = {}
            with contextlib.suppress(FileNotFoundError):
                for name, stamp in before.items():
                    same = known.stamps.get(name) == stamp and name in known.files
                    path = place / name if name else place
                    files[name] = known.files[name] if same else hashlib.sha256(path.read_bytes()).hexdigest()
                if _stamps(place) == before:
                    if files == known.files:
                        known.stamps = before
                    return files

    def _index(self) -> dict[str, _Known]:
        path = self.home.root / _INDEX
        try:
            stated = json.loads(path.read_text(encoding="utf-8"))
            if stated.pop("store") == str(self.objects.bucket):
                return {unit: _Known(**kept) for unit, kept in stated["units"].items() if _is_unit(unit)}
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            # Without it every file is compared by its content.
            pass
        return {}

    def keep(self) -> None:
        """Remember what was seen."""
        units = {unit: vars(known) for unit, known in sorted(self.known.items()) if known.tag}
        text = json.dumps({"store": str(self.objects.bucket), "units": units}, indent=1)
        path = self.home.root / _INDEX
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_text(path, text, "what is known of the shared store", private=True)


def shared_units(bucket: Bucket) -> dict[str, _Files]:
    """Return the files of each unit that a store has, by the hash of their content; those of other versions of dtwin, too."""
    objects = Objects(bucket)
    units = [_unit_of(stored.name) for stored in objects.list(f"{_LISTS}/")]
    return {unit: _listed(objects, unit)[0] for unit in units}


def _unit_of(name: str) -> str:
    return name.removeprefix(f"{_LISTS}/").removesuffix(".json")


def drop_unnamed_content(bucket: Bucket) -> int:
    """Remove the content that no list has named for a week, and return how many objects that were.

    Versions that were replaced or removed leave it behind. A list that names it again in the same second would miss
    it; then the computer that wrote the list still has the file.
    """
    objects = Objects(bucket)
    before = datetime.now(UTC) - _UNNAMED_FOR
    old = {stored.name for stored in objects.list(f"{_CONTENT}/") if stored.changed < before}
    # The lists are read last: what was named meanwhile stays.
    named = {f"{_CONTENT}/{digest}" for files in shared_units(bucket).values() for digest in files.values()}
    objects.delete(sorted(old - named))
    return len(old - named)


def shared_content(bucket: Bucket, digest: str) -> bytes:
    """Return the content of a shared file; raises StoreError when it is missing or damaged."""
    return _content(Objects(bucket), digest)


def _listed(objects: Objects, unit: str) -> tuple[_Files, str]:
    """Return the files that the store has of a unit, and the tag of their list; empty for none."""
    name = f"{_LISTS}/{unit}.json"
    try:
        raw, tag = objects.tagged(name)
    except FileNotFoundError:
        return {}, ""
    try:
        files = dict(json.loads(raw)["files"]) if len(raw) <= _MAX_LIST else {"/": ""}
        good = all(_is_name(n) and _is_hash(h) for n, h in files.items()) and ("" not in files or len(files) == 1)
    except (ValueError, TypeError, KeyError, RecursionError):
        files, good = {}, False
    if not good:
        raise StoreError("a list of shared files is damaged", code="shared.list", where=f"{objects.bucket}/{name}")
    return files, tag


def _content(objects: Objects, digest: str) -> bytes:
    try:
        data = objects.read(f"{_CONTENT}/{digest}")
    except FileNotFoundError:
        data = b""
    if hashlib.sha256(data).hexdigest() != digest:
        raise StoreError(
            "a shared file is missing or damaged",
            code="shared.damaged",
            where=f"{objects.bucket}/{_CONTENT}/{digest}",
            hint="a computer that has it writes it again: remove the object, and let that one follow",
        )
    return data


def _merged(base: _Files, mine: _Files, theirs: _Files) -> tuple[_Files, _Files]:
    """Return the files that hold from now on, and those of this home that another computer contradicts.

    Where one file was changed by both, all that was changed here gives way: files of a unit belong together.
    A file of lines that only grows takes the lines of both.
    """
    changed = {n for n in {*base, *mine} if base.get(n) != mine.get(n)}
    both = {n for n in changed if base.get(n) != theirs.get(n) and mine.get(n) != theirs.get(n)}
    grows = {n for n in both if n.endswith(".jsonl") and n in mine and n in theirs}
    if both - grows:
        lost = {n: mine[n] for n in changed if n in mine and mine[n] != theirs.get(n)}
        return dict(theirs), lost
    merged = {n: h for n, h in theirs.items() if n not in changed}
    merged |= {n: mine[n] for n in changed - grows if n in mine}
    return merged | {n: f"{theirs[n]}+" for n in grows}, {}


def _both_lines(mine: bytes, theirs: bytes) -> bytes:
    there = theirs.splitlines(keepends=True)
    return b"".join([*there, *(line for line in mine.splitlines(keepends=True) if line not in there)])


def _stamps(place: Path) -> dict[str, list[int]]:
    """Return size and time of the files of a unit; of one that is a single file, under an empty name."""
    paths = [place] if place.is_file() else [p for p in place.glob("*") if p.is_file() and not p.is_symlink()]
    stamps = {}
    for path in paths:
        name = "" if path == place else path.name
        if _is_name(name):
            with contextlib.suppress(FileNotFoundError):
                state = path.stat()
                stamps[name] = [state.st_size, state.st_mtime_ns, state.st_ino]
    return stamps


def _is_unit(unit: str) -> bool:
    folder, _, name = unit.partition("/")
    return folder in _FOLDERS and bool(name) and _is_name(name)


def _is_name(name: Any) -> bool:
    """Tell whether it is the name of a shared file; a unit that is a single file has it under an empty name."""
    plain = isinstance(name, str) and "/" not in name and (name.isprintable() or not name)
    return plain and not name.startswith(".") and not name.endswith(_NOT_SHARED) and len(name.encode()) <= _LONGEST


def _is_hash(digest: Any) -> bool:
    return isinstance(digest, str) and len(digest) == 64 and set(digest) <= set("0123456789abcdef")


if __name__ == "__main__":
    os.nice(10)
    with contextlib.suppress(KeyboardInterrupt):
        _follow_on(Home(Path(sys.argv[1])), lambda wait_s: bool(select.select([sys.stdin], [], [], wait_s)[0]))
