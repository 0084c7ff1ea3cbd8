"""The real recording: what one file of a UR10e can tell, and what it cannot."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from dtwin.acquire.b5r import read_b5r
from dtwin.cli import app
from dtwin.errors import InputError
from dtwin.physics.library import Library
from studies.recording import ur10e_geometry
from studies.recording_models import (
    candidate_terms,
    grow,
    harmonic_columns,
    judge,
    left_by_the_other,
    passes_of,
    setup_terms,
)
from studies.recording_passes import align
from studies.report.recording import recording_text

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "data" / "samples" / "ur10e_xy_r100_f5000.b5r"
TUTORIAL = ROOT / "docs" / "tutorials" / "real-recording.md"
pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("single") / "recording.html"


@pytest.fixture(scope="module")
def result(page: Path) -> dict[str, Any]:
    words = shlex.split(re.findall(r"^dtwin (twin recording .*)$", TUTORIAL.read_text("utf-8"), re.M)[0])
    told = [str(ROOT / w) if w.endswith(".b5r") else w for w in words]
    told = [str(page) if w.endswith(".html") else w for w in told]
    said = CliRunner().invoke(app, [*told, "--json"])
    assert said.exit_code == 0, said.output
    found: dict[str, Any] = json.loads(said.stdout)
    return found


def test_the_repeated_stretches_are_those_of_the_published_analysis(result: dict[str, Any]) -> None:
    found = [(s["run_id"], s["first"], s["end"], s["lag_samples"]) for s in result["stretches"]]
    published = [("ccw", 200, 700, 1573), ("ccw", 900, 1600, 1554), ("cw", 600, 1330, 1591)]
    assert len(found) == len(published)
    for (run, first, end, lag), (run_0, first_0, end_0, lag_0) in zip(found, published, strict=True):
        assert run == run_0
        assert abs(lag - lag_0) <= 2
        overlap = min(end, end_0) - max(first, first_0)
        assert overlap > 0.9 * (end_0 - first_0)


def test_the_floor_is_a_lower_bound_of_about_8_um(result: dict[str, Any]) -> None:
    assert result["floor_kind"] == "within_run"
    assert result["floor_um"] == pytest.approx(8.0, abs=1.0)
    assert result["look_up_um"] >= result["floor_um"] * np.sqrt(2.0)


def test_the_clockwise_angles_of_the_file_are_off_and_counter_clockwise_ones_are_not(result: dict[str, Any]) -> None:
    off = {run["run_id"]: run["misregistered_deg"] for run in result["runs"]}
    assert off["cw"] > 20.0
    assert off["ccw"] < 5.0


def test_on_the_other_pass_it_beats_the_vendor_and_harmonics(result: dict[str, Any]) -> None:
    assert result["vendor"]["stated_um"] == pytest.approx(42.2)
    assert result["held_out_um"] < result["vendor"]["stated_um"]
    for harmonics in result["harmonics"].values():
        assert harmonics["parameters"] <= result["parameters"]
        assert result["held_out_um"] < harmonics["held_out_um"]


def test_it_does_not_beat_the_look_up_and_says_that_much_is_unexplained(result: dict[str, Any]) -> None:
    assert result["held_out_um"] > result["look_up_um"]
    assert result["unexplained_um"] > result["floor_um"]
    assert result["verdict"] == "unknown_effect"
    said = recording_text(result)
    assert "is not explained" in said
    waves = min(h["unseen_path_um"] for h in result["harmonics"].values())
    effects = min([result["setup_only_unseen_path_um"], *result["unseen_path_by_rung_um"]])
    assert (f"do better: {waves:.1f} µm" in said) == (waves < effects)


def test_no_name_is_more_than_shape_consistent_and_the_plan_repeats_runs(result: dict[str, Any]) -> None:
    grades = {r["grade"] for rungs in result["ladders"].values() for r in rungs}
    assert grades <= {"shape-consistent", "description only"}
    assert all(step["repeats"] >= 3 for step in result["plan"])
    assert len({step["feed_mm_min"] for step in result["plan"]}) > 1


def test_the_page_is_written(result: dict[str, Any], page: Path) -> None:
    assert result["verdict"] in page.read_text(encoding="utf-8")


def test_joint_effects_follow_where_the_circle_lies() -> None:
    runs = read_b5r(SAMPLE).runs[:1]
    at = [align(run, ur10e_geometry((-550.0, 0.0, 75.0), zero)) for run in runs for zero in (0, -90)]
    here, turned = (a.state.joints for a in at)
    # Turning the bar by 90 deg in the base turns joint 1 of the same place on the robot.
    span = [np.ptp(j.q_rad[800:2380, 0]) for j in (here, turned)]
    assert span[0] == pytest.approx(span[1], rel=0.02)
    assert not np.allclose(here.lever_mm[:, 1], turned.lever_mm[:, 1], atol=1.0)


def test_a_model_is_judged_by_the_pass_it_was_not_fitted_to() -> None:
    passes = passes_of([align(run, {}) for run in read_b5r(SAMPLE).runs])
    waves = harmonic_columns(passes, 9, by_direction=False)
    inside, outside = judge(passes.y_um, waves)
    left = left_by_the_other(passes.y_um, waves)
    assert outside == pytest.approx(np.sqrt(np.mean([(part**2).mean() for part in left])))
    assert inside < outside


def test_noise_alone_adds_no_effect() -> None:
    passes = passes_of([align(run, {}) for run in read_b5r(SAMPLE).runs])
    library = Library()
    state = passes.aligned[0].state
    rng = np.random.default_rng(5)
    n = passes.y_um[0].size
    noise = type(passes)(passes.aligned, (rng.normal(size=n), rng.normal(size=n)))

    pool = [t for t in candidate_terms(library, state, joints=False, clock=True)][::4]
    assert grow(noise, setup_terms(library, state), pool) == []


def test_a_recording_of_one_turn_is_refused_with_the_reason() -> None:
    run = read_b5r(SAMPLE).runs[0]
    short = replace(run, samples={k: v[:1500] for k, v in run.samples.items()}, window=(795, 1500))
    with pytest.raises(InputError) as refused:
        align(short, {})
    assert refused.value.code.startswith("single.")
    still = {name: values if name == "angle_deg" else 0.0 * values for name, values in short.samples.items()}
    with pytest.raises(InputError, match="dtwin ingest reads arcs and single turns, too"):
        align(replace(short, samples=still), {})
