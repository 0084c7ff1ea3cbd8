"""The lathe's page is followed; its commands refuse what they must."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop import small_bundle
from shown_commands import blocks, follow, here, page
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.kinds.linear._gates import registered_positioning_gates
from dtwin.kinds.linear._simulate import mapping_plan, simulate_lathe, verification_plan
from dtwin.lifecycle.drift import check_drift
from dtwin.lifecycle.schedule import scheduled_training
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import load_bundle, save_bundle
from dtwin.train.registry import Registry
from studies.lathe_fit import campaign_test, fitted
from studies.lathe_paper import Size, lathe_paper
from studies.report.papers import lathe_paper_text

CHECK = """[plan]
kind = "linear"
name = "check"
machine = "virtual-lathe"
axis = "Z"
unit = "in"
start = 1
end = 3.34
step = 0.26
runs = 1
feed_min = 20
overshoot = 0.1
axis_low = 0
axis_high = 41
pitch = 0.25
dwell_s = 6
laser_dwell_s = 4
"""

pytestmark = pytest.mark.system


@pytest.mark.long
def test_the_page_is_followed(tmp_path: Path) -> None:
    said = follow(blocks(page("docs/how-to/lathe.md")), tmp_path, here)
    shown = next(text for command, text in said if "compensate" in command)
    for title in ("Max average error", "Max reversal error"):
        percent = float(re.findall(rf"{title}.*?\(([\d.]+) %\)", shown)[0])
        assert 0.0 < percent < 25.0
    assert "outside_box" not in shown


def test_what_a_gate_refused_is_not_written_without_force(tmp_path: Path) -> None:
    out = tmp_path / "printed.json"
    words = ["lathe", "fit", "--model", "printed", "--out", str(out), "--json"]
    refused = CliRunner().invoke(app, words)
    assert (refused.exit_code, out.exists()) == (3, False)
    forced = CliRunner().invoke(app, [*words, "--force"])
    assert forced.exit_code == 0
    assert set(load_bundle(out).bundle.provenance.gates.values()) == {False}
    assert [g["passed"] for g in json.loads(forced.stdout)["gates"]] == [False] * 4


def test_campaigns_that_cannot_show_the_screw_are_refused(tmp_path: Path) -> None:
    head = replace(verification_plan(), end=6.2, runs=1)
    for name, plan, told in (
        ("coarse", replace(head, end=6.0, step=0.5), "do not show the screw"),
        ("short", replace(head, end=2.0, step=0.05, window=0.01), "do not show the screw"),
    ):
        simulate_lathe(tmp_path / name, plan=plan)
        with pytest.raises(InputError, match=told):
            fitted(tmp_path / name, "flanks", 0)
    with pytest.raises(InputError, match="say what"):
        CliRunner().invoke(app, ["lathe", "fit"], catch_exceptions=False)
    other = save_bundle(small_bundle(), tmp_path / "other.json")
    with pytest.raises(InputError, match="does not correct a position"):
        CliRunner().invoke(app, ["lathe", "compensate", str(other)], catch_exceptions=False)


def test_the_comparison_is_made_of_figures_that_can_be_judged() -> None:
    size = Size(campaigns=4, corrected=2, seeds=1, epochs=60, single_epochs=8)
    found = lathe_paper(size, 0, lambda *_: None)
    lines = {line["target"]: line for line in found["lines"]}
    assert set(lines) == {"A1", "A2", "A3", "A4", "A5", "A6", "A7", "A8", "A9", "A10"}
    assert lines["A1"]["answer"] == "follows"
    assert lines["A2"]["answer"] in ("calibrated", "does not")
    # Eight epochs are too few, and it says so.
    assert lines["A8"]["answer"] == "does not"
    assert all(math.isfinite(t["rms_um"]) for t in found["tables"])
    text = lathe_paper_text(found)
    assert "the thesis" in text
    assert "does not" in text


def invoke(*words: str, code: int = 0) -> str:
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == code, done.output
    return done.stdout


@pytest.mark.long
def test_positions_are_trained_promoted_and_tried_like_circles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    plan = replace(mapping_plan(), name="map", end=4.0, runs=3)
    simulate_lathe(tmp_path / "map", plan=plan)
    invoke("ingest", str(tmp_path / "map"))
    trained = json.loads(invoke("train", "map", "--json"))
    left = {c["name"]: c["scores"]["run"] for c in trained["candidates"]}
    assert set(left) == {"zero", "table and backlash", "two tables", "pair", "flanks"}
    assert {scores["n_groups"] for scores in left.values()} == {3}
    # Nothing can leave less than a mean of two runs does of a third.
    floor = trained["noise_floor_um"] * math.sqrt(3 / 2)
    assert left["two tables"]["rms_um"] == pytest.approx(floor, rel=1e-6)
    assert left["flanks"]["rms_um"] < left["table and backlash"]["rms_um"] < left["zero"]["rms_um"]
    assert trained["proposed"] == "flanks"
    assert all(gate["passed"] for gate in trained["gates"])
    assert any("pair is not proposed, it fails: no seam" in line for line in trained["told"])
    promoted = json.loads(invoke("promote", "candidate", "--json"))
    assert promoted["champion"] is True
    conditions = promoted["evidence"]["conditions"]
    assert [c["approached"] for c in conditions] == ["forward", "reverse"]
    assert all(c["reduction"] > 0.7 for c in conditions)
    assert json.loads(invoke("models", "--json"))["versions"][0]["tags"]["evidence"] == "virtual"
    with pytest.raises(InputError, match="only the machine's control can send"):
        CliRunner().invoke(app, ["serve", "--model", "latest"], catch_exceptions=False)
    # On a day that no run of the map was measured on, served to a control in a process of its own.
    check = tmp_path / "check.toml"
    check.write_text(CHECK)
    options = ["--machine", "lathe", "--plan", str(check), "--seed", "7"]
    control = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "simulate", *options, "--listen", "0", "--out", str(tmp_path / "served")],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert control.stderr is not None
    address = re.search(r"127\.0\.0\.1:\d+", control.stderr.readline())
    assert address is not None
    status = json.loads(invoke("serve", "--link", "axes", "--states", address.group(), "--json"))
    said, _ = control.communicate(timeout=600)
    assert "20 readings of the laser" in said
    assert (status["device"], status["ended"], status["fault"]) == ("virtual", "finished", None)
    invoke("simulate", *options, "--out", str(tmp_path / "alone"))
    left, was = (largest_um(tmp_path / name) for name in ("served", "alone"))
    assert left < 0.4 * was
    invoke("ingest", str(tmp_path / "served"))
    with pytest.raises(InputError, match="a correction was in force"):
        CliRunner().invoke(app, ["train", "served"], catch_exceptions=False)
    assert scheduled_training(home()).outcome == "skipped"
    simulate_lathe(tmp_path / "again", plan=replace(plan, name="again"), seed=5)
    invoke("ingest", str(tmp_path / "again"))
    turn = scheduled_training(home())
    assert turn.reason == "3 new runs in again: version 2 is the candidate"
    assert scheduled_training(home()).campaigns == {
        "again": "0 new runs",
        "served": "a correction was in force while it was measured",
        "map": "older than the newest campaign that was trained on",
        "evidence-virtual-lathe-v1": "a correction was in force while it was measured",
    }
    (drift,), compared = turn.drift, turn.comparison
    assert drift.error is not None
    assert compared is not None
    assert (drift.campaign, drift.expected_from, drift.drifted) == ("again", "run", False), drift.reason
    assert drift.error.rms_um < 0.5 * drift.error.before_um
    assert compared.champion_um == drift.error.rms_um
    assert compared.candidate_um < 0.5 * compared.before_um
    newest = Registry(home()).version("virtual-lathe", "candidate")
    assert newest.tags["against_champion"] == compared.verdict
    checked = json.loads(invoke("recheck", "--json"))
    assert (checked["verdict"], [c["name"] for c in checked["conditions"]]) == (
        "helps",
        ["Z forward", "Z reverse", "all"],
    )
    # An axis that wears: its screw is another one now.
    simulate_lathe(tmp_path / "worn", plan=replace(plan, name="worn"), truth="mechanism", seed=6)
    invoke("ingest", str(tmp_path / "worn"))
    worn = check_drift(home(), Registry(home()).version("virtual-lathe", "champion"), "worn")
    assert worn.finding is not None, worn.reason
    again = Bundle.from_dict(Registry(home()).bundle(Registry(home()).version("virtual-lathe", "1")))
    worse = registered_positioning_gates(again, {"screw_pitch_in": 0.25, "explained_share": 0.5})
    assert {v.gate for v in worse if not v.passed} >= {"held-out runs", "the screw is known"}


def largest_um(folder: Path) -> float:
    """Largest error of a test about its mean, as the laser's zero is arbitrary."""
    _, test = campaign_test(folder)
    both = np.stack([test.forward_um, test.reverse_um])
    return float(np.max(np.abs(both - both.mean())))


def test_a_position_cannot_be_learned_from_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    simulate_lathe(tmp_path / "once", plan=replace(mapping_plan(), name="once", end=4.0, runs=1))
    invoke("ingest", str(tmp_path / "once"))
    with pytest.raises(InputError, match="cannot be judged"):
        CliRunner().invoke(app, ["train", "once"], catch_exceptions=False)
