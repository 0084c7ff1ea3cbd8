"""The registry of a plant: more machines and versions than one answer of MLflow holds."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from threading import Thread
from time import sleep
from typing import cast

import pytest
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError, StoreError
from dtwin.lifecycle.export import _source
from dtwin.serve.bundle import Bundle
from dtwin.train._registry_client import client_of
from dtwin.train.candidate_runs import training_candidates, training_metrics
from dtwin.train.registry import RegisteredVersion, Registry, model_name


@pytest.fixture(scope="module")
def registry(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    registry = Registry(Home(tmp_path_factory.mktemp("plant")))
    registry.ensure_model("twin-a", "a twin, not a machine's correction", machine="a", holds="twin")
    for number in range(120):
        registry.ensure_model(
            model_name(f"m{number:03d}"), "a correction", machine=f"m{number:03d}", holds="correction"
        )
    return registry


def test_every_machine_is_listed(registry: Registry) -> None:
    assert registry.machines() == [f"m{number:03d}" for number in range(120)]


def test_versions_come_newest_first_with_their_aliases_and_tags(registry: Registry) -> None:
    assert registry.versions("nobody") == registry.versions("m001") == []
    name = model_name("m000")
    for number in range(1, 12):
        registry.client.create_model_version(name, source="file:nowhere", tags={"state": f"s{number}"})
    registry.client.set_registered_model_alias(name, "champion", "9")
    found = registry.versions("m000")
    assert [v.version for v in found] == [str(n) for n in range(11, 0, -1)]
    assert [v.aliases for v in found if v.aliases] == [("champion",)]
    assert found == [registry.version("m000", v.version) for v in found]
    assert registry.champion("m000") == found[2]
    registry.client.create_model_version(model_name("m119"), source="file:nowhere", tags={"state": "candidate"})
    assert registry.every_version() == {"m000": found, "m119": registry.versions("m119")}


def test_a_name_that_would_be_part_of_another_question_is_refused(registry: Registry) -> None:
    with pytest.raises(InputError, match="not a usable name"):
        registry.versions("a' or name LIKE '%")


def test_tags_that_somebody_changed_in_mlflow_end_in_no_traceback(registry: Registry) -> None:
    with registry.open_run("one", {"mlflow.parentRunId": "x' or '"}) as run:
        pass
    version = RegisteredVersion("m001", "1", run, (), {"twin": "x", "twin_version": "v2"}, "")
    assert (training_candidates(registry, version), training_metrics(registry, version)) == ([], {})
    with pytest.raises(InputError, match="which version of its twin"):
        _source(registry.home, cast(Bundle, None), "candidate", version, None)


def test_a_file_that_is_nested_without_end_is_damaged(registry: Registry) -> None:
    """A bundle of somebody's hand ended a promotion in a traceback."""
    with registry.open_run("deep", {}) as run:
        registry.client.log_text(run, "[" * 100_000, "bundle/bundle.json")
    with pytest.raises(StoreError, match="a file in the registry is damaged"):
        registry.bundle(RegisteredVersion("m001", "1", run, (), {}, ""))


def test_an_experiment_that_was_deleted_in_mlflow_is_said_and_can_be_restored(registry: Registry) -> None:
    number = registry.experiment()
    registry.client.delete_experiment(number)
    with pytest.raises(StoreError, match="was deleted in MLflow") as refused:
        registry.experiment()
    assert f"experiments restore --experiment-id {number}" in (refused.value.hint or "")
    registry.client.restore_experiment(number)
    assert registry.experiment() == number


@pytest.mark.parametrize("kept", [True, False])
def test_a_home_that_was_copied_or_renamed_writes_beside_itself(tmp_path: Path, kept: bool) -> None:
    before, now = Home(tmp_path / "before"), Home(tmp_path / "now")
    first = Registry(before)
    with first.open_run("one", {}) as run_id:
        first.log_files(run_id, {"a.txt": "first"})
    (shutil.copytree if kept else shutil.move)(before.root, now.root)
    again = Registry(now)
    # MLflow keeps in memory where a run of this process writes.
    assert again.client.get_run(run_id).info.artifact_uri == f"{now.mlflow_artifacts}/{run_id}/artifacts"
    with again.open_run("two", {}) as later:
        again.log_files(later, {"b.txt": "second"})
    assert {path.name for path in now.root.rglob("*.txt")} == {"a.txt", "b.txt"}
    assert {path.name for path in before.root.rglob("*.txt")} == ({"a.txt"} if kept else set())


def test_a_home_that_can_only_be_read_tells_its_models_and_is_backed_up(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "home"
    shutil.copytree(registry.home.root, place)
    (place / "lake").mkdir()
    mount = [["mount", "--bind", place, place], ["mount", "-o", "remount,bind,ro", place]]
    if os.geteuid() != 0 or any(subprocess.run(command, check=False).returncode for command in mount):
        pytest.skip("mounting a file system needs root, and a sandbox that allows it")
    monkeypatch.setenv("DTWIN_HOME", str(place))
    try:
        listed = CliRunner().invoke(app, ["models"])
        backed_up = CliRunner().invoke(app, ["home", "backup", str(tmp_path / "home.tar")])
        # What trains or promotes refuses at once.
        with pytest.raises(StoreError) as refused:
            Registry(Home(place))
    finally:
        subprocess.run(["umount", "--lazy", place], check=True)
    assert (listed.exit_code, backed_up.exit_code) == (0, 0), (listed.output, backed_up.output)
    assert refused.value.code == "registry.write"


def test_to_read_a_registry_that_is_not_there_makes_none() -> None:
    listed = CliRunner().invoke(app, ["models"])
    assert (listed.exit_code, home().root.exists()) == (0, False), listed.output
    assert listed.output.startswith("no model is registered yet")


def test_a_home_that_is_opened_by_a_link_keeps_the_names_of_its_files(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    with Registry(home).open_run("one", {}) as run_id:
        pass
    Registry(home).log_files(run_id, {"a.txt": "first"})
    (tmp_path / "link").symlink_to(home.root)
    found = Registry(Home(tmp_path / "link")).client.get_run(run_id)
    assert found.info.artifact_uri == f"{home.mlflow_artifacts}/{run_id}/artifacts"


_LOGIN = b"Content-Length: 5\r\n\r\nlogin"


@pytest.mark.parametrize(
    ("status", "rest", "again", "got"),
    [
        ("404 Not Found", _LOGIN, b"", "HTTP 404"),
        ("200 OK", _LOGIN, b"", "an answer that is not MLflow's"),
        ("302 Found", b"Location: http://127.0.0.1:9/\r\n" + _LOGIN, b"", "HTTP 302, it sends to http://127.0.0.1:9/"),
        ("200 OK", b"Content-Length: 999\r\n\r\n{", b" ", "no whole answer within 0.4 s"),
        ("200 OK", b"X: ", b"y", "no whole answer within 0.4 s"),
        ("200 OK", b"\r\n{", b" " * 500_000, "an answer of more than 1000000 bytes"),
        ("200 OK", b"\r\n" + b"[" * 100_000, b"", "an answer that is not MLflow's"),
    ],
    ids=["404", "login page", "redirect", "drips", "heads drip", "endless", "deep"],
)
def test_a_server_that_is_no_registry_is_told_at_once(
    monkeypatch: pytest.MonkeyPatch, status: str, rest: bytes, again: bytes, got: str
) -> None:
    monkeypatch.setattr("dtwin.train._registry_client._ANSWER_S", 0.4 if len(again) == 1 else 30)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        uri = f"http://127.0.0.1:{listening.getsockname()[1]}"
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)

        def answer() -> None:
            with listening.accept()[0] as asked, suppress(OSError):
                asked.recv(65536)
                asked.sendall(f"HTTP/1.1 {status}\r\n".encode() + rest)
                while again:
                    asked.sendall(again)
                    sleep(0.01)

        Thread(target=answer, daemon=True).start()
        with pytest.raises(StoreError) as caught:
            client_of(home())
    assert (caught.value.code, caught.value.where, caught.value.got) == ("registry.away", uri, got)


def test_a_registry_that_stops_in_the_middle_ends_what_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.train._registry_client._CALL_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        uri = f"http://127.0.0.1:{listening.getsockname()[1]}"
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)

        def answer() -> None:
            with listening.accept()[0] as asked:
                asked.recv(65536)
                asked.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\nConnection: close\r\n\r\n{}")
            with listening.accept()[0] as asked, suppress(OSError):
                while True:
                    asked.sendall(b"H")
                    sleep(0.01)

        Thread(target=answer, daemon=True).start()
        with pytest.raises(StoreError, match="does not answer") as caught:
            client_of(home()).search_registered_models()
    assert caught.value.got == "search registered models did not end within 0.2 s"
