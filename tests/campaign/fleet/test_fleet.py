"""The same for many machines, in line and in processes."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fleet_lake import fill
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home, home
from dtwin.errors import InputError, Interrupted, StoreError
from dtwin.fleet.alerts import fleet_view
from dtwin.fleet.jobs import DIAGNOSE, DIAGNOSES, TRAIN, Unit
from dtwin.fleet.run import _Engine, run_fleet
from dtwin.fleet.run import engine as engine_of
from dtwin.locks import locked
from dtwin.pipeline.kept import kept_already


@pytest.fixture
def lake() -> Home:
    fill(home(), 4)
    return home()


def _answers(root: str, unit: Unit, seed: int) -> Any:
    """A diagnosis that costs nothing, for tests of what is done when and of what goes wrong beside it."""
    head = {"campaign": unit.name, "machine": unit.machine, "kind": "circular", "started": ""}
    figures = {"systematic_rms_um": 2.0, "noise_floor_um": 0.5, "found": [], "unresolved": None}
    return head | figures | {"verdict": "missing_effect", "headline": "squareness XY"}


ANSWER = replace(DIAGNOSE, work=_answers)


def _kept(where: Home) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in (where.root / "kept" / DIAGNOSES).glob("*")}


def test_every_campaign_is_diagnosed_and_the_worst_machine_stands_first(lake: Home) -> None:
    run = run_fleet(lake, DIAGNOSE, workers=1)
    assert sorted(run.done) == ["c00", "c01", "c02", "c03"]
    assert not run.failed
    assert all(said["verdict"] in ("missing_effect", "ambiguous") for said in run.done.values())
    shown = fleet_view(lake)
    # The newest campaign of each; squareness grows with the number.
    assert [line["campaign"] for line in shown] == ["c03", "c02"]
    assert all("squareness XY" in " ".join(line["found"]) for line in shown)
    assert shown[0]["over_floor"] > shown[1]["over_floor"] > 1.0


def test_what_was_done_is_passed_over_until_its_runs_change(lake: Home) -> None:
    run_fleet(lake, ANSWER, ["mill-0"], workers=1)
    again = run_fleet(lake, ANSWER, workers=1)
    assert sorted(again.done) == ["c01", "c03"]
    assert again.passed == {"c00": "diagnosed already", "c02": "diagnosed already"}
    assert CliRunner().invoke(app, ["leave-out", "c00", "r0", "--because", "touched"]).exit_code == 0
    assert sorted(run_fleet(lake, ANSWER, workers=1).done) == ["c00"]


def test_processes_keep_the_same_bytes_as_one(lake: Home) -> None:
    run_fleet(lake, DIAGNOSE, workers=1)
    alone = _kept(lake)
    for name in alone:
        (lake.root / "kept" / DIAGNOSES / name).unlink()
    run = run_fleet(lake, DIAGNOSE, workers=2)
    assert len(run.done) == 4
    assert _kept(lake) == alone


def _dies_at(name: str) -> Any:
    def work(root: str, unit: Unit, seed: int) -> Any:
        if unit.name == name:
            raise KeyboardInterrupt
        return _answers(root, unit, seed)

    return work


def test_what_was_done_before_an_interruption_is_kept(lake: Home) -> None:
    with pytest.raises(Interrupted, match="2 of 4 are done"):
        run_fleet(lake, replace(DIAGNOSE, work=_dies_at("c02")), workers=1)
    assert sorted(run_fleet(lake, ANSWER, workers=1).done) == ["c02", "c03"]


def _fails(root: str, unit: Unit, seed: int) -> Any:
    if unit.name == "c01":
        raise InputError("a mistake", code="test.mistake", where=unit.name)
    if unit.name == "c02":
        raise ZeroDivisionError("by nothing")
    return _answers(root, unit, seed)


def test_one_failure_stops_nothing_and_is_a_list(lake: Home) -> None:
    run = run_fleet(lake, replace(DIAGNOSE, work=_fails), workers=1)
    assert sorted(run.done) == ["c00", "c03"]
    assert run.failed["c01"]["code"] == "test.mistake"
    assert "ZeroDivisionError: by nothing" in run.failed["c02"]["message"]
    # It is tried again the next time.
    assert sorted(run_fleet(lake, ANSWER, workers=1).done) == ["c01", "c02"]


def _mixes_up(root: str, unit: Unit, seed: int) -> Any:
    return _answers(root, replace(unit, name="c01"), seed)


def test_an_answer_of_another_campaign_or_of_another_home_is_not_kept(lake: Home) -> None:
    run = run_fleet(lake, replace(DIAGNOSE, work=_mixes_up), workers=1)
    assert (sorted(run.done), {error["code"] for error in run.failed.values()}) == (["c01"], {"fleet.other"})
    # What a worker reads where somebody left a run out, or that has other effects.
    for work, unit in ((DIAGNOSE.work, "c00"), (TRAIN.work, "c00")):
        with pytest.raises(StoreError, match="other runs"):
            work(str(lake.root), Unit(unit, "mill-0", "of before"), 0)


def _kills_itself(root: str, unit: Unit, seed: int) -> Any:
    flag = Path(root) / "killed"
    if unit.name == "c01" and not flag.exists():
        flag.touch()
        import os

        os._exit(9)
    return _answers(root, unit, seed)


def test_a_worker_that_dies_once_costs_nothing(lake: Home) -> None:
    run = run_fleet(lake, replace(DIAGNOSE, work=_kills_itself), workers=2)
    assert (lake.root / "killed").exists()
    assert sorted(run.done) == ["c00", "c01", "c02", "c03"]


def _always_dies(root: str, unit: Unit, seed: int) -> Any:
    import os

    if unit.name in ("c01", "c02"):
        os._exit(9)
    return _answers(root, unit, seed)


def test_what_kills_its_process_is_found_out_and_the_rest_is_done(lake: Home) -> None:
    run = run_fleet(lake, replace(DIAGNOSE, work=_always_dies), workers=2)
    assert sorted(run.done) == ["c00", "c03"]
    assert {name: error["code"] for name, error in run.failed.items()} == {"c01": "fleet.killed", "c02": "fleet.killed"}


def test_two_conductors_do_not_do_the_same_at_once(lake: Home) -> None:
    with locked(lake.root / "locks" / "fleet-diagnose.lock"), pytest.raises(StoreError, match="another process"):
        run_fleet(lake, DIAGNOSE, workers=1)


@pytest.mark.parametrize(
    ("on", "workers", "code"),
    [
        ("ray://127.0.0.1:1", None, "fleet.engine"),
        ("dask://127.0.0.1:1/path", None, "fleet.engine"),
        ("dask://", None, "fleet.engine"),
        ("dask://192.0.2.1:8786", None, "fleet.insecure"),
        ("dask://plant.example:8786", None, "fleet.insecure"),
        ("dask://127.0.0.1:8786", 2, "fleet.workers"),
    ],
)
def test_an_engine_that_cannot_be_used_is_refused_first(on: str, workers: int | None, code: str) -> None:
    with pytest.raises(InputError) as caught:
        run_fleet(home(), DIAGNOSE, on=on, workers=workers)
    assert caught.value.code == code


def test_a_scheduler_that_is_not_there_is_said(lake: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.fleet.run._CONNECT_S", 0.3)
    with pytest.raises(StoreError) as caught:
        run_fleet(lake, DIAGNOSE, on="dask://127.0.0.1:9")
    assert caught.value.code == "fleet.scheduler"


class _Nobody(Executor):
    """Takes work that nobody does."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return Future()


def test_work_that_nobody_does_any_more_ends(lake: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dtwin.fleet.run._LOOK_S", 0.01)
    left = iter([1, 1, 0, 0, 0])
    monkeypatch.setattr("dtwin.fleet.run.engine", lambda *_: nullcontext(_Engine(_Nobody(), 2, lambda: next(left))))
    with pytest.raises(StoreError) as caught:
        run_fleet(lake, ANSWER)
    assert (caught.value.code, next(left, None)) == ("fleet.worker", None)


def test_commands_say_what_was_done_and_what_was_passed_over(lake: Home) -> None:
    shell = CliRunner()
    found = json.loads(shell.invoke(app, ["fleet", "diagnose", "--workers", "1", "--json"]).stdout)
    assert sorted(found["done"]) == ["c00", "c01", "c02", "c03"]
    said = shell.invoke(app, ["fleet", "diagnose", "--workers", "1"]).stdout
    assert "passed over, diagnosed already: c00, c01, c02, c03" in said
    assert "mill-1" in shell.invoke(app, ["fleet", "show", "--machine", "mill-1"]).stdout
    for verb in ("diagnose", "train", "recheck", "nightly", "show"):
        assert shell.invoke(app, ["fleet", verb, "--machine", "mill-x"]).exception.code == "machine.unknown"  # type: ignore[union-attr]
    assert "no controller signals" in shell.invoke(app, ["fleet", "train", "--workers", "1"]).stdout


def test_in_line_is_one_slot() -> None:
    with engine_of("local", 1) as at:
        assert at.slots == 1
        assert at.executor.submit(len, "abc").result() == 3


@pytest.mark.parametrize(
    "answer",
    [
        {"half": 1},
        [1.0],
        "no_findings",
        {"verdict": "missing_effect", "headline": "squareness XY", "campaign": "c", "machine": "m"},
        _answers("", Unit("c", "m"), 0) | {"verdict": "sound"},
        _answers("", Unit("c", "m"), 0) | {"systematic_rms_um": "2"},
    ],
)
def test_an_answer_that_is_no_diagnosis_is_not_kept(tmp_path: Path, answer: Any) -> None:
    asked = Unit("c", "m", "stamp")
    with pytest.raises((KeyError, TypeError, ValueError)):
        DIAGNOSE.keep(Home(tmp_path), asked, answer)
    assert kept_already(Home(tmp_path), DIAGNOSES, "c") is None
