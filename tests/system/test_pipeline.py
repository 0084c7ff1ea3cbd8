"""The main job on a small campaign: real lake, real MLflow store, real RTDE, real evidence."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_here import command_here
from running_servers import Up, few_candidates

from dtwin.cli import main
from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.circular._evidence import measured_circles
from dtwin.kinds.circular._physics_fit import leave_out, predicted_left_out
from dtwin.kinds.circular._term_columns import TermColumns
from dtwin.lake.store import Lake
from dtwin.lifecycle.evidence import make_champion, measure, proven
from dtwin.lifecycle.train import put_on_trial, train
from dtwin.plan import EvidencePlan
from dtwin.serve.pointer import resolve
from dtwin.train.campaign_rows import gather
from dtwin.train.candidate_runs import training_candidates
from dtwin.train.dataset import load_ticks
from dtwin.train.promotion import promote, rollback
from dtwin.train.promotion_books import history
from dtwin.train.registry import Registry
from dtwin.train.symbolic import OperonEngine
from dtwin.workbench._registry_rows import judged
from flows._artifacts import slug
from flows.page import shown_steps
from flows.servers import await_healthy, prefect_alone

pytestmark = pytest.mark.system
MACHINE = "virtual-cobot"
CIRCLES = EvidencePlan((("YZ", 150.0, 5000.0),), 2, (4000.0, 6000.0))


def dtwin(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "dtwin", *arguments],
        env=dict(os.environ, DTWIN_HOME=str(home), OMP_NUM_THREADS="1"),
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Home, dict[str, Any]]:
    root = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTWIN_HOME", str(root))
        code, out, err = command_here("demo", "--quick", "--json")
    assert code == 0, err
    return Home(root), json.loads(out)


@pytest.fixture(autouse=True)
def _same_home(demo: tuple[Home, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("DTWIN_HOME", str(demo[0].root))
    return


def test_all_five_steps_have_figures(demo: tuple[Home, dict[str, Any]]) -> None:
    _, found = demo
    assert [run["run"] for run in found["recording"]["runs"]] == ["ccw", "cw"]
    assert (found["campaign"]["tests"], found["campaign"]["runs"]) == (12, 24)
    names = {c["name"] for c in found["comparison"]}
    assert {
        "zero",
        "constant",
        "first-harmonic",
        "look-up",
        "linear",
        "robust",
        "k-nearest",
        "tree",
        "extra-trees",
        "boosting",
        "neural-net",
        "physics-library",
        "symbolic-operon",
        "accelerometers-only",
    } <= names
    assert found["serving"]["released"] is True
    assert found["champion"] == "1"
    for condition in found["evidence"]["conditions"]:
        assert condition["floor_um"] > 1.0
        assert condition["after_um"] < 0.5 * condition["before_um"]
        assert condition["acted"].get("outside_box", 0.0) == 0.0
    assert found["evidence"]["share_of_oracle_unseen_feeds"] > 0.8
    page = Path(found["report"]).read_text()
    assert "Compensated against uncompensated" in page


def test_candidates_are_ranked_and_no_baseline_is_made_of_straw(demo: tuple[Home, dict[str, Any]]) -> None:
    rms = {c["name"]: c["scores"]["feed_mm_min"]["rms_um"] for c in demo[1]["comparison"]}
    assert rms["physics-library"] == min(rms.values())
    assert rms["physics-library"] < 0.4 * rms["zero"]
    # A sound regressor that cannot foretell another feed errs by about what there is.
    assert max(rms.values()) < 2.0 * rms["zero"]
    registry = Registry(demo[0])
    version = registry.version(MACHINE, "1")
    logged = {c["name"]: c["metrics"] for c in training_candidates(registry, version)}
    assert set(logged) == set(rms)
    harmful = [n for n, m in logged.items() if m["train_rms_um"] > 1.001 * logged["zero"]["train_rms_um"]]
    assert harmful == []


def test_where_a_model_does_harm_every_table_says_so(demo: tuple[Home, dict[str, Any]]) -> None:
    registry = Registry(demo[0])
    version = registry.version(MACHINE, "1")
    worst = max(demo[1]["comparison"], key=lambda c: c["scores"]["feed_mm_min"]["rms_um"])["name"]
    said = "worse than no correction"
    assert f"| {worst} | {said} |" in registry.description(version)
    shown = {c["name"]: c["r2_text"] for c in judged(registry, MACHINE, "1").candidates}
    assert (shown[worst], shown["zero"]) == (said, "0.000")
    assert said in Path(demo[1]["report"]).read_text()


def test_nothing_that_predicts_a_feed_has_seen_it(demo: tuple[Home, dict[str, Any]]) -> None:
    """Orders, modes, alignment, size and coefficients: a feed full of nonsense changes none."""
    lake = Lake(demo[0].lake)
    campaign = lake.campaign("training-quick")
    chosen = [r for r in lake.runs("training-quick") if r["radius_mm"] < 300.0]
    runs = load_ticks(lake, campaign, chosen)
    noise = np.random.default_rng(0)
    fast = [run.meta.feed_mm_min == 6000.0 for run in runs]
    spoilt = [
        replace(run, bar_um=noise.normal(0.0, 900.0, run.bar_um.size)) if other else run
        for run, other in zip(runs, fast, strict=True)
    ]
    true, nonsense = gather(runs), gather(spoilt)
    hidden = true.label("feed_mm_min") == 6000.0
    columns = TermColumns(runs)
    with ThreadPoolExecutor(2) as pool:
        folds = [leave_out(r, ["feed_mm_min"], columns, pool, lambda *_: None) for r in (true, nonsense)]
        found, again = (predicted_left_out(of, lambda *_: None)["feed_mm_min"] for of in folds)
    np.testing.assert_array_equal(found[hidden], again[hidden])
    assert not np.allclose(found[~hidden], again[~hidden])
    blind = [r.blind(~hidden).target_um for r in (true, nonsense)]
    np.testing.assert_array_equal(*blind)
    assert np.isnan(blind[0][hidden]).all()


def test_the_registry_entry_reads_well(demo: tuple[Home, dict[str, Any]]) -> None:
    registry = Registry(demo[0])
    version = registry.version(MACHINE, "champion")
    assert version.aliases == ("candidate", "champion")
    text = registry.description(version)
    for wanted in ("noise floor", "| physics-library |", "Offline gates", "Closed-loop evidence"):
        assert wanted in text
    run = registry.client.get_run(version.run_id)
    assert run.data.params["table_version.runs"] != "-1"
    assert "leave_feed_mm_min_out.r2" in run.data.metrics
    kept = {a.path for a in registry.client.list_artifacts(version.run_id)}
    assert {
        "equation.c",
        "equation.py",
        "equation.tex",
        "equation.txt",
        "latency.json",
        "front.json",
        "gates.txt",
        "evidence",
        "evidence.html",
        "bundle",
    } <= kept


def test_a_second_training_on_the_same_tables_gives_the_same_equation(demo: tuple[Home, dict[str, Any]]) -> None:
    home = demo[0]
    registry = Registry(home)
    first = registry.bundle(registry.version(MACHINE, "1"))
    # The models that it is compared with have no part in it.
    with few_candidates():
        again = train(home, "training-quick", engine=OperonEngine(generations=1, population=20))
    second = registry.bundle(again.version)
    nodes = zip(second["tick_graph"]["nodes"], first["tick_graph"]["nodes"], strict=True)
    for one, other in nodes:
        # The last digits depend on how many threads a sum was parted over.
        assert one.pop("value", 0.0) == pytest.approx(other.pop("value", 0.0), rel=1e-9)
        assert one == other
    # Newest, but not promoted: latest stays the champion.
    assert again.version.version == "2"
    assert resolve("latest", MACHINE, home).version == 1


def test_an_alias_moved_by_hand_changes_nothing(demo: tuple[Home, dict[str, Any]]) -> None:
    home = demo[0]
    registry = Registry(home)
    registry.client.set_registered_model_alias("dtwin-virtual-cobot", "champion", "2")
    assert resolve("latest", MACHINE, home).version == 1
    registry.client.set_registered_model_alias("dtwin-virtual-cobot", "champion", "1")


def test_without_evidence_nothing_becomes_champion(demo: tuple[Home, dict[str, Any]]) -> None:
    home = demo[0]
    version = Registry(home).version(MACHINE, "2")
    path, reason = make_champion(home, version)
    assert path is None
    assert "closed-loop evidence" in reason
    assert history(home, MACHINE)[-1]["action"] == "refused"


def test_a_model_with_the_wrong_sign_makes_it_worse_and_is_refused(demo: tuple[Home, dict[str, Any]]) -> None:
    """Good on paper, harmful on the machine: only the closed loop can tell."""
    home = demo[0]
    registry = Registry(home)
    version = registry.version(MACHINE, "2")
    content = registry.bundle(version)
    from dtwin.serve.bundle import Bundle, _checksum

    body = {k: v for k, v in content.items() if k != "sha256"}
    body["outputs"] = [dict(body["outputs"][0], role="correction")]
    wrong = Bundle.from_dict(body | {"sha256": _checksum(body)})
    measured = measured_circles(wrong, seed=0, tcp_mm=np.array([0.0, 0.0, 158.3]), plan=CIRCLES)
    evidence = measured.evidence(MACHINE, Bundle.from_dict(content).model_sha256)
    assert evidence.conditions[0]["worse"] is True
    with pytest.raises(GateRefusal) as caught:
        promote(registry, home, version, geometry={"virtual": True}, evidence=evidence)
    assert caught.value.exit_code == 3
    assert "no condition worse" in (caught.value.got or "")


def test_champion_previous_and_rollback(demo: tuple[Home, dict[str, Any]]) -> None:
    home = demo[0]
    registry = Registry(home)
    second = registry.version(MACHINE, "2")
    put_on_trial(home, second)
    assert resolve("latest", MACHINE, home).version == 1
    assert resolve("trial", MACHINE, home).version == 2
    measure(home, second, seed=0, plan=CIRCLES)
    path, reason = make_champion(home, second, "better")
    assert path is not None, reason
    assert resolve("latest", MACHINE, home).version == 2
    assert resolve(str(path), MACHINE, home).version == 2
    with pytest.raises(InputError, match="no model on trial"):
        resolve("trial", MACHINE, home)
    assert registry.version(MACHINE, "previous").version == "1"
    rollback(registry, home, MACHINE, "robot hummed")
    assert resolve("latest", MACHINE, home).version == 1
    assert registry.version(MACHINE, "2").tags["state"] == "withdrawn"
    path, reason = make_champion(home, registry.version(MACHINE, "2"))
    assert path is None
    assert "not withdrawn" in reason
    assert [e["action"] for e in history(home, MACHINE)][-2:] == ["rollback", "refused"]


def test_a_real_machine_needs_evidence_of_its_own(demo: tuple[Home, dict[str, Any]]) -> None:
    home = demo[0]
    registry = Registry(home)
    version = registry.version(MACHINE, "1")
    geometry = registry.read_json(version, "geometry.json")
    registry.attach(version, {"geometry.json": json.dumps(geometry | {"virtual": False})})
    try:
        with pytest.raises(InputError, match="measured on it"):
            measure(home, version, seed=0, plan=CIRCLES)
        # The kept evidence was measured on a virtual machine, whatever the version says now.
        path, reason = make_champion(home, version)
        assert path is None
        assert "evidence is of this kind of machine: virtual evidence" in reason
    finally:
        registry.attach(version, {"geometry.json": json.dumps(geometry)})


def test_the_evidence_of_the_demo_is_computed_again_from_its_runs(demo: tuple[Home, dict[str, Any]]) -> None:
    home, found = demo
    again = proven(home, Registry(home).version(MACHINE, "1"))
    assert again is not None
    assert json.loads(json.dumps(again.as_dict())) == found["evidence"]
    rows = {row["run_id"]: row for row in Lake(home.lake).runs("evidence-virtual-cobot-v1")}
    assert {run["run_id"] for run in again.runs} == set(rows)
    assert all(rows[r["run_id"]]["content_sha256"] == r["content_sha256"] for r in again.runs)


def test_commands_speak_json_and_nothing_else(demo: tuple[Home, dict[str, Any]]) -> None:
    done = dtwin(demo[0].root, "models", "--json")
    assert done.returncode == 0, done.stderr
    json.loads(done.stdout)
    for arguments in (["runs"], ["plan"], ["features", "training-quick"]):
        code, out, err = command_here(*arguments, "--json")
        assert code == 0, err
        json.loads(out)
    code, out, err = command_here("promote", "2", "--json")
    assert code == 3, err
    assert json.loads(out)["champion"] is False


def test_a_mistake_ends_in_a_message_and_its_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, code in (
        (["check", str(tmp_path / "nothing.b5r")], 1),
        (["train", "no-such-campaign"], 1),
        (["train", "training-quick", "--engine", "magic"], 1),
        (["promote", "99"], 1),
        (["no-such-command"], 2),
    ):
        monkeypatch.setattr(sys, "argv", ["dtwin", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr().err
        assert ended.value.code == code, (arguments, said)
        assert said
        assert "Traceback" not in said


def test_the_prefect_page_shows_the_five_steps(demo: tuple[Home, dict[str, Any]]) -> None:
    home, found = demo
    assert not (home.root / "servers.json").exists(), "the demo left its server behind"
    # The part of dtwin up that shows runs, on the home's own database; test_up starts all of it.
    with prefect_alone(home) as servers:
        await_healthy(home, servers)
        up = Up(home, servers.children[0].process)
        up.addresses = servers.addresses
        left: dict[str, dict[str, Any]] = {}
        for name in ("recording", "campaign", "training", "correction", "report"):
            (run,) = up.runs_of(f"demo-{name}")
            assert run["state"]["type"] == "COMPLETED", run["state"]
            left[name] = up.artifacts_of(run)
        states = {t["name"]: t["state_type"] for t in up.ask("/task_runs/filter", {"limit": 200})}
    assert states["measure training-quick"] == states["train training-quick"] == "COMPLETED"
    assert set(states.values()) == {"COMPLETED"}
    file = slug(found["recording"]["campaign"])
    findings = json.loads(left["recording"][f"findings-{file}"]["data"])
    assert findings[0]["severity"] == "error"
    assert left["campaign"]["measured-training-quick"]["type"] == "table"
    rows = json.loads(left["training"]["comparison-training-quick"]["data"])
    assert len(rows) == len(found["comparison"])
    assert "data:image/svg+xml" in left["correction"][f"before-and-after-{MACHINE}"]["data"]
    assert "on feeds never trained" in left["report"]["demo-report"]["data"]


def test_a_demo_without_a_page_says_so_and_goes_on(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    said: list[str] = []
    lock = home.root / "locks" / "up.lock"
    lock.parent.mkdir(parents=True)
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with shown_steps(home, lambda title: lambda done, total, what: None, said.append) as steps:
            assert steps.step("one", "1 of 1", lambda work: type(work).__name__) == "_PlainWork"
    assert "no Prefect page" in said[0]


@pytest.mark.long
def test_a_server_that_dies_on_the_way_does_not_end_the_demo(tmp_path: Path) -> None:
    home = Home(tmp_path / "home")
    said: list[str] = []
    with shown_steps(home, lambda title: lambda done, total, what: None, said.append) as steps:
        assert steps.step("one", "1 of 2", lambda work: type(work).__name__) == "TaskWork"
        os.kill(_prefect_server(), signal.SIGKILL)
        assert steps.step("two", "2 of 2", lambda work: type(work).__name__) == "_PlainWork"
    assert "is gone" in said[-1]


def _prefect_server() -> int:
    """The child of this process that is a Prefect server."""
    for task in Path("/proc/self/task").glob("*/children"):
        for child in task.read_text().split():
            if "prefect" in Path(f"/proc/{child}/cmdline").read_text():
                return int(child)
    raise AssertionError("no Prefect server was started")
