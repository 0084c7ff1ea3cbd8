"""Promotion in the browser: refused with reasons, done with a comment, and rolled back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from closed_loop import circles, in_lake, registered, small_bundle, turns
from playwright.sync_api import Browser, Page, expect
from test_ui import PATIENCE_MS
from workbench_server import Workbench, running_workbench

from dtwin.config import Home
from dtwin.lifecycle.evidence import compute
from dtwin.train.registry import Registry

pytestmark = pytest.mark.system
pytest_plugins = ["chromium"]


def register_three(home: Home) -> None:
    """Versions 1 to 3 of one training: below the gates, good, better; each with its evidence."""
    bundle = small_bundle()
    in_lake(home, "turns", circles(turns(bundle)), virtual=True)
    for version in registered(home, bundle, (0.1, 0.9, 0.95), virtual=True):
        compute(home, version, ["turns"], ["turns"])


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    home = tmp_path_factory.mktemp("models")
    register_three(Home(home))
    with running_workbench(home) as started:
        yield started


@pytest.fixture(scope="module")
def page(browser: Browser, bench: Workbench) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 1280, "height": 900})
    opened.set_default_timeout(PATIENCE_MS)
    opened.goto(bench.address)
    opened.wait_for_url("**/machines")
    yield opened
    opened.close()


def _promote(page: Page, bench: Workbench, version: int, why: str) -> None:
    page.goto(f"{bench.base}/models/mill-a/{version}")
    expect(page.locator("body[data-drawn]")).to_be_attached()
    page.get_by_label("Why").fill(why)
    page.get_by_role("button", name="Promote").click()


def test_a_version_below_the_gates_is_refused_with_the_reasons(page: Page, bench: Workbench, artifacts: Path) -> None:
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


def test_tags_and_aliases_that_somebody_set_in_mlflow_make_no_champion(bench: Workbench) -> None:
    registry = Registry(Home(bench.home))
    registry.client.set_model_version_tag("dtwin-mill-a", "1", "state", "champion")
    registry.client.set_registered_model_alias("dtwin-mill-a", "champion", "1")
    said = "unpromoted, whatever its tags say"
    assert said in bench.ask("/models/mill-a/1")[1]
    listed = bench.ask("/models")[1]
    assert said in listed
    assert '<span class="tag good">champion' not in listed


def test_a_name_that_would_change_the_question_to_the_registry_is_refused(bench: Workbench) -> None:
    status, text = bench.ask("/models/a'or'/1")
    assert (status, "error[name.invalid]" in text) == (400, True)
    assert bench.act("/api/models/a'or'/rollback")[0] == 400


def test_nothing_is_promoted_without_the_token(bench: Workbench) -> None:
    status, _ = bench.ask("/api/models/mill-a/1/promote", method="POST", body=b"{}", origin=bench.base)
    assert status == 403
