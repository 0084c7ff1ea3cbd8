"""Files that a browser drops: collected in a tray, checked, and then ingested."""

from __future__ import annotations

import lzma
import re
import secrets
import shutil
import stat
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import AsyncIterator, Collection
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from dtwin.acquire.spreadsheet import LEFT_BY_SYSTEMS
from dtwin.acquire.spreadsheet import SUFFIXES as SPREADSHEETS
from dtwin.atomic import whole_file
from dtwin.errors import InputError

MAX_TRAY_BYTES = 512 * 1024 * 1024
_MAX_UNPACKED_BYTES = 1024 * 1024 * 1024
_MAX_FILES = 5000
# Uploads that were begun and not ingested; those of yesterday were given up.
_MAX_TRAYS, _GIVEN_UP_S = 50, 24 * 3600.0
_MAX_RATIO = 300
_RATIO_FROM_BYTES = 10 * 1024 * 1024
_MAX_DEPTH, _MAX_PART_BYTES = 4, 200
_CHUNK = 1024 * 1024
_PART = re.compile(r"[\w(\[#][\w .,()+\-&'#=@~!;%°\[\]]{0,119}")
_TABLES = (".csv", ".tsv", ".txt", ".dat", ".md", ".rtl", ".pos", ".parquet", *SPREADSHEETS)
_ALLOWED = "a .b5r, a table (.csv, .xlsx, .txt, .dat, .md, .rtl), a .zip of a table or of a campaign folder, or all files of one with its campaign.toml"


class Trays:
    """Folders that uploads collect in. ``root``: where; what an earlier server left there is removed."""

    def __init__(self, root: Path) -> None:
        self.root = root
        # Of each tray: several files come at once, and what they have together counts.
        self._bytes: Counter[str] = Counter()
        shutil.rmtree(root, ignore_errors=True)

    def new(self) -> str:
        """Open a tray and return its name."""
        trays = list(self.root.iterdir()) if self.root.is_dir() else []
        for old in [tray for tray in trays if time.time() - tray.stat().st_mtime > _GIVEN_UP_S]:
            self.drop(old.name)
            trays.remove(old)
        if len(trays) >= _MAX_TRAYS:
            raise InputError(
                "too many uploads were begun and not ingested",
                code="upload.trays",
                got=str(len(trays)),
                allowed=f"{_MAX_TRAYS}; a day later they are given up",
                hint="ingest what was dropped, or start the workbench again",
            )
        name = secrets.token_hex(8)
        (self.root / name).mkdir(parents=True)
        return name

    def folder(self, name: str) -> Path:
        """Return the folder of a tray."""
        folder = self.root / name
        if not re.fullmatch(r"[0-9a-f]{16}", name) or not folder.is_dir():
            raise InputError(
                "this upload is not known here", code="upload.tray", got=name[:40], hint="drop the files again"
            )
        return folder

    async def receive(self, tray: str, name: str, body: AsyncIterator[bytes]) -> int:
        """Write one file of a tray and return its size.

        ``name``: path as the browser states it.
        """
        folder = self.folder(tray)
        path = folder / safe_path(name)
        present = sum(p.is_file() for p in folder.rglob("*"))
        if present >= _MAX_FILES:
            raise _too_much("files", str(present + 1), str(_MAX_FILES))
        if path.is_dir() or any(p.is_file() for p in path.parents if p.is_relative_to(folder)):
            raise InputError(
                "a file and a folder have one name", code="upload.name", got=repr(name[:120]), hint="rename one of them"
            )
        before, size = path.stat().st_size if path.is_file() else 0, 0
        try:
            with whole_file(path, "the upload") as partial, partial.open("wb") as file:
                async for chunk in body:
                    size += len(chunk)
                    self._bytes[tray] += len(chunk)
                    if self._bytes[tray] - before > MAX_TRAY_BYTES:
                        raise _too_much("bytes", f"more than {MAX_TRAY_BYTES}", f"{MAX_TRAY_BYTES} in all")
                    file.write(chunk)
        except BaseException:
            # Also when the browser goes away.
            self._bytes[tray] -= size
            raise
        self._bytes[tray] -= before
        return size

    def drop(self, tray: str) -> None:
        """Remove a tray and what is in it."""
        self._bytes.pop(tray, None)
        shutil.rmtree(self.root / tray, ignore_errors=True)


def safe_path(name: str) -> PurePosixPath:
    """Return a relative path that stays where it is put. ``name``: as a browser or an archive states it."""
    # Of a Mac the dots of an umlaut come as a letter of their own.
    parts = normalize("NFC", name).replace("\\", "/").split("/")
    if len(parts) > _MAX_DEPTH or not all(_PART.fullmatch(p) and len(p.encode()) <= _MAX_PART_BYTES for p in parts):
        raise InputError(
            "a file has a name that is not taken",
            code="upload.name",
            got=repr(name[:120]),
            allowed="letters, digits, space and . , _ + - ( ) [ ] & ' # = @ ~ ! ; % °, at most three folders deep, without '..' and not hidden",
        )
    return PurePosixPath(*parts)


def tables_alone(folder: Path) -> list[str]:
    """Return the tables of a tray that no ``campaign.toml`` names, which do not say how they were measured; archives are unpacked first."""
    _unpack_all(folder)
    if any(folder.rglob("campaign.toml")):
        return []
    tables = (path for path in sorted(folder.rglob("*")) if path.suffix.lower() in _TABLES)
    return [str(path.relative_to(folder)) for path in tables]


def sources(folder: Path, told: Collection[Path] = ()) -> list[Path]:
    """Return what a tray holds that can be ingested; archives are unpacked first.

    ``told``: tables that lie alone, of which conditions were told: they are sources beside campaign folders, too.
    """
    _unpack_all(folder)
    folders = sorted(folder.rglob("campaign.toml"))
    homes = [toml.parent for toml in folders]
    alone = {".b5r"} if homes else {".b5r", ".csv", ".parquet", *SPREADSHEETS}
    loose = [
        path
        for path in sorted(folder.rglob("*"))
        if path in told or (path.suffix.lower() in alone and not any(path.is_relative_to(home) for home in homes))
    ]
    if homes or loose:
        return [*homes, *loose]
    names = sorted(p.name for p in folder.rglob("*") if p.is_file())
    raise InputError(
        "there is nothing here that can be ingested by itself",
        code="ingest.type",
        got=", ".join(names[:8]) or "no file",
        allowed=_ALLOWED,
        hint="drop the whole folder: campaign.toml says plane, radius, feed and direction",
    )


def _unpack_all(folder: Path) -> None:
    for archive in sorted(folder.rglob("*.[zZ][iI][pP]")):
        _unpack(archive, archive.with_name(f"{archive.stem}-unpacked"))
        archive.unlink()


def _unpack(archive: Path, target: Path) -> None:
    """Unpack an archive that nobody vouches for; what is not whole gets no name."""
    coming = target.with_name(f".{target.name}")
    shutil.rmtree(coming, ignore_errors=True)
    try:
        coming.mkdir()
        with zipfile.ZipFile(archive) as opened:
            members = [m for m in opened.infolist() if not m.is_dir() and not LEFT_BY_SYSTEMS.search(m.filename)]
            if len(members) > _MAX_FILES:
                raise _too_much("files", str(len(members)), str(_MAX_FILES))
            left = _MAX_UNPACKED_BYTES
            for member in members:
                left -= _extract(opened, member, coming, left)
        coming.rename(target)
    except (
        zipfile.BadZipFile,
        zlib.error,
        lzma.LZMAError,
        NotImplementedError,
        RuntimeError,
        EOFError,
        OSError,
    ) as error:
        raise InputError(
            "the archive cannot be unpacked",
            code="upload.zip",
            where=archive.name,
            # The place of the tray is nobody's business.
            got=(getattr(error, "strerror", None) or str(error))[:120],
            hint="pack the campaign folder again, without a password",
        ) from error


def _extract(opened: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, left: int) -> int:
    kind = stat.S_IFMT(member.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        raise InputError(
            "the archive holds something that is not a file",
            code="upload.zip",
            got=repr(member.filename[:80]),
            allowed="plain files",
        )
    path = target / safe_path(member.filename)
    path.parent.mkdir(parents=True, exist_ok=True)
    # What the archive says of its sizes is not believed: the bytes are counted.
    ratio_limit = max(_RATIO_FROM_BYTES, _MAX_RATIO * max(member.compress_size, 1))
    size = 0
    with opened.open(member) as packed, path.open("xb") as out:
        while chunk := packed.read(_CHUNK):
            size += len(chunk)
            if size > min(left, ratio_limit):
                raise _too_much(
                    "bytes when unpacked",
                    f"{member.filename[:60]}: more than {size}",
                    f"{_MAX_UNPACKED_BYTES} in all, {_MAX_RATIO} times its packed size",
                )
            out.write(chunk)
    return size


def _too_much(what: str, got: str, allowed: str) -> InputError:
    return InputError(
        f"the upload has too many {what}",
        code="upload.size",
        got=got,
        allowed=allowed,
        hint="ingest it with: dtwin ingest FOLDER",
    )
