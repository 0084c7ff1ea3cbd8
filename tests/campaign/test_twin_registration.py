"""MLflow follows the shelf of twins: in order, each version once, whatever was killed or failed."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowClient

from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import InputError, StoreError
from dtwin.locks import locked
from dtwin.train.registry import Registry
from dtwin.twins import registration as twin_registration
from dtwin.twins import shelf as shelves
from dtwin.twins.registration import log_waiting, place_of, waiting, waiting_text
from dtwin.twins.shelf import PATHS, TwinShelf

FIGURES = {"rms_before_um": 2.0, "rms_after_um": 1.0, "noise_floor_um": math.nan}
DATA = {"runs": 4, "left_out": {}}
# Every call of MLflow that logging a version and its diagnosis makes, after which a kill may come.
CALLS = (
    "create_experiment",
    "create_run",
    "log_batch",
    "log_artifacts",
    "set_terminated",
    "create_registered_model",
    "create_model_version",
    "set_model_version_tag",
)


def version(name: str, number: int) -> dict[str, Any]:
    effect = {"effect": "backlash", "axis": "X"}
    return {
        "twin": name,
        "version": number,
        "action": f"step {number}",
        "campaign": "c",
        "machine": "m",
        "effects": [effect],
        "figures": FIGURES,
        "data": DATA,
    }


def diagnosis(name: str, number: int, verdict: str) -> dict[str, Any]:
    named = {"twin": name, "version": number, "verdict": verdict, "lack_of_fit_p": math.nan}
    return {**named, "candidates": []}


@pytest.fixture(scope="module")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """MLflow's tables, whose making takes seconds."""
    home = Home(tmp_path_factory.mktemp("store"))
    Registry(home).client.search_experiments()
    return home.root / "mlflow"


@pytest.fixture
def shelf(tmp_path: Path, empty_store: Path, monkeypatch: pytest.MonkeyPatch) -> TwinShelf:
    """A shelf whose processes are killed before they begin: what it stores waits."""
    home = Home(tmp_path / "home")
    shutil.copytree(empty_store, home.root / "mlflow")
    monkeypatch.setenv("DTWIN_MLFLOW", "later")
    monkeypatch.setattr(twin_registration.subprocess, "Popen", Unborn)
    monkeypatch.setattr(shelves, "log_soon", twin_registration.log_soon)
    return TwinShelf(home, PATHS)


class Unborn:
    """A process that was killed before it did anything."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def poll(self) -> int:
        return -signal.SIGKILL


def labels(home: Home) -> list[str]:
    return [item.label for item in waiting(home)]


def in_mlflow(home: Home, name: str) -> list[tuple[str, str]]:
    """Actions of a twin's registered versions in MLflow's order, with the verdict."""
    client = Registry(home).client
    found = client.search_model_versions(f"name='twin-{name}'")
    ordered = sorted(found, key=lambda v: int(v.version))
    return [(v.tags["action"], v.tags.get("verdict", "")) for v in ordered]


def runs(home: Home, name: str) -> list[Any]:
    registry = Registry(home)
    found = registry.client.search_runs([registry.experiment()])
    return [r for r in found if r.info.run_name.startswith(f"twin-{name}")]


def file_of(shelf: TwinShelf, name: str, number: int) -> Path:
    return shelf.root / name / f"v{number:03d}.json"


def test_versions_of_several_twins_arrive_in_order_and_once(shelf: TwinShelf) -> None:
    for number in (1, 2, 3):
        shelf.store(version("a", number))
        shelf.store(version("b", number))
    shelf.store_diagnosis(diagnosis("a", 2, "missing_effect"))
    assert labels(shelf.home) == ["a v001", "b v001", "a v002", "b v002", "a v003", "b v003"]
    assert log_waiting(shelf.home) == log_waiting(shelf.home) == []
    assert in_mlflow(shelf.home, "a") == [("step 1", ""), ("step 2", "missing_effect"), ("step 3", "")]
    assert len(runs(shelf.home, "b")) == 4
    parents = {r.data.tags.get("mlflow.parentRunId") for r in runs(shelf.home, "b")}
    assert parents == {None, shelf.history("b")[0]["mlflow"]["parent_run_id"]}
    # A later diagnosis of a version that is logged is told, too.
    shelf.store_diagnosis(diagnosis("a", 2, "nothing_missing"))
    assert labels(shelf.home) == ["a v002"]
    log_waiting(shelf.home)
    assert in_mlflow(shelf.home, "a")[1] == ("step 2", "nothing_missing")


@pytest.mark.parametrize("spoilt", [False, True])
def test_versions_of_one_verb_are_logged_by_one_process_also_where_it_fails(
    shelf: TwinShelf, monkeypatch: pytest.MonkeyPatch, spoilt: bool
) -> None:
    begun: list[str] = []
    monkeypatch.setattr(shelves, "log_soon", lambda home, name, **_: begun.append(name))

    @shelves.logged_together
    def verb(shelf: TwinShelf, name: str, /, many: int) -> int:
        for number in range(1, many + 1):
            shelf.store(version(name, number))
        if spoilt:
            raise InputError("no more")
        return many

    if spoilt:
        with pytest.raises(InputError, match="no more"):
            verb(shelf, "a", 3)
    else:
        assert verb(shelf, "a", 3) == 3
    assert begun == ["a"]
    assert len(labels(shelf.home)) == 3
    shelf.store(version("a", 4))
    assert begun == ["a", "a"]


def test_the_thousandth_version_is_the_newest_and_comes_last(shelf: TwinShelf) -> None:
    for number in (998, 999):
        shelf.store(version("a", number))
    assert shelf.next_version("a", "m") == 1000
    shelf.store(version("a", 1000))
    assert shelf.newest_document("a")[0]["version"] == 1000
    assert shelf.newest_document("a", 1000)[0]["action"] == "step 1000"
    assert shelf.next_version("a", "m") == 1001
    assert [rung["version"] for rung in shelf.history("a")] == [998, 999, 1000]
    assert labels(shelf.home) == ["a v998", "a v999", "a v1000"]
    log_waiting(shelf.home)
    assert [action for action, _ in in_mlflow(shelf.home, "a")] == ["step 998", "step 999", "step 1000"]
    parents = {r.data.tags.get("mlflow.parentRunId") for r in runs(shelf.home, "a")}
    assert parents == {None, shelf.history("a")[0]["mlflow"]["parent_run_id"]}


def test_a_version_that_was_deleted_in_mlflow_holds_up_none(shelf: TwinShelf) -> None:
    for number in (1, 2):
        shelf.store(version("a", number))
    log_waiting(shelf.home)
    Registry(shelf.home).client.delete_model_version("twin-a", "1")
    shelf.store_diagnosis(diagnosis("a", 1, "missing_effect"))
    shelf.store(version("a", 3))
    assert log_waiting(shelf.home) == []
    assert [action for action, _ in in_mlflow(shelf.home, "a")] == ["step 2", "step 3"]


def test_after_a_kill_at_any_moment_each_version_is_there_exactly_once(shelf: TwinShelf) -> None:
    shelf.store(version("k", 1))
    shelf.store_diagnosis(diagnosis("k", 1, "missing_effect"))
    shelf.store(version("k", 2))
    for call in CALLS:
        assert killed(shelf.home, lambda call=call: die_after(MlflowClient, call)), call
    # Between MLflow and the receipt.
    assert killed(shelf.home, lambda: die_before(twin_registration, "_keep"))
    assert log_waiting(shelf.home) == []
    assert in_mlflow(shelf.home, "k") == [("step 1", "missing_effect"), ("step 2", "")]
    found = runs(shelf.home, "k")
    assert [r.info.status for r in found] == ["FINISHED"] * 3
    children = sorted(r.info.run_name for r in found if "mlflow.parentRunId" in r.data.tags)
    assert children == ["twin-k v1: step 1", "twin-k v2: step 2"]


def test_a_killed_training_is_closed_and_a_running_one_is_not(shelf: TwinShelf) -> None:
    def die_in_a_run() -> None:
        with Registry(shelf.home).open_run("training", {}):
            os.kill(os.getpid(), signal.SIGKILL)

    assert killed(shelf.home, die_in_a_run)
    registry = Registry(shelf.home)
    with registry.open_run("mine", {}) as mine:
        assert registry.close_abandoned() == 1
        states = {r.info.run_name: r.info.status for r in registry.client.search_runs([registry.experiment()])}
        assert states == {"training": "KILLED", "mine": "RUNNING"}
    assert registry.client.get_run(mine).info.status == "FINISHED"
    assert registry.close_abandoned() == 0


def killed(home: Home, prepare: Callable[[], None]) -> bool:
    """Log what waits in a process that kills itself as prepared; True when it did."""
    child = os.fork()
    if child == 0:
        try:
            prepare()
            log_waiting(home)
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL


def die_after(owner: Any, name: str) -> None:
    whole = getattr(owner, name)

    def cut(*args: Any, **kwargs: Any) -> None:
        whole(*args, **kwargs)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(owner, name, cut)


def die_before(owner: Any, name: str) -> None:
    setattr(owner, name, lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))


def test_what_fails_stays_with_its_reason_and_is_tried_again(shelf: TwinShelf, monkeypatch: pytest.MonkeyPatch) -> None:
    shelf.store(version("f", 1))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:////proc/none/mlflow.db")
    (left,) = log_waiting(shelf.home)
    assert "cannot be written" in left.failed
    assert waiting(shelf.home) == [left]
    assert "dtwin repair tries again" in waiting_text([left])
    monkeypatch.setenv("DTWIN_MLFLOW", "now")
    with pytest.raises(StoreError, match="the twin is kept, but MLflow did not take it"):
        shelf.store(version("f", 2))
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    assert [r["action"] for r in shelf.history("f")] == ["step 1", "step 2"]
    assert log_waiting(shelf.home) == []
    assert [action for action, _ in in_mlflow(shelf.home, "f")] == ["step 1", "step 2"]


def test_a_version_that_cannot_be_logged_holds_back_its_own_twin_only(shelf: TwinShelf) -> None:
    for name in ("bad", "good"):
        shelf.store(version(name, 1))
        shelf.store(version(name, 2))
    whole = file_of(shelf, "bad", 1).read_text()
    file_of(shelf, "bad", 1).write_text(whole.replace("step 1", "step 7"))
    left = log_waiting(shelf.home)
    assert [(item.label, bool(item.failed)) for item in left] == [("bad v001", True), ("bad v002", False)]
    assert len(in_mlflow(shelf.home, "good")) == 2
    file_of(shelf, "bad", 1).write_text(whole)
    assert log_waiting(shelf.home) == []
    assert [action for action, _ in in_mlflow(shelf.home, "bad")] == ["step 1", "step 2"]


def test_a_twin_that_was_removed_meanwhile_waits_no_more(shelf: TwinShelf, monkeypatch: pytest.MonkeyPatch) -> None:
    shelf.store(version("r", 1))
    logging = twin_registration._log

    def removed_first(registry: Registry, path: Path) -> None:
        shutil.rmtree(path.parent)
        logging(registry, path)

    with monkeypatch.context() as removing:
        removing.setattr(twin_registration, "_log", removed_first)
        assert log_waiting(shelf.home) == []
    assert shelf.names() == []
    # Another twin of that name is another twin.
    for _ in range(2):
        write_document(file_of(shelf, "r", 1), {**version("r", 1), "id": os.urandom(4).hex()}, "it")
        log_waiting(shelf.home)
        shutil.rmtree(shelf.root / "r")
    assert len(in_mlflow(shelf.home, "r")) == 2


def test_a_damaged_receipt_is_noticed_and_written_again(shelf: TwinShelf) -> None:
    shelf.store(version("d", 1))
    log_waiting(shelf.home)
    path = file_of(shelf, "d", 1)
    receipt = path.with_suffix(".mlflow.json")
    before = receipt.read_text()
    receipt.write_text(before.replace('"model_version": "1"', '"model_version": "3"'))
    with pytest.raises(StoreError) as caught:
        shelf.history("d")
    assert caught.value.hint == "dtwin repair writes it again"
    assert log_waiting(shelf.home) == []
    assert json.loads(receipt.read_text()) == json.loads(before)
    assert len(in_mlflow(shelf.home, "d")) == 1


def test_a_version_of_an_earlier_release_says_itself_where_it_is(shelf: TwinShelf) -> None:
    place = {"parent_run_id": "p", "run_id": "r", "model": "twin-e", "model_version": "4"}
    path = file_of(shelf, "e", 1)
    write_document(path, {**version("e", 1), "mlflow": place}, "it")
    assert place_of(path, read_document(path)) == place
    assert waiting(shelf.home) == []


def test_one_process_logs_and_one_at_most_stands_in_line(shelf: TwinShelf) -> None:
    shelf.store(version("l", 1))
    with locked(twin_registration._lock(shelf.home, "next")) as mine:
        assert mine
        # Would wait for ever if it took its place behind the other.
        twin_registration.log_next(shelf.home)
    assert labels(shelf.home) == ["l v001"]


def test_an_unknown_setting_is_refused_before_anything_is_stored(
    shelf: TwinShelf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_MLFLOW", "never")
    with pytest.raises(InputError, match="the setting is not known"):
        shelf.store(version("n", 1))
    assert not shelf.root.exists()


def test_a_twin_whose_first_version_could_not_be_written_is_none(tmp_path: Path) -> None:
    shelf = TwinShelf(Home(tmp_path), PATHS)
    (shelf.root / "empty").mkdir(parents=True)
    with pytest.raises(InputError) as refused:
        shelf.folder("empty")
    assert (refused.value.code, refused.value.allowed) == ("twin.unknown", "none yet")


def test_a_version_that_another_process_made_meanwhile_is_not_replaced(shelf: TwinShelf) -> None:
    shelf.store(version("t", 1))
    with pytest.raises(InputError, match="another process"):
        shelf.store(version("t", 1) | {"action": "of one that did not know"})
    assert shelf.newest_document("t")[0]["action"] == "step 1"
