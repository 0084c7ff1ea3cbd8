"""The pointer that serve follows, and what it refuses to follow."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from bundles import path_bundle
from entered_workbench import enter
from starlette.testclient import TestClient

from dtwin.config import Home
from dtwin.errors import DtwinError, GateRefusal, InputError
from dtwin.lifecycle._export_records import whose
from dtwin.machine_record import keep_record
from dtwin.pipeline.home_check import check_home
from dtwin.pipeline.machine_history import champion_of
from dtwin.serve.bundle_file import load_bundle, save_bundle, write_json
from dtwin.serve.pointer import (
    _only_machine,
    clear_trial,
    machine_folder,
    proven_states,
    read_machine,
    resolve,
    write_machine,
    write_pointer,
)
from dtwin.serve.sealed import _SEAL, CHAMPION, WITHDRAWN, write_sealed
from dtwin.serve.withdrawn import WithdrawalWatch, stop_serving, withdrawn_why
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application


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
    assert resolve("champion", "cobot-a", home) == resolve("champion", None, home) == found
    assert load_bundle(found.path, "cobot-a").bundle.model_version == 3
    assert "version 3 (champion)" in found.describe()
    # One checksum names a correction, wherever it is shown.
    bundle = load_bundle(found.path, "cobot-a").bundle
    assert found.describe().endswith(f"model {bundle.model_sha256[:12]}")
    assert f"model {bundle.model_sha256}" in whose(bundle, "3", "champion")


def test_a_state_that_only_the_registry_tells_is_not_believed(home: Home) -> None:
    said = {2: "previous", 3: "candidate", 4: "champion"}
    nothing = {2: "previous", 3: "candidate", 4: "unpromoted, whatever its tags say"}
    assert proven_states("cobot-a", said, home) == nothing
    pointer = promoted(home)
    assert proven_states("cobot-a", said, home) == nothing | {3: "champion"}
    pointer.write_text(pointer.read_text().replace('"version": 3', '"version": 4'))
    assert proven_states("cobot-a", said, home) == nothing
    stop_serving("cobot-a", home, 3, "it made things worse")
    assert proven_states("cobot-a", {3: "champion"}, home) == {3: "withdrawn"}


def test_a_bundle_of_a_newer_dtwin_is_told_as_such(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as newer:
        newer.setattr("dtwin.serve.bundle._VERSION", 2)
        promoted(home)
    with pytest.raises(InputError, match="a bundle of another version") as caught:
        resolve("latest", "cobot-a", home)
    assert (caught.value.where, caught.value.got, caught.value.allowed) == ("machine cobot-a, version 3", "2", "1")
    assert proven_states("cobot-a", {3: "champion"}, home)[3].startswith("not to be read here")
    assert champion_of(home, "cobot-a") == "none can be served: a bundle of another version"


def test_machine_may_be_left_out_when_there_is_one(home: Home) -> None:
    with pytest.raises(InputError, match="no model has been promoted"):
        _only_machine(home)
    promoted(home)
    assert resolve("latest", None, home).version == 3
    promoted(home, machine="cobot-b")
    with pytest.raises(InputError, match="several"):
        resolve("latest", None, home)


@pytest.mark.parametrize("state", ["candidate", "withdrawn"])
def test_what_did_not_pass_is_only_looked_at(home: Home, state: str) -> None:
    promoted(home, state)
    with pytest.raises(GateRefusal, match=state) as refusal:
        resolve("latest", "cobot-a", home)
    assert refusal.value.exit_code == 3
    assert resolve("latest", "cobot-a", home, harmless=True).state == state


def test_the_former_word_for_withdrawn_is_understood(home: Home) -> None:
    pointer = promoted(home)
    write_sealed(pointer.parent, CHAMPION, json.loads(pointer.read_text()) | {"state": "barred"})
    with pytest.raises(GateRefusal, match="withdrawn"):
        resolve("latest", "cobot-a", home)
    assert resolve("latest", "cobot-a", home, harmless=True).state == "withdrawn"


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
        {"state": "trial"},
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
    with pytest.raises(InputError, match="cobot-b has no promoted model") as refused:
        resolve("champion", "cobot-b", home)
    assert refused.value.allowed == "cobot-a"
    with pytest.raises(InputError, match="cannot be read"):
        resolve(str(machine_folder("cobot-a", home) / "v9.json"), None, home)


def test_trial_leaves_the_champion_alone(home: Home) -> None:
    champion = promoted(home)
    before = champion.read_bytes()
    path = save_bundle(path_bundle(model_version=4), machine_folder("cobot-a", home) / "v4.json")
    pointer = write_pointer("cobot-a", home, path, 4, "trial")
    assert champion.read_bytes() == before
    assert pointer.name == "trial.json"
    assert (resolve("latest", None, home).version, resolve("latest", None, home).state) == (3, "champion")
    found = resolve("trial", None, home)
    assert (found.version, found.state, found.machine) == (4, "trial", "cobot-a")
    clear_trial("cobot-a", home)
    clear_trial("cobot-a", home)
    with pytest.raises(InputError, match="no model on trial"):
        resolve("trial", "cobot-a", home)
    with pytest.raises(InputError, match="no model is on trial"):
        resolve("trial", None, home)


def test_first_trial_is_not_the_latest(home: Home) -> None:
    path = save_bundle(path_bundle(), machine_folder("cobot-a", home) / "v3.json")
    write_pointer("cobot-a", home, path, 3, "trial")
    for machine in (None, "cobot-a"):
        with pytest.raises(InputError) as caught:
            resolve("latest", machine, home)
        assert "--model trial" in (caught.value.hint or "")


def test_file_is_only_looked_at_unless_a_pointer_names_it(home: Home, tmp_path: Path) -> None:
    path = save_bundle(path_bundle(model_version=9), tmp_path / "draft.json")
    with pytest.raises(GateRefusal, match="unpromoted"):
        resolve(str(path), None, home)
    assert resolve(str(path), None, home, harmless=True).state == "unpromoted"
    promoted(home)
    with pytest.raises(GateRefusal, match="unpromoted"):
        resolve(str(path), None, home)
    served = machine_folder("cobot-a", home) / "v3.json"
    copy = tmp_path / "copy.json"
    copy.write_bytes(served.read_bytes())
    assert resolve(str(copy), None, home).state == "champion"
    write_pointer("cobot-a", home, served, 3, "withdrawn")
    with pytest.raises(GateRefusal, match="withdrawn"):
        resolve(str(copy), None, home)


def test_machine_file_comes_back(home: Home) -> None:
    geometry = {"type": "ur10e", "tcp_mm": (0.0, 1.5, 158.3), "centre_mm": [0, 0, 0]}
    path = write_machine("cobot-a", home, geometry)
    read = read_machine("cobot-a", home)
    assert (read.type, read.tcp.tolist()) == ("ur10e", [0.0, 1.5, 158.3])
    assert json.loads(path.read_text()) == {"type": "ur10e", "tcp_mm": [0.0, 1.5, 158.3]}


@pytest.mark.parametrize(
    "geometry",
    [
        {"type": "ur10e"},
        {"type": "ur10e", "tcp_mm": [0.0, 1.0]},
        {"type": "ur10e", "tcp_mm": [0.0, 1.0, "2"]},
        {"type": "ur10e", "tcp_mm": 158.3},
        {"type": "toaster", "tcp_mm": [0.0, 0.0, 158.3]},
    ],
)
def test_unusable_geometry_is_not_written(home: Home, geometry: dict[str, object]) -> None:
    with pytest.raises(InputError):
        write_machine("cobot-a", home, geometry)
    with pytest.raises(InputError, match="nothing is known of the tool") as caught:
        read_machine("cobot-a", home)
    assert "dtwin promote" in (caught.value.hint or "")


def test_a_pointer_of_another_version_than_its_bundle_is_refused(home: Home) -> None:
    path = save_bundle(path_bundle(), machine_folder("cobot-a", home) / "v3.json")
    with pytest.raises(InputError, match="another version"):
        write_pointer("cobot-a", home, path, 99, "champion")
    pointer = promoted(home)
    # Written under the seal, as only a program could.
    write_sealed(pointer.parent, CHAMPION, json.loads(pointer.read_text()) | {"version": 99})
    with pytest.raises(GateRefusal, match="another version") as refused:
        resolve("latest", "cobot-a", home, harmless=True)
    assert refused.value.code == "pointer.version"


def test_a_withdrawn_version_stays_so_whatever_becomes_of_the_list(home: Home) -> None:
    pointer = promoted(home)
    stop_serving("cobot-a", home, 3, "worse")
    with pytest.raises(GateRefusal, match="withdrawn"):
        resolve("latest", "cobot-a", home)
    listed = pointer.with_name(WITHDRAWN)
    for spoil in (listed.unlink, lambda: listed.write_text("{}"), lambda: listed.write_text('{"30": "worse"}')):
        spoil()
        with pytest.raises(GateRefusal) as refused:
            resolve("latest", "cobot-a", home)
        assert refused.value.code == "seal.differs"
    watch = WithdrawalWatch("cobot-a", home, 3)
    listed.unlink()
    watch._next_s = 0.0
    assert watch() == "the list of withdrawn versions cannot be read"
    watch = WithdrawalWatch("cobot-a", home, 3)
    pointer.parent.rename(pointer.parent.with_name("away"))
    watch._next_s = 0.0
    assert "cannot be seen any more" in watch()


def test_a_tool_that_was_moved_is_refused(home: Home) -> None:
    promoted(home)
    path = write_machine("cobot-a", home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})
    path.write_text(path.read_text().replace("158.3", "159.3"))
    with pytest.raises(GateRefusal) as refused:
        read_machine("cobot-a", home)
    assert refused.value.code == "seal.differs"
    # The cure that the refusal names.
    path.with_name(_SEAL).unlink()
    with pytest.raises(GateRefusal, match="missing"):
        resolve("latest", "cobot-a", home)
    write_machine("cobot-a", home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})
    promoted(home)
    assert resolve("latest", "cobot-a", home).version == 3
    assert read_machine("cobot-a", home).tcp_mm[2] == 158.3


def test_a_writer_that_dies_at_any_moment_leaves_what_is_valid(home: Home) -> None:
    promoted(home)
    stop_serving("cobot-a", home, 1, "first")
    folder = machine_folder("cobot-a", home)

    class Died(Exception):
        pass

    def dies_at(step: int) -> None:
        count = 0

        def write(path: Path, content: dict[str, object]) -> None:
            nonlocal count
            count += 1
            if count > step:
                raise Died
            write_json(path, content)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("dtwin.serve.sealed.write_json", write)
            with contextlib.suppress(Died):
                stop_serving("cobot-a", home, 2, f"died at {step}")

    for step in range(4):
        dies_at(step)
        assert withdrawn_why("cobot-a", home, 1) == "first"
        assert resolve("latest", "cobot-a", home).version == 3
        assert (withdrawn_why("cobot-a", home, 2) != "") is (step > 1)
    assert {p.name for p in folder.glob("*.json")} == {CHAMPION, WITHDRAWN, _SEAL, "v3.json"}


def test_many_writers_at_once_lose_nothing(home: Home) -> None:
    promoted(home)
    code = (
        "import sys; from pathlib import Path; from dtwin.config import Home\n"
        "from dtwin.serve.withdrawn import stop_serving\n"
        "for k in range(10): stop_serving('cobot-a', Home(Path(sys.argv[1])), 100 * int(sys.argv[2]) + k, 'x')\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code, str(home.root), str(n)]) for n in range(1, 4)]
    while any(w.poll() is None for w in writers):
        assert resolve("latest", "cobot-a", home).version == 3
    assert [w.returncode for w in writers] == [0, 0, 0]
    for n in range(1, 4):
        for k in range(10):
            assert withdrawn_why("cobot-a", home, 100 * n + k) == "x"


def test_a_champion_of_a_machine_without_a_file_of_its_own_is_checked_with_the_home(home: Home) -> None:
    promoted(home)
    sound = check_home(home)
    assert (sound.looked_at["served"], sound.wrong) == (1, {})
    path = machine_folder("cobot-a", home) / "v3.json"
    path.write_text(path.read_text() + " ")
    assert list(check_home(home).wrong) == ["bundles/cobot-a"]


@pytest.mark.parametrize("name", [CHAMPION, "trial.json", "machine.json", WITHDRAWN, _SEAL])
@pytest.mark.parametrize("how", ["gone", "cut", "empty", "folder", "pipe"])
def test_a_file_that_is_lost_or_cut_is_missed(home: Home, name: str, how: str) -> None:
    write_machine("cobot-a", home, {"type": "ur10e", "tcp_mm": [0.0, 0.0, 158.3]})
    stop_serving("cobot-a", home, 1, "worse")
    promoted(home)
    promoted(home, "trial")
    path = machine_folder("cobot-a", home) / name
    raw = path.read_bytes()
    path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "pipe":
        os.mkfifo(path)
    elif how != "gone":
        path.write_bytes(raw[: len(raw) // 2] if how == "cut" else b"")

    def everything() -> None:
        resolve("latest", "cobot-a", home)
        resolve("trial", "cobot-a", home)
        read_machine("cobot-a", home)

    with pytest.raises(DtwinError):
        everything()


def test_the_workbench_is_told_the_model_in_use(home: Home) -> None:
    keep_record(home, "cobot-a", {})
    bench = Bench(home, Access("127.0.0.1", 8765))
    client = TestClient(application(bench), base_url="http://127.0.0.1:8765")
    enter(client, bench.access.token)
    assert client.get("/api/machines/cobot-a/summary").json()["champion"] == ""
    promoted(home)
    assert client.get("/api/machines/cobot-a/summary").json()["champion"] == "version 3 (champion)"
    assert "Model in use: version 3 (champion)." in client.get("/machines/cobot-a").text
