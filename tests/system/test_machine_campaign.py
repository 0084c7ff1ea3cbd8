"""A campaign on a machine: programs handed out, files taken and judged, evidence by turns.

The machines are virtual, the operator is a process of its own; nothing that is tested here is told so.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from closed_loop import circles
from command_here import command_here, refused, said
from real_linuxcnc import skip_without_linuxcnc
from virtual_robot import virtual_robot

from dtwin.acquire.b5r import write_b5r
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.pipeline.desk import REPEAT, _open_question, give_answer
from dtwin.serve.bundle import Bundle
from dtwin.serve.pointer import resolve
from dtwin.train.registry import Registry

pytestmark = pytest.mark.system
OPERATOR = Path(__file__).with_name("machine_operator.py")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    return Home(tmp_path / "home")


@pytest.fixture
def inbox(tmp_path: Path) -> Path:
    made = tmp_path / "inbox"
    made.mkdir()
    return made


def plan_file(folder: Path, machine: str, radius_mm: float, feed: float, repeats: int = 1, plane: str = "XY") -> Path:
    path = folder / f"{machine}.toml"
    path.write_text(
        f'[plan]\nname = "shop"\nmachine = "{machine}"\n'
        f"[grid]\nradius_mm = [{radius_mm}]\nfeed_mm_min = [{feed}]\n"
        f'plane = ["{plane}"]\nrepeats = {repeats}\n',
        encoding="utf-8",
    )
    return path


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "dtwin", *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def ended(process: subprocess.Popen[str], code: int = 0) -> Any:
    out, err = process.communicate(timeout=700)
    assert process.returncode == code, out + err
    assert "Traceback" not in err
    return json.loads(out) if code == 0 and out else err


@contextmanager
def operator(folder: Path, inbox: Path, machine: str, name: str, *more: str) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, str(OPERATOR), str(folder), str(inbox), f"--machine={machine}", f"--name={name}", *more],
        env=os.environ | {"PYTHONPATH": str(OPERATOR.parent)},
        start_new_session=True,
    )
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def asked(folder: Path, words: str, but: str = "") -> dict[str, Any]:
    until = time.monotonic() + 300.0
    while time.monotonic() < until:
        found = _open_question(folder)
        if found is not None and words in found["text"] and found["id"] != but:
            return dict(found)
        time.sleep(0.05)
    raise AssertionError(f"was never asked {words!r}: {_open_question(folder)}")


def keep_if_asked(process: subprocess.Popen[str], folder: Path) -> None:
    """Keep a run that a busy test computer spoilt by losing samples of the controller."""
    until = time.monotonic() + 300.0
    while process.poll() is None:
        assert time.monotonic() < until, _open_question(folder)
        found = _open_question(folder)
        if found is not None and found["answers"] == [REPEAT, "keep"]:
            give_answer(folder, found["id"], "keep")
            return
        time.sleep(0.05)


def recorded(stream: Path, n_bytes: int = 60_000) -> None:
    until = time.monotonic() + 300.0
    while not stream.exists() or stream.stat().st_size < n_bytes:
        assert time.monotonic() < until, "nothing is recorded"
        time.sleep(0.05)


def ball_bar(path: Path, seed: int = 0, feed: float = 1000.0) -> Path:
    runs = [r.__class__(r.meta, r.samples, window=(0, 360)) for r in circles([""], seed=seed, feed_mm_min=feed)]
    write_b5r(path, runs, name=path.stem, machine="mill-a")
    return path


def lenient(home: Home, machine: str) -> None:
    """Give version 1 the patience that a busy test computer needs of it."""
    registry = Registry(home)
    version = registry.version(machine, "1")
    bundle = Bundle.from_dict(registry.bundle(version))
    safety = replace(bundle.safety, stale_s=0.5, trips_to_latch=1000)
    content = json.dumps(replace(bundle, safety=safety).to_dict())
    registry.attach(version, {"bundle/bundle.json": content})


@pytest.mark.parametrize(
    ("machine", "radius_mm", "feed"),
    [("cobot", 100.0, 6000.0), pytest.param("mill", 150.0, 4000.0, marks=pytest.mark.long)],
)
def test_an_operator_measures_a_plan_and_repeats_a_spoilt_run(
    machine: str, radius_mm: float, feed: float, home: Home, inbox: Path, tmp_path: Path
) -> None:
    plane = "YZ" if machine == "cobot" else "XY"
    plan = plan_file(tmp_path, f"{machine}-a", radius_mm, feed, 2, plane)
    folder = tmp_path / "shop"
    command = ("campaign", plan, "--inbox", inbox, "--out", folder, "--settle", "0.6", "--json")
    with operator(folder, inbox, machine, f"{machine}-a", "--spoil=1"):
        found = ended(started(*command))
    assert (found["measured"], found["kept"], found["set_aside"]) == (2, 0, 1)
    assert [p.name for p in (folder / "set-aside").iterdir()] == ["t001-1"]
    assert {p.name for p in (folder / "programs").iterdir()} == {"t001.nc", "t001.script", "t002.nc", "t002.script"}
    rows = Lake(home.lake).runs("shop")
    assert [row["run_id"] for row in rows] == ["t001-ccw", "t001-cw", "t002-ccw", "t002-cw"]
    assert {(r["radius_mm"], r["feed_mm_min"], r["n_errors"]) for r in rows} == {(radius_mm, feed, 0)}
    assert {row["correction"] for row in rows} == {""}
    # What was handed out is a real machine's for all that dtwin knows.
    assert not Lake(home.lake).campaign("shop").machine_geometry.get("virtual", False)
    code, out, err = command_here(*map(str, command))
    assert code == 0, err
    again = json.loads(out)
    assert (again["measured"], again["kept"], again["added"]) == (0, 2, 0)


def test_linuxcnc_runs_what_was_handed_out(home: Home, inbox: Path, tmp_path: Path) -> None:
    skip_without_linuxcnc()
    plan = plan_file(tmp_path, "linuxcnc-a", 30.0, 6000.0)
    folder = tmp_path / "shop"
    command = ("campaign", plan, "--inbox", inbox, "--out", folder, "--settle", "30", "--json")
    with operator(folder, inbox, "linuxcnc", "linuxcnc-a", "--answer-done"):
        found = ended(started(*command))
    assert found["measured"] == 1
    assert len(Lake(home.lake).runs("shop")) == 2


@pytest.mark.long
def test_evidence_is_measured_by_turns_and_promoted(home: Home, inbox: Path, tmp_path: Path) -> None:
    said("simulate", "--quick", "--out", tmp_path / "training")
    said("ingest", tmp_path / "training")
    said("train", "training-quick")
    lenient(home, "virtual-cobot")
    plan = plan_file(tmp_path, "virtual-cobot", 150.0, 5000.0, 2, "YZ")
    folder = tmp_path / "shop"
    command = ("campaign", plan, "--inbox", inbox, "--out", folder, "--settle", "0.6", "--with", "1", "--json")
    refusal = refused(*command)
    assert (refusal.exit_code, "neither on trial nor champion" in refusal.message) == (3, True)
    said("promote", "1", "--trial")
    with operator(folder, inbox, "cobot", "virtual-cobot"):
        found = ended(started(*command))
    assert found["measured"] == 4
    evidence = found["evidence"]
    assert (evidence["kind"], evidence["switches"] >= 2) == ("virtual", True)
    (condition,) = evidence["conditions"]
    assert (condition["n_without"], condition["n_with"]) == (4, 4)
    assert condition["better"]
    rows = {row["run_id"]: row["correction"] for row in Lake(home.lake).runs("shop-v1")}
    assert {bool(correction) for name, correction in rows.items() if "-with-" in name} == {True}
    assert {correction for name, correction in rows.items() if "-without-" in name} == {""}
    promoted = said("promote", "1")
    assert promoted["champion"] is True
    assert promoted["evidence"]["campaigns"]["with"] == ["shop-v1"]
    assert resolve("latest", "virtual-cobot", home).version == 1


def test_a_killed_campaign_goes_on_and_strange_files_are_not_taken(home: Home, inbox: Path, tmp_path: Path) -> None:
    ball_bar(inbox / "old.b5r", seed=9)
    plan = plan_file(tmp_path, "mill-a", 50.0, 1000.0, 2)
    folder = tmp_path / "shop"
    command = ("campaign", plan, "--inbox", inbox, "--out", folder, "--settle", "0.3", "--json")
    process = started(*command)
    first = asked(folder, "t001")
    ball_bar(inbox / "one.b5r", seed=1)
    second = asked(folder, "t002")
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert [e.run_id for e in open_campaign(folder).entries] == ["t001"]

    process = started(*command)
    asked(folder, "t002", but=second["id"])
    # The old file again under a new name, half a file, and one of another test.
    (inbox / "again.b5r").write_bytes((inbox / "one.b5r").read_bytes())
    whole = ball_bar(tmp_path / "whole.b5r", seed=2).read_bytes()
    (inbox / "half.b5r").write_bytes(whole[: len(whole) // 2])
    ball_bar(inbox / "other.b5r", seed=3, feed=2000.0)
    spoilt = asked(folder, "spoilt")
    assert "feed_mm_min 2000.0 instead of 1000.0" in spoilt["text"]
    assert process.stdin is not None
    process.stdin.write("repeat\n")
    process.stdin.flush()
    asked(folder, "t002 (2 of 2)")
    (inbox / "half.b5r").write_bytes(whole)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    found = json.loads(out)
    assert (found["measured"], found["kept"]) == (1, 1)
    assert "again.b5r is not taken: it is the file of t001 again" in err
    assert "half.b5r is not taken" in err
    assert first["programs"][0].endswith("t001.nc")
    sources = {Path(row["source"]).name for row in Lake(home.lake).runs("shop")}
    assert sources == {"t001.b5r", "t002.b5r"}


def test_the_controller_is_recorded_meanwhile_and_its_failure_spoils_only_the_run(
    home: Home, inbox: Path, tmp_path: Path
) -> None:
    plan = plan_file(tmp_path, "mill-a", 50.0, 1000.0)
    folder = tmp_path / "shop"
    with virtual_robot("--feed-mm-min=3000") as robot:
        command = (
            "campaign",
            plan,
            "--inbox",
            inbox,
            "--out",
            folder,
            "--settle",
            "0.3",
            "--robot",
            robot.host,
            "--json",
        )
        process = started(*command)
        first = asked(folder, "t001")
        recorded(folder / "t001.controller.arrows")
    out, err = process.communicate(timeout=600)
    # The controller is gone: nothing more can be recorded, and the half run is put aside.
    assert process.returncode == 4, out + err
    assert "t001: an instrument failed" in err
    assert (folder / "set-aside" / "t001-1" / "t001.controller.parquet").exists()
    with virtual_robot("--feed-mm-min=3000", host=robot.host):
        process = started(*command)
        # Neither the question nor the recording of the command before.
        asked(folder, "t001", but=first["id"])
        recorded(folder / "t001.controller.arrows")
        ball_bar(inbox / "one.b5r", seed=1)
        keep_if_asked(process, folder)
        found = ended(process)
    assert (found["measured"], found["set_aside"]) == (1, 1)
    lake = Lake(home.lake)
    (group,) = lake.load(lake.runs("shop")[0]).signals
    assert (group.name, group.n_samples > 100) == ("controller", True)
    # Whoever answered was no real controller, and the campaign does not hide it.
    assert lake.campaign("shop").machine_geometry["virtual"] is True


def test_ctrl_c_keeps_what_is_there_and_names_the_command(home: Home, inbox: Path, tmp_path: Path) -> None:
    plan = plan_file(tmp_path, "mill-a", 50.0, 1000.0, 2)
    folder = tmp_path / "shop"
    command = ("campaign", plan, "--inbox", inbox, "--out", folder, "--settle", "0.2")
    process = started(*command)
    asked(folder, "t001")
    process.send_signal(signal.SIGINT)
    said = ended(process, code=130)
    assert "0 of 2 tests are kept" in said
    assert "run the same command again" in said
    other = plan_file(tmp_path, "mill-b", 50.0, 1000.0, 2)
    for words, in_words in (
        ((other, "--inbox", inbox), "another plan"),
        ((plan, "--inbox", folder / "programs"), "must not write into"),
    ):
        code, _, said = command_here("campaign", *map(str, words), "--out", str(folder))
        assert code == 1
        assert in_words in said


def test_a_watch_ends_with_the_command_that_goes_on(home: Home, inbox: Path) -> None:
    ball_bar(inbox / "one.b5r")
    process = started("watch", inbox, "--machine", "mill-a", "--settle", "0", "--every", "0.2")
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("ingested: "), line
    process.send_signal(signal.SIGINT)
    said = ended(process, code=130)
    assert f"dtwin watch {inbox} --machine mill-a --settle 0 --every 0.2" in said
    code, out, _ = command_here("watch", str(inbox), "--once", "--settle", "0", "--every", "0.05", "--json")
    assert (code, out) == (0, "")
