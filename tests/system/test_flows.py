"""Flows on a real Prefect server: what they leave on the page, and two ticks of the schedule."""

from __future__ import annotations

import base64
import json
import threading
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop import circles
from prefect.flows import load_flow_from_entrypoint
from running_servers import MACHINE, Up, measured, running_up, wait_for

from dtwin.acquire.b5r import write_b5r
from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lifecycle.evidence import make_champion, measure
from dtwin.lifecycle.train import put_on_trial
from dtwin.pipeline.desk import _open_question
from dtwin.plan import EvidencePlan
from dtwin.train.registry import Registry
from dtwin.twins.verbs import Twins
from flows import _plots
from flows._artifacts import slug
from flows._runtime import delivered, run, running_server
from flows.campaign import campaign_flow
from flows.cron import require_cron
from flows.diagnose import diagnose_flow
from flows.ingest import ingest_flow
from flows.nightly import nightly_flow
from flows.reach import running
from flows.recheck import recheck_flow
from flows.schedule import deployments
from flows.simulate import simulate_flow
from flows.train import train_flow

pytest_plugins = ["shared_up"]
pytestmark = pytest.mark.system


@pytest.fixture
def up(shared_up: Up, monkeypatch: pytest.MonkeyPatch) -> Up:
    monkeypatch.setenv("DTWIN_HOME", str(shared_up.home.root))
    return shared_up


def test_every_flow_of_the_page_is_found_by_the_name_that_starts_it() -> None:
    for made in deployments(None):
        assert load_flow_from_entrypoint(made.entrypoint, use_placeholder_flow=False).name == made.name
        assert made.description
        assert "Args" not in made.description
        assert made.tags


def cells(artifact: dict[str, Any]) -> list[dict[str, str]]:
    return list(json.loads(artifact["data"]))


@pytest.mark.long
def test_two_ticks_train_once_and_then_skip_with_the_reason(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    measured(home, "quick")
    with running_up(home, "--cron", "* * * * *") as up:
        _two_ticks(up)


def _two_ticks(up: Up) -> None:
    def skipped() -> list[dict[str, Any]]:
        return [
            r
            for r in up.runs_of("scheduled-training")
            if r["state"]["name"] == "Skipped" and "nothing new" in r["state"]["message"]
        ]

    second = wait_for(skipped, "no tick was skipped for want of new data")[0]
    runs = up.runs_of("scheduled-training")
    first = runs[0]
    assert first["state"]["name"] == "Completed", first["state"]
    assert (first["auto_scheduled"], second["auto_scheduled"]) == (True, True)
    assert first["expected_start_time"] < second["expected_start_time"]

    left = up.artifacts_of(first)
    assert cells(left["comparison-quick"])[0]["candidate"] == "physics-library"
    assert "data:image/svg+xml" in left["held-out-error-quick"]["data"]
    assert f"dtwin promote 1 --machine {MACHINE}" in left[f"review-{MACHINE}"]["data"]
    assert f"{up.addresses['mlflow']}/#/models" in left[f"review-{MACHINE}"]["data"]

    registry = Registry(up.home)
    candidate = registry.version(MACHINE, "candidate")
    assert (candidate.version, candidate.tags["trained_by"]) == ("1", "schedule")
    assert "version 1" in second["state"]["message"]
    assert candidate.aliases == ("candidate",)
    assert not up.home.bundles.exists(), "the schedule promoted something"


def test_ingest_leaves_what_is_wrong_with_the_recording(up: Up, real_recording: Path) -> None:
    found = run(ingest_flow, sources=[real_recording])
    assert (found["added"] + found["unchanged"], found["worst_finding"]) == (2, "error")
    left = up.artifacts_of(up.runs_of("ingest")[-1])
    rows = cells(left[f"findings-{slug(found['campaigns'][0])}"])
    assert rows[0]["severity"] == "error"
    assert {row["run"] for row in rows} >= {"ccw", "cw"}


def test_diagnosis_shows_curves(up: Up, real_recording: Path) -> None:
    campaign = run(ingest_flow, sources=[real_recording])["campaigns"][0]
    found = run(diagnose_flow, campaign=campaign)
    assert (found["runs"], found["drift"]) == (2, None)
    left = up.artifacts_of(up.runs_of("diagnose")[-1])
    assert {row["run"] for row in cells(left[f"figures-{slug(campaign)}"])} == {"ccw", "cw"}
    assert left[f"curves-{slug(campaign)}"]["data"].startswith("![XY R100")


def test_diagnosis_says_what_the_twins_of_the_machine_lack(up: Up, tmp_path: Path) -> None:
    simulate_mill(tmp_path / "mill", quick=True, hidden="backlash")
    campaign = run(ingest_flow, sources=[tmp_path / "mill"])["campaigns"][0]
    Twins(up.home).fit(campaign, ["scale_mismatch", "squareness"], "mill-a")
    found = run(diagnose_flow, campaign=campaign)
    assert found["twins"]["mill-a"].startswith("missing_effect: backlash X is missing")
    left = up.artifacts_of(up.runs_of("diagnose")[-1])
    assert "backlash X" in left[slug(f"twin-mill-a-{campaign}")]["data"]


def test_a_measured_campaign_is_kept_when_the_flow_runs_again(up: Up, tmp_path: Path) -> None:
    plan = tmp_path / "small.toml"
    plan.write_text(
        '[plan]\nname = "small"\nmachine = "virtual-cobot"\n'
        '[grid]\nradius_mm = [100.0]\nfeed_mm_min = [6000.0]\nplane = ["YZ"]\nrepeats = 1\n',
        encoding="utf-8",
    )
    options = {"plan_file": plan, "out": tmp_path / "small", "to_lake": False}
    with delivered():
        first, again = run(simulate_flow, **options), run(simulate_flow, **options)
    assert (first["measured"], first["kept"]) == (1, 0)
    assert (again["measured"], again["kept"]) == (0, 1)
    ran, ran_again = up.runs_of("simulate")[-2:]
    assert "small" in " ".join(up.artifacts_of(ran_again))
    # It is told by the thread that saves.
    lines = up.ask("/logs/filter", {"logs": {"flow_run_id": {"any_": [ran["id"]]}}, "limit": 200})
    assert "measure: 1 of 1 t001" in {line["message"] for line in lines}
    assert not [words for words in _children() if "prefect" in words], "a server of its own was started"


def _children() -> list[str]:
    """Command lines of the processes that this one started."""
    found = [child for task in Path("/proc/self/task").glob("*/children") for child in task.read_text().split()]
    return [Path(f"/proc/{child}/cmdline").read_text() for child in found]


def test_the_flow_measures_on_a_machine_and_says_what_to_do_next(up: Up, tmp_path: Path) -> None:
    plan = tmp_path / "shop.toml"
    plan.write_text(
        '[plan]\nname = "shop"\nmachine = "mill-a"\n[grid]\nradius_mm = [50.0]\n'
        'feed_mm_min = [1000.0]\nplane = ["XY"]\nrepeats = 1\n',
        encoding="utf-8",
    )
    inbox, folder = tmp_path / "inbox", tmp_path / "shop"
    inbox.mkdir()

    def play() -> None:
        wait_for(lambda: _open_question(folder), "nothing is asked")
        runs = [replace(run, window=(0, 360)) for run in circles([""])]
        write_b5r(inbox / "result.b5r", runs, name="result", machine="mill-a")

    operator = threading.Thread(target=play, daemon=True)
    operator.start()
    found = run(campaign_flow, plan_file=plan, inbox=inbox, out=folder, settle_s=0.2)
    operator.join()
    assert (found["measured"], found["added"]) == (1, 2)
    left = up.artifacts_of(up.runs_of("campaign")[-1])
    (told,) = cells(left["measured-shop"])
    assert told["tests"] == "1"
    tasks = up.ask("/task_runs/filter", {"limit": 200})
    assert "measure shop" in {task["name"] for task in tasks}


def test_a_user_s_mistake_fails_the_run_with_the_reason(up: Up) -> None:
    with delivered(), pytest.raises(InputError, match="no such campaign"):
        run(diagnose_flow, campaign="never-measured")
    failed = up.runs_of("diagnose")[-1]
    assert failed["state"]["type"] == "FAILED"
    assert "no such campaign" in failed["state"]["message"]
    assert "try: dtwin ingest PATH" in failed["state"]["message"]
    told = [line["message"] for line in up.ask("/logs/filter", {"logs": {"flow_run_id": {"any_": [failed["id"]]}}})]
    assert any("\n  try: dtwin ingest PATH" in line for line in told)
    assert not any("\\n" in line or "Traceback" in line for line in told)
    wanted = {"task_runs": {"flow_run_id": {"any_": [failed["id"]]}}}
    assert [t["run_count"] for t in up.ask("/task_runs/filter", wanted)] == [1], "was retried"


@pytest.mark.long
def test_a_champion_that_harms_another_machine_is_withdrawn_by_the_flow(up: Up) -> None:
    registry = Registry(up.home)
    if MACHINE not in registry.machines():
        run(train_flow, campaign="quick")
    left_out = run(recheck_flow, machine=MACHINE)[MACHINE]
    assert (left_out["verdict"], left_out["reason"]) == ("left out", "no champion")
    told = up.runs_of("recheck")[-1]["state"]
    assert (told["name"], told["message"]) == ("Nothing checked", f"{MACHINE}: no champion")
    candidate = registry.version(MACHINE, "candidate")
    put_on_trial(up.home, candidate)
    plan = EvidencePlan((("YZ", 150.0, 5000.0),), 2, (4000.0, 6000.0))
    measure(up.home, candidate, seed=0, plan=plan)
    path, reason = make_champion(up.home, candidate)
    assert path, reason
    # Another arm under the same name: its errors are others, and the equation adds its own.
    found = run(recheck_flow, machine=MACHINE, seed=10, blocks=2)[MACHINE]
    assert (found["verdict"], found["withdrawn"], found["restored"]) == ("worse", True, None)
    named = [r for r in up.runs_of("recheck") if r["state"]["name"] == "Withdrawn"]
    assert "larger with the correction" in named[-1]["state"]["message"]
    rows = cells(up.artifacts_of(named[-1])[f"recheck-{MACHINE}"])
    assert [row["condition"] for row in rows] == ["YZ R150 F5000", "all"]


def test_a_named_server_that_is_silent_is_said_so(up: Up, monkeypatch: pytest.MonkeyPatch) -> None:
    assert running_server(up.home) == up.addresses["prefect_api"]
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    with pytest.raises(InputError, match="does not answer"):
        run(simulate_flow, quick=True)


def test_servers_of_a_killed_process_are_not_believed(up: Up, tmp_path: Path) -> None:
    assert running(up.home)["prefect_api"] == up.addresses["prefect_api"]
    stale = running(up.home) | {"pid": "999999999"}
    (tmp_path / "servers.json").write_text(json.dumps(stale), encoding="utf-8")
    assert running(Home(tmp_path)) == {}


@pytest.mark.parametrize("line", ["every day", "* * * *", "61 * * * *", ""])
def test_what_is_no_cron_line_is_refused(line: str) -> None:
    with pytest.raises(InputError, match="not a cron line"):
        require_cron(line)


def test_plots_are_pictures_of_their_own_with_escaped_text() -> None:
    rows = [("<script>", {"before": 50.0, "after": 10.0}), ("wild", {"before": 1e9, "after": 5.0})]
    angle = np.linspace(0.0, 360.0, 2000)
    bars = _plots.bars("a & b", rows, floor=6.0, longest=100.0)
    polar = _plots.polar("circle", {"CCW": (angle, 20.0 * np.sin(np.radians(2 * angle)))})
    for svg in (bars, polar):
        root = ElementTree.fromstring(svg)
        width = float(root.attrib["width"])
        for part in root.iter():
            reach = float(part.attrib.get("x", 0)) + float(
                part.attrib.get("width", "0").rstrip("%") if part.tag.endswith("rect") else 0
            )
            assert reach <= width
    assert "<script>" not in bars
    image = _plots.markdown("circle", polar)
    data = image.partition("base64,")[2].rstrip(")")
    assert base64.b64decode(data).decode() == polar


def test_a_flow_started_on_the_page_keeps_to_its_folders(shared_up: Up, tmp_path: Path) -> None:
    up, elsewhere = shared_up, tmp_path
    (deployment,) = wait_for(
        lambda: [d for d in up.ask("/deployments/filter", {}) if "ingest_flow" in d["entrypoint"]], "no flow is served"
    )
    wanted = {"parameters": {"sources": [str(elsewhere)]}}
    run = up.ask(f"/deployments/{deployment['id']}/create_flow_run", wanted)

    def ended() -> str:
        found = up.ask("/flow_runs/filter", {"flow_runs": {"id": {"any_": [run["id"]]}}})
        return str(found[0]["state"]["message"]) if found[0]["state"]["type"] == "FAILED" else ""

    assert "keeps to its folders" in wait_for(ended, "the flow did not end")


@pytest.mark.long
def test_a_night_leaves_two_lists(up: Up) -> None:
    found = run(nightly_flow)
    assert found["diagnosed"]["done"]
    assert not found["diagnosed"]["failed"]
    left = up.artifacts_of(up.runs_of("nightly")[-1])
    machines = {row["machine"] for row in cells(left["fleet"])}
    assert {said["machine"] for said in found["diagnosed"]["done"].values()} == machines
    assert len(cells(left["to-look-at"])) == max(1, len(found["alerts"]))
