"""The page about slow tool servo is followed; its commands refuse what they must; the registry takes tones."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from axis_control import AxisControl
from closed_loop import small_bundle
from shown_commands import blocks, follow, here, page
from typer.testing import CliRunner

from dtwin.acquire.ingest import open_source
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.kinds.sinusoidal._plan import TonePlan
from dtwin.kinds.sinusoidal._served import ServedSlide
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning, virtual_slide
from dtwin.lifecycle.drift import check_drift
from dtwin.serve.bundle_file import save_bundle
from dtwin.train.registry import Registry
from flows._runtime import run
from flows.papers import turning_paper_flow
from studies.paper_line import ANSWERS
from studies.report.papers import turning_paper_text
from studies.turning_paper import calibration_lines, printed_phase_deg, turning_paper

pytestmark = pytest.mark.system


def invoke(*words: str, code: int = 0) -> str:
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == code, done.output
    return done.stdout


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("turning") / "tones"
    simulate_turning(folder, grid=Grid((10.0, 20.0, 30.0, 40.0), (2.0, 6.0, 11.0)))
    return folder


def test_the_page_is_followed(tmp_path: Path) -> None:
    said = follow(blocks(page("docs/how-to/slow-tool-servo.md")), tmp_path, here)
    shown = next(text for command, text in said if "compensate" in command)
    row = next(line for line in shown.splitlines() if line.startswith("40 "))
    form, phase = (float(v) for v in re.findall(r"\(-([\d.]+) %\)", row)[:2])
    assert form > 85.0
    assert phase > 93.0
    assert "became worse: none" in shown
    assert (tmp_path / "surfaces.html").stat().st_size > 100_000


@pytest.mark.long
def test_tones_are_trained_promoted_and_tried_like_circles(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    invoke("ingest", str(campaign))
    trained = json.loads(invoke("train", "slow-tool-servo-linear", "--json"))
    assert all(gate["passed"] for gate in trained["gates"])
    assert trained["noise_floor_um"] is None
    assert any("dead constant" in line for line in trained["told"])
    names = {c["name"] for c in trained["candidates"]}
    assert {"two-modes", "symbolic-operon", "narx", "printed-form", "boosting", "zero"} <= names
    promoted = json.loads(invoke("promote", "candidate", "--json"))
    assert promoted["champion"] is True
    assert [c["frequency_hz"] for c in promoted["evidence"]["conditions"]] == [5, 10, 20, 30, 40]
    versions = json.loads(invoke("models", "--json"))["versions"]
    assert versions[0]["tags"]["evidence"] == "virtual"
    assert "champion" in versions[0]["aliases"]
    home, drifts = Home(tmp_path / "home"), {}
    champion = Registry(home).version("virtual-turning", "champion")
    for truth in ("linear", "hardening"):
        again = TonePlan(f"again-{truth}", "virtual-turning", (10.0, 30.0), (2.0, 10.0), repeats=2)
        simulate_turning(tmp_path / again.name, plan=again, truth=truth, seed=2)
        invoke("ingest", str(tmp_path / again.name))
        drifts[truth] = check_drift(home, champion, again.name)
    sound, stiffer = drifts["linear"], drifts["hardening"]
    assert sound.error is not None
    assert sound.error.rms_um < 0.01 * sound.error.before_um
    assert (sound.drifted, sound.expected_from) == (False, "amplitude_um"), sound.reason
    assert stiffer.finding is not None, stiffer.reason
    checked = json.loads(invoke("recheck", "--json"))
    assert checked["verdict"] == "helps", checked["reason"]
    tried = json.loads(invoke("turning", "compensate", "latest", "--frequency", "40", "--json"))
    assert tried["rows"][0]["reduction"]["form_um"] > 0.85
    with pytest.raises(InputError, match="only the machine's control can send"):
        CliRunner().invoke(app, ["serve", "--model", "latest"], catch_exceptions=False)
    plan = TonePlan("served", "virtual-turning", (40.0,), (5.0,), seconds=1.0)
    control = AxisControl(ServedSlide(plan, "linear", 3), home)
    with control:
        said = json.loads(invoke("serve", "--link", "axes", "--states", control.address, "--json"))
    assert (said["device"], said["ended"], said["fault"]) == ("virtual", "finished", None)
    # Nothing before the first window of five seconds, and every tick after it.
    assert said["reasons"]["device_stopped"] == 5 * 8000
    control.machine.write(tmp_path / "served")
    (run,) = [run for part, _ in open_source(tmp_path / "served")[1] for run in part]
    command, tool = (run.samples[name] * 1000.0 for name in ("cmd_z_mm", "tool_z_mm"))
    left = abs(fit_tone(run.samples["t_s"], tool - command, 40.0).phasor)
    assert left < 0.1, "4.3 µm without"


def test_what_a_gate_refused_is_not_written_without_force(campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "subtract.json"
    words = ["turning", "fit", str(campaign), "--action", "subtract", "--out", str(out), "--json"]
    said = json.loads(invoke(*words, code=3))
    assert [g["gate"] for g in said["gates"] if not g["passed"]] == ["stable on its own correction"]
    assert not out.exists()
    assert json.loads(invoke(*words, "--force"))["file"] == str(out)


def test_bad_input_is_refused(campaign: Path, tmp_path: Path) -> None:
    other = save_bundle(small_bundle(), tmp_path / "other.json")
    for words, told in (
        (["fit", str(campaign), "--model", "magic"], "no such equation"),
        (["fit", str(campaign), "--action", "hope"], "no such equation"),
        (["compensate", str(other)], "does not correct tones"),
        (["compensate", str(other), "--frequency", "0"], "cannot move so"),
    ):
        with pytest.raises(InputError, match=told):
            CliRunner().invoke(app, ["turning", *words], catch_exceptions=False)


def test_the_mechanism_is_compared_with_the_printed_figures() -> None:
    lines = calibration_lines(virtual_slide("linear"))
    assert {line.answer for line in lines} == {"calibrated", "does not", "not judged"}
    # 0.99 against 1.06 and 0.32 against 0.42 degrees are not what is printed.
    short = {line.what.removeprefix("mechanism: ") for line in lines if line.answer == "does not"}
    assert short == {"encoder lag at 30 Hz", "amplitude error at 5 Hz", "tool lag at 5 Hz"}
    assert "1.97 µm, but" in turning_paper_text({"lines": [asdict(line) for line in lines], "told": []})


def test_the_printed_phase_equation_cannot_reach_what_is_printed_beside_it() -> None:
    frequency = np.array([5.0, 30.0, 40.0, 400.0])
    said = printed_phase_deg(frequency, np.full(4, 1.1107))
    # By hand: 1.95 - 1.23 tanh(1.2155 - 0.0441 f).
    assert said[:3] == pytest.approx([1.016, 2.080, 2.564], abs=0.002)
    assert said.max() < 1.95 + 1.23 < 4.13


@pytest.mark.long
def test_the_comparison_is_made_of_figures_that_can_be_judged() -> None:
    found = turning_paper(quick=True, seed=1, progress=lambda *_: None)
    answer = {line["what"]: line["answer"] for line in found["lines"]}
    assert answer["surface at 40 Hz: form error"] == "easier here"
    assert answer["NARX, mean amplitude error"] == "easier here"
    assert answer["exponent beyond the encoder, linear slide"] == "follows"
    assert answer["crest and shape factor matter"] == "does not"
    assert answer["phase equation as printed, on the linear slide"] == "does not"
    assert answer["40 Hz, amplitude error times a sine"] == "does not"
    assert answer["two modes: features"] == answer["LSTM"] == "not judged"
    text = turning_paper_text(found)
    assert "the paper" in text
    assert "dead constant" in text


@pytest.mark.long
def test_the_flow_gives_the_same_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    found = run(turning_paper_flow, quick=True)
    assert found["groups"] == 24
    assert {line["answer"] for line in found["lines"]} == set(ANSWERS)
