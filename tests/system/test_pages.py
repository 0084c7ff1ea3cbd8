"""The pages of Prefect and MLflow in a real browser: what a reviewer sees."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from chromium import chromium
from playwright.sync_api import Browser, Page, expect
from running_servers import MACHINE, Up, few_candidates

from dtwin.train.registry import Registry
from flows._runtime import run
from flows.diagnose import diagnose_flow
from flows.train import train_flow

pytest_plugins = ["shared_up"]
pytestmark = pytest.mark.system

PATIENCE_MS = 300_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    opened = browser.new_page(viewport={"width": 1400, "height": 1000})
    opened.set_default_timeout(PATIENCE_MS)
    yield opened
    opened.close()


@pytest.fixture
def up(shared_up: Up, monkeypatch: pytest.MonkeyPatch) -> Up:
    monkeypatch.setenv("DTWIN_HOME", str(shared_up.home.root))
    return shared_up


def flow_run(up: Up, flow: str) -> dict[str, Any]:
    return up.runs_of(flow)[-1]


def test_prefect_shows_the_run_with_its_tables_and_plots(up: Up, page: Page, artifacts: Path) -> None:
    run(diagnose_flow, campaign="quick")
    shown = flow_run(up, "diagnose")
    asked: set[str] = set()
    page.on("request", lambda request: asked.add(urlsplit(request.url).hostname or ""))

    page.goto(up.addresses["prefect_enter"])
    page.wait_for_url("**/deployments*")
    page.goto(f"{up.addresses['prefect']}/runs/flow-run/{shown['id']}")
    expect(page.get_by_text("diagnose quick").first).to_be_visible(timeout=PATIENCE_MS)
    expect(page.get_by_text("Completed").first).to_be_visible()
    page.get_by_text("Artifacts", exact=True).first.click()
    for key in ("findings-quick", "figures-quick", "curves-quick"):
        expect(page.get_by_text(key).first).to_be_visible()
    page.screenshot(path=artifacts / "prefect-run.png")

    left = up.artifacts_of(shown)
    page.goto(f"{up.addresses['prefect']}/artifacts/artifact/{left['curves-quick']['id']}")
    plot = page.locator("img[alt^='YZ R100']").first
    expect(plot).to_be_visible(timeout=PATIENCE_MS)
    assert plot.evaluate("picture => picture.naturalWidth") == 380
    page.screenshot(path=artifacts / "prefect-curves.png")

    page.goto(f"{up.addresses['prefect']}/artifacts/artifact/{left['figures-quick']['id']}")
    expect(page.get_by_text("t001-ccw").first).to_be_visible(timeout=PATIENCE_MS)
    page.screenshot(path=artifacts / "prefect-figures.png")
    assert "127.0.0.1" in asked
    assert asked <= {"127.0.0.1", ""}, "the page asks other computers"


def test_mlflow_shows_a_version_as_a_reviewer_needs_it(up: Up, page: Page, artifacts: Path) -> None:
    registry = Registry(up.home)
    if MACHINE not in registry.machines():
        with few_candidates():
            run(train_flow, campaign="quick")
    candidate = registry.version(MACHINE, "candidate")
    address = f"{up.addresses['mlflow']}/#/models/dtwin-{MACHINE}/versions/{candidate.version}"

    page.goto(up.addresses["mlflow_enter"])
    expect(page).to_have_url(f"{up.addresses['mlflow']}/#/models")
    page.goto(address)
    expect(page.get_by_text("Offline gates:").first).to_be_visible(timeout=PATIENCE_MS)
    expect(page.get_by_text("physics-library").first).to_be_visible()
    expect(page.get_by_text("candidate").first).to_be_visible()
    expect(page.locator("table").get_by_text("look-up").first).to_be_visible()
    page.screenshot(path=artifacts / "mlflow-version.png")

    page.goto(f"{up.addresses['mlflow']}/#/models/dtwin-{MACHINE}")
    expect(page.get_by_text("Versions are served only after").first).to_be_visible(timeout=PATIENCE_MS)
    expect(page.get_by_text("@ candidate").first).to_be_visible()
    page.screenshot(path=artifacts / "mlflow-model.png")

    page.goto(f"{up.addresses['mlflow']}/#/experiments/1/runs/{candidate.run_id}/artifacts")
    expect(page.get_by_text("equation.tex").first).to_be_visible(timeout=PATIENCE_MS)
    page.screenshot(path=artifacts / "mlflow-run.png")
