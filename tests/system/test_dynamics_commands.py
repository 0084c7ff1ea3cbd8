"""The page on ball-bar dynamics is followed; its commands warn and refuse as they must."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shown_commands import blocks, follow, here, page
from typer.testing import CliRunner

from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.circular._simulate_hexapod import VirtualHexapodBench, feed_sweep
from dtwin.schema import Campaign, Direction, Run
from dtwin.train.registry import Registry
from studies.dynamics.split import split_runs
from studies.dynamics.ways import DynamicsRequest

pytestmark = pytest.mark.system
CAMPAIGN = Campaign("cell", "virtual-hexapod")


def test_the_page_is_followed(tmp_path: Path) -> None:
    follow(blocks(page("docs/how-to/ball-bar-dynamics.md")), tmp_path, here)
    registry = Registry(Home(tmp_path / "home"))
    found = registry.client.search_runs([registry.experiment()])
    (run,) = [r for r in found if r.data.tags.get("dtwin.kind") == "filter tuning"]
    assert run.info.status == "FINISHED"
    assert run.data.params["particles"] == "6"
    assert run.data.params["fitness"] == "weighted_sum"
    assert run.data.metrics["q_um2"] > 0.0
    shown = (tmp_path / "dynamics.html").read_text(encoding="utf-8")
    assert "What to know first" in shown
    assert "Sensitivity to alpha" in shown


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    bench = VirtualHexapodBench(seed=0)
    ways: tuple[Direction, ...] = ("CCW", "CW")
    tests = [t for t in feed_sweep(quick=True).tests if t.feed_mm_min > 2000.0]
    return [bench.measure(test, way) for test in tests for way in ways]


def codes(found: dict[str, Any]) -> set[str]:
    return {f["code"].removeprefix("dynamics.") for f in found["findings"]}


def test_what_the_published_variances_eat_is_said_and_a_low_pass_eats_nothing(runs: list[Run]) -> None:
    published = split_runs(CAMPAIGN, runs, DynamicsRequest(how="kalman")).result
    assert "eats_features" in codes(published)
    assert published["two_lobes"]["taken"] > 0.3
    low_pass = split_runs(CAMPAIGN, runs, DynamicsRequest(how="low-pass")).result
    assert "eats_features" not in codes(low_pass)
    for row in low_pass["rows"]:
        assert row["after_um"] <= row["before_um"]


def test_slow_runs_are_their_own_reference(runs: list[Run]) -> None:
    found = split_runs(CAMPAIGN, runs, DynamicsRequest(how="reference")).result
    assert max(r["difference"] for r in found["rows"]) < 0.03
    assert found["bias"]["dc3_um"] < 0.2
    assert all(len(r["accelerometer_rms_g"]) == 3 for r in found["rows"])


def shaken(run: Run, height_um: float, *, keep: int = 1) -> Run:
    part = slice(*run.window) if run.window else slice(None)
    samples = {name: np.asarray(v)[part][::keep] for name, v in run.samples.items()}
    noise = height_um * (np.random.default_rng(0).random(len(samples["t_s"])) - 0.5)
    samples["deviation_um"] = samples["deviation_um"] + noise
    return replace(run, samples=samples, window=None)


def test_vibration_one_direction_and_few_readings_are_said(runs: list[Run]) -> None:
    one_way = [shaken(r, 0.0, keep=20) for r in runs if r.meta.direction == "CCW"]
    fast = [r.meta.feed_mm_min == 6000.0 for r in one_way]
    loud = [shaken(r, 200.0) if f else r for r, f in zip(one_way, fast, strict=True)]
    found = split_runs(CAMPAIGN, loud, DynamicsRequest(how="low-pass", readings=100)).result
    said = {"one_direction", "few_readings", "vibration_exceeds", "differs_from_reference"}
    assert said <= codes(found)
    quiet = split_runs(CAMPAIGN, one_way, DynamicsRequest(how="low-pass", readings=100)).result
    assert "vibration_exceeds" not in codes(quiet)


def test_one_feed_is_said_and_its_vibration_is_judged_without_a_slow_run(runs: list[Run]) -> None:
    fast = [shaken(r, 200.0) for r in runs if r.meta.feed_mm_min == 6000.0]
    found = split_runs(CAMPAIGN, fast, DynamicsRequest(how="low-pass")).result
    assert {"one_feed", "vibration_exceeds"} <= codes(found)
    assert "differs_from_reference" not in codes(found)


def test_what_cannot_be_compared_is_refused(runs: list[Run]) -> None:
    large = replace(runs[0], meta=replace(runs[0].meta, radius_mm=100.0))
    other = replace(runs[0], meta=replace(runs[0].meta, setup="s2", feed_mm_min=6000.0))
    bare = replace(runs[0], meta=replace(runs[0].meta, radius_mm=None))
    copied = replace(runs[0], meta=replace(runs[0].meta, run_id="copy"))
    start = (runs[0].window or (0, 0))[0]
    half = replace(runs[0], window=(start, start + 2000))
    for wrong, request, told in (
        ([*runs, large], DynamicsRequest(), "several radii"),
        ([*runs, other], DynamicsRequest(), "no slow reference"),
        ([half], DynamicsRequest(), "once round"),
        ([bare], DynamicsRequest(), "radius or its feed"),
        ([*runs, copied], DynamicsRequest(), "same readings"),
        (runs, DynamicsRequest(reference_feed_mm_min=5.0), "feed of the reference"),
        (runs, DynamicsRequest(how="wavelet"), "no such filter"),
        (runs, DynamicsRequest(how="rts", tuned="ratio"), "unscented"),
    ):
        with pytest.raises(InputError, match=told):
            split_runs(CAMPAIGN, wrong, request)


def test_a_campaign_of_another_kind_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "z"
    made = CliRunner().invoke(app, ["simulate", "--machine", "lathe", "--quick", "--out", str(folder), "--json"])
    assert json.loads(made.stdout)["readings"] > 0
    with pytest.raises(InputError, match="circular"):
        CliRunner().invoke(app, ["dynamics", "split", str(folder)], catch_exceptions=False)
