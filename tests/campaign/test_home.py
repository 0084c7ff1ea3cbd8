"""A home is shown, checked, written to one file and made again from it elsewhere."""

from __future__ import annotations

import io
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tarfile
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from closed_loop import MACHINE, registered, small_bundle
from fleet_lake import fill
from mlflow.exceptions import MlflowException
from typer.testing import CliRunner

import dtwin
from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError, StoreError
from dtwin.lake.store import Lake
from dtwin.lifecycle.train import put_on_trial
from dtwin.machine_record import keep_record, read_record
from dtwin.people import AUDIT, note
from dtwin.pipeline.home_archive import _MANIFEST, backup, restore
from dtwin.pipeline.home_check import check_home, home_parts
from dtwin.serve.pointer import machine_folder, write_pointer
from dtwin.train.promotion_books import HISTORY
from dtwin.train.registry import Registry
from dtwin.twins.verbs import Twins


@pytest.fixture
def lived_in() -> Home:
    """A home with two campaigns, a twin and a record."""
    fill(home(), 2)
    Twins(home()).fit("c00", ["squareness"], "mine")
    keep_record(home(), "mill-0", {"serial": "7"})
    (home().root / "logs").mkdir(exist_ok=True)
    (home().root / "logs" / "x.log").write_text("a log")
    return home()


def test_what_was_backed_up_is_there_again_elsewhere(lived_in: Home, tmp_path: Path) -> None:
    registered(lived_in, small_bundle())
    rows = Lake(lived_in.lake).runs()
    samples = Lake(lived_in.lake).load(rows[0]).samples
    bundle = Registry(lived_in).bundle(Registry(lived_in).version(MACHINE, "1"))
    made = backup(lived_in, tmp_path / "home.tar")
    assert (tmp_path / "home.tar").stat().st_mode & 0o077 == 0
    # What it stood on is gone: nothing may lead back to it.
    shutil.rmtree(lived_in.root)
    other = Home(tmp_path / "other" / "home")
    again = restore(tmp_path / "home.tar", other)
    assert (again.files, again.bytes) == (made.files, made.bytes)
    assert Lake(other.lake).runs() == rows
    loaded = Lake(other.lake).load(rows[0]).samples
    assert all((loaded[name] == samples[name]).all() for name in samples)
    assert Twins(other).newest("mine").labels == ("squareness XY",)
    record = read_record(other, "mill-0")
    assert record is not None
    assert record.facts == {"serial": "7"}
    assert Registry(other).bundle(Registry(other).version(MACHINE, "1")) == bundle
    assert not (other.root / "logs").exists()
    assert not check_home(other).wrong
    assert fill(other, 3)[-1] in Lake(other.lake).campaigns()


def test_a_home_that_is_there_is_never_replaced(lived_in: Home, tmp_path: Path) -> None:
    backup(lived_in, tmp_path / "home.tar")
    with pytest.raises(InputError, match="already"):
        backup(lived_in, tmp_path / "home.tar")
    with pytest.raises(InputError, match="home already"):
        restore(tmp_path / "home.tar", lived_in)
    with pytest.raises(InputError, match="no home"):
        backup(Home(tmp_path / "none"), tmp_path / "none.tar")
    assert not (tmp_path / "none").exists()


Change = Callable[[list[tuple[tarfile.TarInfo, bytes]]], None]


def _manifest_first(members: list[tuple[tarfile.TarInfo, bytes]], name: str, content: bytes) -> None:
    """Add a member that the manifest knows."""
    import hashlib

    head = tarfile.TarInfo(name)
    head.size = len(content)
    members.insert(0, (head, content))
    about = json.loads(members[-1][1])
    about["files"][name] = [len(content), hashlib.sha256(content).hexdigest()]
    text = json.dumps(about).encode()
    members[-1][0].size = len(text)
    members[-1] = (members[-1][0], text)


def _flip(members: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    head, content = members[3]
    members[3] = (head, content[:-1] + bytes([content[-1] ^ 1]))


def _link(members: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    head = tarfile.TarInfo("lake")
    head.type, head.linkname = tarfile.SYMTYPE, "/etc"
    members.insert(0, (head, b""))


def test_a_part_that_is_a_link_is_backed_up_and_one_further_down_is_refused(lived_in: Home, tmp_path: Path) -> None:
    lived_in.lake.rename(tmp_path / "disk")
    lived_in.lake.symlink_to(tmp_path / "disk")
    rows = Lake(lived_in.lake).runs()
    backup(lived_in, tmp_path / "home.tar")
    other = Home(tmp_path / "other")
    restore(tmp_path / "home.tar", other)
    shutil.rmtree(tmp_path / "disk")
    assert Lake(other.lake).runs() == rows
    for words in (["runs"], ["home", "check"], ["home", "backup", str(tmp_path / "again.tar")]):
        assert CliRunner().invoke(app, words, env={"DTWIN_HOME": str(lived_in.root)}).exception.code == "home.link"  # type: ignore[union-attr]
    (other.machines / "mill-1.toml").symlink_to(other.machines / "mill-0.toml")
    with pytest.raises(InputError, match="a link"):
        backup(other, tmp_path / "again.tar")
    assert not list(tmp_path.glob("*again.tar*"))


@pytest.mark.parametrize("at", [0, 8000])
def test_a_damaged_database_is_in_no_backup(lived_in: Home, tmp_path: Path, at: int) -> None:
    registered(lived_in, small_bundle())
    database = lived_in.root / "mlflow" / "mlflow.db"
    whole = database.read_bytes()
    database.write_bytes(whole[:at] + bytes(20_000) + whole[at + 20_000 :])
    with pytest.raises(StoreError, match="damaged") as refused:
        backup(lived_in, tmp_path / "home.tar")
    assert refused.value.where == str(database)
    assert not list(tmp_path.glob("*home.tar*"))
    database.write_bytes(b"")
    backup(lived_in, tmp_path / "home.tar")
    restore(tmp_path / "home.tar", Home(tmp_path / "other"))


def test_a_database_that_is_none_is_said_by_whatever_asks_it(lived_in: Home) -> None:
    (lived_in.root / "mlflow").mkdir(exist_ok=True)
    (lived_in.root / "mlflow" / "mlflow.db").write_text("x" * 2000)
    with pytest.raises(StoreError, match="damaged"):
        Registry(lived_in)


def test_what_a_library_finds_of_a_database_is_no_traceback_on_the_screen(
    lived_in: Home, capfd: pytest.CaptureFixture[str]
) -> None:
    registry = Registry(lived_in)
    assert registry.machines() == []
    with closing(sqlite3.connect(lived_in.root / "mlflow" / "mlflow.db")) as file:
        file.execute("DROP TABLE registered_models")
    with pytest.raises(MlflowException, match="no such table"):
        registry.machines()
    assert "Traceback" not in capfd.readouterr().err


def test_tables_that_were_not_finished_are_made_anew(lived_in: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a full disk, or a kill: MLflow said "table registered_models already exists" ever after."""

    def full(tracking_uri: str, **_: str) -> None:
        with closing(sqlite3.connect(tracking_uri.removeprefix("sqlite:///"))) as begun:
            begun.execute("CREATE TABLE registered_models (name TEXT)")
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("dtwin.train._registry_client.MlflowClient", full)
        with pytest.raises(sqlite3.OperationalError):
            Registry(lived_in)
    assert Registry(lived_in).machines() == []
    assert [path.name for path in (lived_in.root / "mlflow").iterdir()] == ["mlflow.db"]


def test_a_database_that_another_holds_is_not_called_damaged(lived_in: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    Registry(lived_in)
    at_once = partial(sqlite3.connect, timeout=0.0)
    with closing(sqlite3.connect(lived_in.root / "mlflow" / "mlflow.db")) as other:
        other.execute("BEGIN EXCLUSIVE")
        monkeypatch.setattr(sqlite3, "connect", at_once)
        for asked in (Registry, check_home):
            with pytest.raises(StoreError, match="another process holds") as refused:
                asked(lived_in)
            assert "restore" not in (refused.value.hint or "")
    assert check_home(lived_in).wrong == {}


def test_a_file_of_settings_that_states_nothing_is_in_no_backup(lived_in: Home, tmp_path: Path) -> None:
    (lived_in.root / "home.toml").write_text("# all is here\n", encoding="utf-8")
    backup(lived_in, tmp_path / "home.tar")
    again = Home(tmp_path / "again")
    restore(tmp_path / "home.tar", again)
    assert not (again.root / "home.toml").exists()


CHANGES: dict[str, Change] = {
    "a bit is another": _flip,
    "a file is missing": lambda members: members.pop(2) and None,
    "no manifest": lambda members: members.pop() and None,
    "a link": _link,
    "a name above": lambda members: _manifest_first(members, "../outside", b"x"),
    "a name from the root": lambda members: _manifest_first(members, "/outside", b"x"),
    "servers elsewhere": lambda members: _manifest_first(members, "home.toml", b"registry = 1"),
    "a database that is none": lambda members: _manifest_first(members, "x.db", b"SQLite format 3\0no pages"),
    "twice": lambda members: members.insert(0, members[0]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_backup_that_is_not_as_it_was_written_leaves_nothing(lived_in: Home, tmp_path: Path, change: Change) -> None:
    backup(lived_in, tmp_path / "home.tar")
    with tarfile.open(tmp_path / "home.tar") as archive:
        members = [(m, archive.extractfile(m).read()) for m in archive]  # type: ignore[union-attr]
    assert members[-1][0].name == _MANIFEST
    change(members)
    with tarfile.open(tmp_path / "spoilt.tar", "w") as archive:
        for head, content in members:
            archive.addfile(head, io.BytesIO(content))
    place = tmp_path / "place"
    place.mkdir()
    with pytest.raises(StoreError):
        restore(tmp_path / "spoilt.tar", Home(place / "home"))
    assert list(place.iterdir()) == []
    assert not (tmp_path / "outside").exists()
    assert not Path("/outside").exists()


@pytest.mark.parametrize("content", [b"", b"no tar at all", b"\x00" * 4096])
def test_what_is_no_backup_is_said(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.tar").write_bytes(content)
    with pytest.raises(StoreError) as refused:
        restore(tmp_path / "x.tar", Home(tmp_path / "made"))
    assert refused.value.code == "home.backup"
    assert not (tmp_path / "made").exists()


def test_a_check_finds_what_was_changed(lived_in: Home) -> None:
    sound = check_home(lived_in)
    assert not sound.wrong
    assert sound.looked_at["runs"] == 12
    assert sound.looked_at["documents"] >= 1
    twin = next((lived_in.root / "twins").rglob("*.json"))
    twin.write_text(twin.read_text().replace("squareness", "squarenesz", 1))
    data = next((lived_in.lake / "samples").rglob("*.parquet"))
    spoilt = bytearray(data.read_bytes())
    spoilt[len(spoilt) // 2] ^= 1
    data.write_bytes(spoilt)
    (lived_in.root / "machines" / "mill-0.toml").write_text("serial = 7\n")
    promoted = machine_folder(MACHINE, lived_in) / HISTORY
    promoted.parent.mkdir(parents=True)
    entry = b'{"time": "", "version": "1", "action": "trial", "comment": "", "failed": []}\n'
    promoted.write_bytes(entry + b'{"time": "2026\n' + entry + b"[]\n")
    for what in "ab":
        note(lived_in, what, "", "done")
    record = lived_in.root / AUDIT
    record.write_bytes(record.read_bytes().replace(b'"a"', b'"A"'))
    wrong = check_home(lived_in).wrong
    assert wrong[f"bundles/{MACHINE}/{HISTORY}"].startswith("line 2, 4: ")
    assert wrong[AUDIT].startswith("line 2: ")
    assert str(twin.relative_to(lived_in.root)) in wrong
    assert "machines/mill-0" in wrong
    assert any(name.startswith(("c00/", "c01/")) for name in wrong)
    assert CliRunner().invoke(app, ["home", "check"]).exit_code == 1


def test_a_champion_that_the_registry_lost_is_found(lived_in: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    (version,) = registered(lived_in, small_bundle(), virtual=True)
    put_on_trial(lived_in, version)
    path = machine_folder(MACHINE, lived_in) / "v0001.json"
    write_pointer(MACHINE, lived_in, path, 1, "champion")
    assert not check_home(lived_in).wrong
    (lived_in.root / "mlflow" / "mlflow.db").write_bytes(b"")
    assert "nothing can withdraw it" in check_home(lived_in).wrong[f"bundles/{MACHINE}"]

    def away(home: Home, **_: bool) -> Registry:
        raise StoreError("the model registry cannot be written", code="registry.write")

    # On a disk that can only be read, nothing is known of it.
    monkeypatch.setattr("dtwin.train.registry.Registry", away)
    assert "cannot be said: the model registry cannot" in check_home(lived_in).wrong[f"bundles/{MACHINE}"]


def test_the_commands_say_what_there_is(lived_in: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shell = CliRunner()
    shown = json.loads(shell.invoke(app, ["home", "show", "--json"]).stdout)
    assert shown["root"] == str(lived_in.root)
    assert shown["parts"] == home_parts(lived_in)
    assert shown["parts"]["lake"]["files"] > 3
    out = tmp_path / "one.tar"
    assert shell.invoke(app, ["home", "backup", str(out)]).exit_code == 0
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "again"))
    killed = tmp_path / ".again.1.restoring"
    killed.mkdir()
    told = shell.invoke(app, ["home", "restore", str(out)]).stdout
    assert "are back in" in told
    assert f"remove it: {killed}" in told
    assert shell.invoke(app, ["home", "check"]).exit_code == 0


@pytest.mark.parametrize("name", ["a%41", "a#b", "a?b", "a\\b", "a\nb", "/".join(["x" * 200] * 3)])
def test_a_path_that_tables_or_databases_read_as_another_is_refused(tmp_path: Path, name: str) -> None:
    asked = CliRunner().invoke(app, ["runs"], env={"DTWIN_HOME": str(tmp_path / name)}).exception
    assert isinstance(asked, InputError)
    assert asked.code == "home.path"
    assert list(tmp_path.iterdir()) == []


def test_an_unusual_path_is_used_as_it_is(tmp_path: Path) -> None:
    root = tmp_path / "Größe µ'\"&;$HOME~ {b}"
    for words in (["machine", "add", "mill-a"], ["home", "check"], ["models"]):
        asked = CliRunner().invoke(app, words, env={"DTWIN_HOME": str(root)})
        assert asked.exit_code == 0, asked.output
    assert list(tmp_path.iterdir()) == [root]


def test_a_folder_of_others_is_not_taken_from_them(tmp_path: Path) -> None:
    public, ours = tmp_path / "public", tmp_path / "ours"
    for folder, mode in ((public, 0o1777), (ours, 0o775)):
        folder.mkdir()
        folder.chmod(mode)
    (ours / "colleague.txt").write_text("mine")
    (public / "machines").mkdir()
    for folder, mode in ((public, 0o1777), (ours, 0o775)):
        told = subprocess.run(
            [sys.executable, "-m", "dtwin", "machine", "add", "mill-1", "--notes", "x"],
            env=dict(os.environ, DTWIN_HOME=str(folder)),
            capture_output=True,
            text=True,
            check=False,
        )
        assert (told.returncode, "home.others" in told.stderr) == (1, True)
        assert folder.stat().st_mode & 0o7777 == mode
    (ours / "colleague.txt").rename(ours / "home.toml")
    Home(ours).require_parts()


def test_a_home_of_another_user_is_used_by_those_who_name_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".dtwin").mkdir(mode=0o700)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DTWIN_HOME")
    assert CliRunner().invoke(app, ["people", "list"]).exit_code == 0
    monkeypatch.setattr("os.geteuid", lambda: 4711)
    asked = CliRunner().invoke(app, ["people", "list"]).exception
    assert isinstance(asked, InputError)
    assert asked.code == "home.owner"
    assert CliRunner().invoke(app, ["people", "list"], env={"DTWIN_HOME": ".dtwin"}).exit_code == 0
    with pytest.raises(InputError, match="another user's"):
        dtwin.open_home()
    assert not dtwin.open_home(".dtwin").runs().size


def test_a_pipe_in_place_of_the_settings_of_a_home_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "home.toml")
    with pytest.raises(InputError, match="not usable"):
        Home(tmp_path).file  # noqa: B018


@pytest.mark.parametrize("path", ["x" * 600, "~nobody-has-this-name/home", "home in a folder that is gone"])
def test_a_path_with_a_name_that_no_folder_can_have_is_said(tmp_path: Path, path: str) -> None:
    gone = 'mkdir gone && cd gone && rmdir ../gone && exec "$@"'
    told = subprocess.run(
        [*(["sh", "-c", gone, "sh"] if "gone" in path else []), sys.executable, "-m", "dtwin", "runs"],
        cwd=tmp_path,
        env=dict(os.environ, DTWIN_HOME=path),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (told.returncode, "home.path" in told.stderr, "Traceback" in told.stderr) == (1, True, False)
