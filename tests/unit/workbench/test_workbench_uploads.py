from __future__ import annotations

import asyncio
import os
import shutil
import stat
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path
from unicodedata import normalize

import pytest

from dtwin.errors import InputError, StoreError
from dtwin.workbench import _uploads as uploads


def archive(path: Path, members: dict[str, bytes], mode: int = 0) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in members.items():
            member = zipfile.ZipInfo(name)
            member.compress_type = zipfile.ZIP_DEFLATED
            member.external_attr = mode << 16
            opened.writestr(member, content)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "../x.b5r",
        "/etc/x.b5r",
        "a/../../x",
        "..\\x.b5r",
        "C:\\x",
        ".hidden",
        "a//b",
        "",
        "a\x00b",
        "a/b/c/d/e.csv",
        "<b>.csv",
        "x" * 200,
        "\u6f22" * 80 + ".csv",
    ],
)
def test_names_that_could_leave_their_folder_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        uploads.safe_path(name)
    assert caught.value.code == "upload.name"


def test_ordinary_names_stay() -> None:
    for name in ("r001.csv", "my campaign/r 1 (2).csv", "Prüfung/ä.csv", "Kreis #3 50%.csv", "O'Brien & Co [1].csv"):
        assert str(uploads.safe_path(name)) == str(uploads.safe_path(normalize("NFD", name))) == name


def test_a_campaign_in_an_archive_is_found(tmp_path: Path) -> None:
    members = {"c/campaign.toml": b"x", "c/a.b5r": b"x", "c/.DS_Store": b"x", "__MACOSX/c/._a.b5r": b"x"}
    archive(tmp_path / "c.zip", members)
    found = uploads.sources(tmp_path)
    assert [path.name for path in found] == ["c"]
    assert (found[0] / "a.b5r").read_bytes() == b"x"


def test_a_traversal_writes_nothing_outside(tmp_path: Path) -> None:
    inside = tmp_path / "tray"
    inside.mkdir()
    archive(inside / "c.zip", {"../../out.toml": b"x"})
    with pytest.raises(InputError):
        uploads.sources(inside)
    assert not list(tmp_path.parent.glob("out.toml"))


def test_a_link_in_an_archive_is_refused(tmp_path: Path) -> None:
    archive(tmp_path / "c.zip", {"link": b"/etc/passwd"}, stat.S_IFLNK | 0o777)
    with pytest.raises(InputError, match="not a file"):
        uploads.sources(tmp_path)


def test_a_bomb_is_stopped_while_it_is_unpacked(tmp_path: Path) -> None:
    archive(tmp_path / "c.zip", {"zeros.csv": bytes(40_000_000)})
    for _ in range(2):
        with pytest.raises(InputError) as caught:
            uploads.sources(tmp_path)
        assert caught.value.code == "upload.size", "asked again, the reason is the same"
    written = sum(p.stat().st_size for p in tmp_path.rglob("zeros.csv"))
    assert written <= 12_000_000


def test_the_whole_of_an_archive_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "_MAX_UNPACKED_BYTES", 1000)
    archive(tmp_path / "c.zip", {f"{n}.csv": bytes(range(200)) for n in range(6)})
    with pytest.raises(InputError) as caught:
        uploads.sources(tmp_path)
    assert caught.value.code == "upload.size"


def test_a_damaged_archive_is_said(tmp_path: Path) -> None:
    (tmp_path / "c.zip").write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(InputError) as caught:
        uploads.sources(tmp_path)
    assert caught.value.code == "upload.zip"
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as twice:
        twice.writestr("a.csv", "t_s")
        with pytest.warns(UserWarning, match="Duplicate name"):
            twice.writestr("a.csv", "t_s")
    with pytest.raises(InputError) as caught:
        uploads.sources(tmp_path)
    assert caught.value.got == "File exists"


def test_loose_files_name_what_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "r001.txt").write_text("t_s")
    with pytest.raises(InputError, match="nothing here") as caught:
        uploads.sources(tmp_path)
    assert caught.value.got == "r001.txt"


def test_a_table_is_taken_alone_but_not_beside_a_campaign(tmp_path: Path) -> None:
    (tmp_path / "r001.csv").write_text("t_s")
    assert [path.name for path in uploads.sources(tmp_path)] == ["r001.csv"]
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "campaign.toml").write_text("")
    assert [path.name for path in uploads.sources(tmp_path)] == ["c"]


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_archive_that_was_spoilt_on_its_way_is_said_to_be(method: int, tmp_path: Path) -> None:
    path = tmp_path / "c.zip"
    with zipfile.ZipFile(path, "w", method) as opened:
        opened.writestr("c/a.csv", "1,2\n" * 1000)
    whole = path.read_bytes()
    refused = 0
    for at in range(40, 60):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            uploads.sources(tmp_path)
        except InputError as error:
            refused += error.code == "upload.zip"
        shutil.rmtree(tmp_path / "c-unpacked", ignore_errors=True)
    assert refused > 5


def test_a_file_and_a_folder_of_one_name_are_refused(tmp_path: Path) -> None:
    trays = uploads.Trays(tmp_path / "trays")

    async def body() -> AsyncIterator[bytes]:
        yield b"x"

    async def put(*names: str) -> None:
        tray = trays.new()
        for name in names:
            await trays.receive(tray, name, body())

    asyncio.run(put("a/b.csv", "a/c.csv"))
    for names in (("a/b", "a"), ("a", "a/b"), ("a/b", "a/b/c")):
        with pytest.raises(InputError, match="one name"):
            asyncio.run(put(*names))


async def parts(*sizes: int) -> AsyncIterator[bytes]:
    for size in sizes:
        await asyncio.sleep(0)
        yield b"x" * size


def test_files_that_come_at_once_are_limited_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "MAX_TRAY_BYTES", 100)
    trays = uploads.Trays(tmp_path / "trays")
    tray = trays.new()

    async def both() -> list[int | BaseException]:
        coming = (trays.receive(tray, f"{name}.csv", parts(30, 30)) for name in "ab")
        return await asyncio.gather(*coming, return_exceptions=True)

    came = asyncio.run(both())
    assert sorted(type(one).__name__ for one in came) == ["InputError", "int"]
    assert sum(p.stat().st_size for p in trays.folder(tray).iterdir()) == 60
    # What was refused counts no more, and a file in the place of another takes its room.
    assert asyncio.run(trays.receive(tray, "c.csv", parts(40))) == 40
    assert asyncio.run(trays.receive(tray, "c.csv", parts(20, 20))) == 40

    async def twice() -> None:
        await asyncio.gather(trays.receive(tray, "c.csv", parts(9, 9)), trays.receive(tray, "c.csv", parts(5)))

    # Two files of one name that come at once: one of them, whole.
    asyncio.run(twice())
    assert (trays.folder(tray) / "c.csv").stat().st_size in (5, 18)


def test_an_upload_that_ends_early_leaves_no_part_of_a_file(tmp_path: Path) -> None:
    trays = uploads.Trays(tmp_path / "trays")
    tray = trays.new()

    async def broken() -> AsyncIterator[bytes]:
        yield b"1,2"
        raise OSError(28, "No space left on device")

    with pytest.raises(StoreError, match="the upload cannot be written"):
        asyncio.run(trays.receive(tray, "a/b.csv", broken()))
    assert not list(trays.folder(tray).iterdir())


def test_uploads_that_are_only_begun_are_limited_and_given_up(tmp_path: Path) -> None:
    trays = uploads.Trays(tmp_path / "trays")
    begun = [trays.new() for _ in range(50)]
    with pytest.raises(InputError, match="too many uploads"):
        trays.new()
    os.utime(trays.folder(begun[7]), (1e9, 1e9))
    assert trays.folder(trays.new()).is_dir()
    with pytest.raises(InputError, match="not known here"):
        trays.folder(begun[7])
