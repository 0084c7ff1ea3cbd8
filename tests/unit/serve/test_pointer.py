"""The pointer that serve follows, and what it refuses to follow."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bundles import path_bundle

from dtwin.config import Home
from dtwin.errors import DtwinError, GateRefusal, InputError
from dtwin.serve.bundle_file import load_bundle, save_bundle
from dtwin.serve.pointer import machine_folder, only_machine, resolve, write_pointer


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path / "home")


def promoted(home: Home, state: str = "champion", machine: str = "cobot-a") -> Path:
    path = save_bundle(path_bundle(machine=machine), machine_folder(machine, home) / "v3.json")
    return write_pointer(machine, home, path, 3, state)  # type: ignore[arg-type]


def test_latest_is_the_promoted_bundle(home: Home) -> None:
    promoted(home)
    found = resolve("latest", "cobot-a", home)
    assert (found.version, found.state) == (3, "champion")
    assert load_bundle(found.path, "cobot-a").bundle.model_version == 3
    assert "version 3 (champion)" in found.describe()


def test_machine_may_be_left_out_when_there_is_one(home: Home) -> None:
    with pytest.raises(InputError, match="no model has been promoted"):
        only_machine(home)
    promoted(home)
    assert resolve("latest", None, home).version == 3
    promoted(home, machine="cobot-b")
    with pytest.raises(InputError, match="several"):
        resolve("latest", None, home)


@pytest.mark.parametrize("state", ["candidate", "barred"])
def test_what_did_not_pass_is_only_looked_at(home: Home, state: str) -> None:
    promoted(home, state)
    with pytest.raises(GateRefusal, match=state) as refusal:
        resolve("latest", "cobot-a", home)
    assert refusal.value.exit_code == 3
    assert resolve("latest", "cobot-a", home, harmless=True).state == state


def test_exchanged_bundle_is_refused_even_to_look_at(home: Home) -> None:
    promoted(home)
    save_bundle(path_bundle(model_version=4), machine_folder("cobot-a", home) / "v3.json")
    with pytest.raises(GateRefusal, match="not the one that was promoted"):
        resolve("latest", "cobot-a", home, harmless=True)


@pytest.mark.parametrize(
    "change",
    [
        {"bundle": "../cobot-b/v3.json"},
        {"bundle": "/etc/passwd"},
        {"bundle": ".."},
        {"bundle": "a\x00b"},
        {"bundle": 7},
        {"state": "excellent"},
        {"version": "3"},
        {"extra": 1},
    ],
)
def test_malformed_pointer_is_refused(home: Home, change: dict[str, object]) -> None:
    pointer = promoted(home)
    pointer.write_text(json.dumps(json.loads(pointer.read_text()) | change))
    with pytest.raises(DtwinError):
        resolve("latest", "cobot-a", home)


def test_link_out_of_the_folder_is_refused(home: Home, tmp_path: Path) -> None:
    outside = save_bundle(path_bundle(), tmp_path / "outside.json")
    folder = machine_folder("cobot-a", home)
    promoted(home)
    (folder / "v3.json").unlink()
    (folder / "v3.json").symlink_to(outside)
    with pytest.raises(InputError, match="leaves its folder"):
        resolve("latest", "cobot-a", home)


@pytest.mark.parametrize("machine", ["../x", "", "a/b", "..", "x" * 200])
def test_machine_names_cannot_leave_the_home(home: Home, machine: str) -> None:
    with pytest.raises(InputError, match="name"):
        resolve("latest", machine, home)


def test_bundle_elsewhere_cannot_be_promoted(home: Home, tmp_path: Path) -> None:
    machine_folder("cobot-a", home).mkdir(parents=True)
    path = save_bundle(path_bundle(), tmp_path / "v3.json")
    with pytest.raises(InputError, match="machine's folder"):
        write_pointer("cobot-a", home, path, 3, "champion")


def test_missing_bundle_and_unknown_model(home: Home) -> None:
    promoted(home)
    (machine_folder("cobot-a", home) / "v3.json").unlink()
    with pytest.raises(InputError, match="cannot be read"):
        resolve("latest", "cobot-a", home)
    with pytest.raises(InputError, match="unknown model"):
        resolve("previous", "cobot-a", home)
