"""Promotion in the browser: refused with reasons, done with a comment, and rolled back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import FLAGS
from conftest import require_program
from playwright.sync_api import Page, expect, sync_playwright
from test_ui import PATIENCE_MS
from workbench_server import Workbench, running_workbench

from dtwin.config import Home
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.train.registry import Registry
from dtwin.train.results import Candidate, Latency, Scores, TrainingReport

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


def small_bundle() -> Bundle:
    builder = GraphBuilder()
    angle = builder.input("path_angle_rad")
    return create_bundle(
        name="two-lobes",
        machine="mill-a",
        model_version=0,
        inputs=[Input("path_angle_rad", "rad", "path", 500.0, "path", -20.0, 20.0)],
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=builder.graph({"radial_um": 20.0 * builder.apply("cos", 2.0 * angle)}),
        safety=SafetyLimits(clamp_um=15.0),
    )


def candidate(name: str, r2: float, worst: float, bundle: Bundle | None = None) -> Candidate:
    scores = {
        group: Scores(group, r2, 5.0, 4.0, worst, "XY R50 F1000 CCW", 3, 12)
        for group in ("feed_mm_min", "radius_mm")
    }
    front = ({"terms": 2, "held_out_rms_um": 9.0, "radius_out_rms_um": 9.5},
             {"terms": 6, "held_out_rms_um": 5.0, "radius_out_rms_um": 6.0})  # fmt: skip
    return Candidate(
        name, "symbolic" if bundle else "tree", bundle is not None, 7, scores, 4.0,
        latency=Latency(0.5, 1.0, 1000, "bundle tick"), front=front if bundle else (),
        bundle=bundle.to_dict() if bundle else None,
    )  # fmt: skip


def register_three(registry: Registry) -> None:
    """Versions 1 to 3 of one training: below the gates, good, better."""
    bundle = small_bundle()
    proposed = [candidate(f"r2-{r2:g}", r2, 0.5, bundle) for r2 in (0.1, 0.9, 0.95)]
    report = TrainingReport(
        "mill-a", "march", {"runs": 1}, 1.0, 12.0, 12, 4320,
        (*proposed, candidate("tree", -3e11, 1.4)), proposed[-1].name, 1,
    )  # fmt: skip
    ids = registry.log_training(report, {})
    condition: dict[str, Any] = {
        "plane": "XY", "radius_mm": 50.0, "feed_mm_min": 1000.0, "trained": True, "n_runs": 4,
        "before_um": 12.0, "before_ci_um": 1.0, "after_um": 4.0, "after_ci_um": 1.0,
        "reduction": 0.67, "oracle_um": 2.0, "floor_um": 1.0, "worse": False,
    }  # fmt: skip
    evidence = {
        "kind": "virtual", "clock": "machine clock", "bundle_sha256": bundle.sha256,
        "conditions": [condition], "delays": {},
    }  # fmt: skip
    geometry = {"type": "ur10e", "tcp_mm": [0.0, 0.0, 100.0], "virtual": True}
    files: dict[str, str | bytes] = {
        "geometry.json": json.dumps(geometry), "evidence.json": json.dumps(evidence)
    }  # fmt: skip
    for one in proposed:
        registry.attach(registry.register(report, ids[one.name], one, ""), files)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    home = tmp_path_factory.mktemp("models")
    register_three(Registry(Home(home)))
    with running_workbench(home) as started:
        yield started


@pytest.fixture(scope="module")
def page(bench: Workbench) -> Iterator[Page]:
    program = require_program("chromium", "chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        opened = browser.new_page(viewport={"width": 1280, "height": 900})
        opened.set_default_timeout(PATIENCE_MS)
        opened.goto(bench.address)
        opened.wait_for_url("**/campaigns")
        yield opened
        browser.close()


def _promote(page: Page, bench: Workbench, version: int, why: str) -> None:
    page.goto(f"{bench.base}/models/mill-a/{version}")
    expect(page.locator("body[data-drawn]")).to_be_attached()
    page.get_by_label("Why").fill(why)
    page.get_by_role("button", name="Promote").click()


def test_a_version_below_the_gates_is_refused_with_the_reasons(
    page: Page, bench: Workbench, artifacts: Path
) -> None:
    _promote(page, bench, 1, "let us see")
    expect(page.locator("#work-error")).to_contain_text("error[promote.refused]")
    expect(page.locator("#work-error")).to_contain_text("held-out conditions")
    page.reload()
    expect(page.locator(".findings")).to_contain_text("FAIL held-out conditions")
    expect(page.locator("figure .refusal")).to_have_count(0)
    page.screenshot(path=artifacts / "refused.png", full_page=True)
    page.goto(f"{bench.base}/models")
    expect(page.locator("main")).to_contain_text("let us see")


def test_promoted_with_a_comment_and_rolled_back(page: Page, bench: Workbench) -> None:
    _promote(page, bench, 2, "first good one")
    expect(page.locator(".heading")).to_contain_text("champion")
    _promote(page, bench, 3, "a little better")
    expect(page.locator(".heading")).to_contain_text("champion")
    pointer = bench.home / "bundles" / "mill-a" / "champion.json"
    assert json.loads(pointer.read_text())["version"] == 3
    page.goto(f"{bench.base}/models")
    page.get_by_label("Why").fill("chatter at F4000")
    page.get_by_role("button", name="Roll back").click()
    page.wait_for_url("**/models/mill-a/2")
    assert json.loads(pointer.read_text())["version"] == 2
    status, text = bench.ask("/models")
    assert status == 200
    assert all(why in text for why in ("first good one", "a little better", "chatter at F4000"))


def test_nothing_is_promoted_without_the_token(bench: Workbench) -> None:
    status, _ = bench.ask(
        "/api/models/mill-a/1/promote", method="POST", body=b"{}", origin=bench.base
    )
    assert status == 403
