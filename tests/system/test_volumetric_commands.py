"""The page about volumetric errors is followed; what it says is what the commands print."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from axis_control import AxisControl
from shown_commands import blocks, follow, here, page
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.volumetric._check import judge_volumetric_run
from dtwin.kinds.volumetric._evidence import _judged_hours, distance_changes_um
from dtwin.kinds.volumetric._identify import Artefact, Balls, averaged_balls
from dtwin.kinds.volumetric._plan import BallPlan
from dtwin.kinds.volumetric._session import session, session_in
from dtwin.kinds.volumetric._simulate import ServedMill, simulate_volumetric
from dtwin.lake.store import Lake
from dtwin.lifecycle.schedule import scheduled_training
from dtwin.machines.thermal_network import _TRAINING
from dtwin.machines.volumetric import HELD_OUT_POSES, STROKES_MM, VolumetricMill, VolumetricParameters
from dtwin.schema import Run, RunMeta, SignalGroup
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import load_bundle
from dtwin.train.registry import Registry

pytestmark = pytest.mark.system


@pytest.mark.long
def test_the_page_is_followed(tmp_path: Path) -> None:
    said = follow(blocks(page("docs/how-to/volumetric-heat.md")), tmp_path, here)
    fitted, told = (text for command, text in said if "volumetric fit" in command)
    judged = fitted[fitted.index("volumetric-validation:") :]
    noise, held_out = map(float, re.findall(r"leaves ([\d.]+) µm, ([\d.]+) µm in held-out", judged)[0])
    assert 0.5 < noise < 1.5
    assert held_out < 1.5 * noise
    reduction = float(re.findall(r"distances between balls: RMS .*?\(-(\d+) %\)", judged)[0])
    assert reduction >= 55.0
    assert "EXZ1 is not explained by the thermocouples; coolant_tank_c explains it in both" in judged
    assert "EXZ1 is not explained" not in told[told.index("volumetric-validation:") :]
    assert "heat.json written" in fitted
    bundle = load_bundle(tmp_path / "heat.json").bundle
    assert "How much the error changes within a job" in (tmp_path / "heat.html").read_text("utf-8")
    offered = load_bundle(tmp_path / "offered.json").bundle
    (tank,) = [i for i in offered.inputs if i.name == "coolant_tank_c"]
    assert 10.0 < tank.low < tank.high < 50.0, "as the control reads it, not as a difference"
    assert {o.frame for o in bundle.outputs} == {"base_x", "base_y", "base_z"}


def balls(mill: VolumetricMill, cycle: int) -> Balls:
    found = mill.measure(cycle)
    return Balls(found.nominal_mm, found.error_um, found.pose, found.ball)


def test_a_motion_that_the_model_lacks_shows_in_the_held_out_poses() -> None:
    left = {}
    for name, hidden in (("none", {}), ("ECX1", {"ECX1": {"bed": 12.0}})):
        mill = VolumetricMill(_TRAINING, VolumetricParameters(hidden=hidden), 0)
        artefact = Artefact(STROKES_MM, HELD_OUT_POSES, 1.5)
        reference = averaged_balls([balls(mill, 0)])
        where, moved = artefact.variation_um(balls(mill, 158), reference)
        left[name] = artefact.identify(where, moved)
        if name == "ECX1":
            more = Artefact(STROKES_MM, HELD_OUT_POSES, 1.5, names=(*artefact.names, "ECX1"))
            left["added"] = more.identify(where, moved)
    assert left["ECX1"].held_out_um > 2.0 * left["none"].held_out_um
    assert left["added"].held_out_um < 1.2 * left["none"].held_out_um


def run_of(balls_there: np.ndarray, signal: np.ndarray) -> Run:
    n = len(balls_there)
    samples = {
        "t_s": np.arange(float(n)),
        "pose_1": np.zeros(n),
        "ball_1": balls_there.astype(float),
        **{f"{axis}_mm": 100.0 * np.arange(float(n)) for axis in "xyz"},
        **{f"error_{axis}_um": np.zeros(n) for axis in "xyz"},
    }
    group = SignalGroup("thermocouples", 1 / 30, {"bed_01_c": signal})
    return Run(RunMeta("c000", kind="volumetric"), samples, signals=(group,))


def test_a_bad_cycle_is_named() -> None:
    steady = 22.0 + 0.01 * np.arange(20)
    assert judge_volumetric_run(run_of(np.array([0, 1, 2, 0, 1, 2]), steady)) == []
    cases = {
        "balls.fixed_missing": (run_of(np.array([0, 1]), steady), {}),
        "sensor.stuck": (run_of(np.arange(3), np.full(20, 22.0)), {}),
        "sensor.gap": (run_of(np.arange(3), np.where(np.arange(20) < 5, np.nan, steady)), {}),
        "sensor.implausible": (run_of(np.arange(3), np.full(20, 900.0) + steady), {}),
        "cycle.drift": (
            run_of(np.tile(np.arange(3), 2), steady),
            {f"error_{axis}_um": [0, 0, 0, 9.0, 9, 9] for axis in "xyz"},
        ),
        "balls.out_of_range": (run_of(np.arange(3), steady), {f"error_{axis}_um": [0, 0, 5000.0] for axis in "xyz"}),
    }
    for code, (run, changes) in cases.items():
        changed = {**run.samples, **{k: np.array(v) for k, v in changes.items()}}
        found = judge_volumetric_run(Run(run.meta, changed, signals=run.signals))
        assert [f.code for f in found] == [code]
    unnamed = {k: v for k, v in run_of(np.arange(3), steady).samples.items() if k != "pose_1"}
    assert [f.code for f in judge_volumetric_run(Run(run.meta, unnamed))] == ["balls.unnamed"]


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such schedule"):
        simulate_volumetric(tmp_path / "x", lambda *_: None, schedule="autumn")
    for words, told in (
        (["volumetric", "fit", "a", "--out", "b.json"], "needs another campaign"),
        (["volumetric", "fit", "nowhere"], "no such campaign"),
    ):
        with pytest.raises(InputError, match=told):
            CliRunner().invoke(app, words, catch_exceptions=False)


@pytest.mark.long
def test_heat_is_trained_and_judged_by_another_campaign_like_circles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))

    def invoke(*words: str, code: int = 0) -> str:
        done = CliRunner().invoke(app, list(words))
        assert done.exit_code == code, done.output
        return done.stdout

    def measured(name: str, schedule: str, hours: int, seed: int = 0) -> None:
        file = tmp_path / f"{name}.toml"
        file.write_text(
            f'[plan]\nkind = "volumetric"\nname = "{name}"\nmachine = "mill"\nhours = {hours}\nevery_h = 6\n'
        )
        words = ("--machine", "volumetric", "--plan", str(file), "--schedule", schedule, "--seed", str(seed))
        # With thermocouples on the surface an equation without memory is refused at this interval.
        invoke("simulate", *words, "--truth", "pockets", "--out", str(tmp_path / name))
        invoke("ingest", str(tmp_path / name))

    measured("spring", "training", 234)
    trained = json.loads(invoke("train", "spring", "--json"))
    left = {c["name"]: c["scores"]["hours"] for c in trained["candidates"]}
    assert set(left) == {"zero", "one temperature", "few temperatures", "all temperatures"}
    assert {scores["n_groups"] for scores in left.values()} == {5}
    assert left[trained["proposed"]]["rms_um"] < 0.5 * left["zero"]["rms_um"]
    assert trained["noise_floor_um"] < min(scores["rms_um"] for scores in left.values())
    with pytest.raises(GateRefusal, match="no other campaign of the machine can judge"):
        CliRunner().invoke(app, ["promote", "candidate"], catch_exceptions=False)
    measured("summer", "validation", 168)
    promoted = json.loads(invoke("promote", "candidate", "--json"))
    days = promoted["evidence"]["conditions"]
    assert {day["campaign"] for day in days} == {"summer"}
    assert not any(day["worse"] for day in days)
    assert sum(day["after_um"] for day in days) < 0.6 * sum(day["before_um"] for day in days)
    # The warmer season lies partly beyond the box: the correction fades there, it does not step.
    assert max(day["acted"]["outside_box"] for day in days) > 0.3
    registry, lake = Registry(home()), Lake(home().lake)
    bundle = Bundle.from_dict(registry.bundle(registry.version("mill", "champion")))
    abrupt = replace(bundle, safety=replace(bundle.safety, outside="zero"))
    again = _judged_hours(abrupt, session_in(lake, "summer", lambda *_: None))
    kept, dropped = (sum(day["after_um"] for day in found) for found in (days, again))
    assert dropped > 1.3 * kept
    with pytest.raises(InputError, match="every campaign has judged this champion before"):
        CliRunner().invoke(app, ["recheck"], catch_exceptions=False)
    turn = scheduled_training(home())
    (drift,), compared = turn.drift, turn.comparison
    assert (drift.campaign, drift.expected_from) == ("summer", "hours")
    assert drift.error is not None
    assert compared is not None
    assert drift.error.noise_floor_um < drift.error.rms_um < 0.7 * drift.error.before_um
    assert compared.champion_um == drift.error.rms_um
    assert drift.error.outside_box_share > 0.1
    measured("autumn", "training", 168, seed=2)
    checked = json.loads(invoke("recheck", "--json"))
    assert {c["name"].split()[0] for c in checked["conditions"]} == {"autumn", "all"}
    assert checked["verdict"] == "helps", checked["reason"]
    served_heat(tmp_path, invoke)


def served_heat(tmp_path: Path, invoke: Callable[..., str]) -> None:
    """Serve four cycles of the warm season over a connection; three of them are the reference."""
    plan = BallPlan("served", "mill", hours=96.0, every_h=24.0)
    mill = ServedMill(plan, "pockets", "validation", 0, quick=False)
    control = AxisControl(mill, home())
    with control:
        said = json.loads(invoke("serve", "--link", "axes", "--states", control.address, "--json"))
    assert (said["device"], said["ended"], said["fault"]) == ("virtual", "finished", None)
    assert said["largest_um"] > 20.0
    mill.write(tmp_path / "served")
    planned = tmp_path / "alone.toml"
    planned.write_text('[plan]\nkind = "volumetric"\nname = "alone"\nmachine = "mill"\nhours = 96\nevery_h = 24\n')
    words = ("--machine", "volumetric", "--plan", str(planned), "--schedule", "validation", "--truth", "pockets")
    invoke("simulate", *words, "--out", str(tmp_path / "alone"))
    left, was = (moved_um(tmp_path / name) for name in ("served", "alone"))
    assert left < 0.5 * was
    with pytest.raises(InputError, match="a correction was in force"):
        CliRunner().invoke(app, ["train", "served"], catch_exceptions=False)


def moved_um(folder: Path) -> float:
    """RMS of what the distances between balls changed by in the last cycle since the first three."""
    where, moved = session(home(), str(folder), lambda *_: None).moved[-1]
    return float(np.sqrt(np.mean(distance_changes_um(where, moved) ** 2)))
