"""axe finds nothing serious on any page of the workbench, wide and on a tablet, light and dark."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import plotly.graph_objects as go
import pytest
from axe_playwright_python.sync_playwright import Axe
from laser_axis import write_laser
from playwright.sync_api import Browser, Page
from starlette.routing import Route
from test_ui import PATIENCE_MS, _settled
from test_ui_models import register_three
from workbench_server import Workbench, running_workbench

from dtwin.acquire.ingest import ingest
from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.machine_record import with_event
from dtwin.pipeline.machine_joint import machine_joint
from dtwin.pipeline.planned_tests import draft_of, keep_plan
from dtwin.report.certificate import certificate_page
from dtwin.report.sheet import Characteristic, Part, Sheet, judged
from dtwin.report.uncertainty import Contribution
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

pytestmark = pytest.mark.system
pytest_plugins = ["chromium"]
ROOT = Path(__file__).parents[2]

PAGES = (
    "/machines",
    "/machines/virtual-mill",
    "/machines/virtual-mill/next",
    "/machines/virtual-mill/together",
    "/machines/virtual-mill/plan",
    "/machines/virtual-mill/plan?radius_mm=9000",
    "/machines/virtual-mill/changes?campaign=mill-none",
    "/campaigns",
    "/campaigns?find=mill",
    "/campaigns/mill-backlash",
    "/campaigns/mill-backlash/runs/r001",
    "/campaigns/mill-backlash/certificate.html",
    "/campaigns/laser-x",
    "/campaigns/ur5-random",
    "/twins",
    "/twins/mill",
    "/twins/mill/diagnose",
    "/twins/mill/versions",
    "/twins/mill/budget",
    "/twins/both",
    "/effects",
    "/effects/backlash",
    "/models",
    "/models/mill-a/2",
    "/live",
    "/measuring",
    "/nowhere",
)
# Answers that are no page: figures, files, what scripts ask for.
_NO_PAGES = re.compile(
    r"^/$|/api/|/delivery/|/static/|\{ending\}|\.ics|plan\.zip|\.zip|\.toml|report|export|template|/download|\.json"
)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    root = tmp_path_factory.mktemp("axe")
    home = Home(root / "home")
    register_three(home)
    for hidden in ("none", "backlash"):
        simulate_mill(root / hidden, quick=True, hidden=hidden)
        ingest(root / hidden, Lake(home.lake))
    ingest(write_laser(root / "laser-x", "virtual-mill", "X", 25.0, 3.0), Lake(home.lake))
    ingest(ROOT / "data/poses/ur5-random", Lake(home.lake))
    twins = Twins(home)
    twins.fit("mill-backlash", ["scale_mismatch", "squareness"], "mill")
    twins.diagnose("mill")
    twins.add("mill", "backlash", "X")
    twins.diagnose("mill")
    twins.fit(["mill-backlash", "laser-x"], ["backlash:X"], "both")
    twins.diagnose("both")
    machine_joint(home, "virtual-mill")
    with_event(home, "virtual-mill", "crash", "2026-03-01", "vice")
    keep_plan(home, draft_of(home, "virtual-mill", "circular"))
    with running_workbench(home.root) as started:
        yield started


@pytest.fixture(scope="module")
def page(browser: Browser, bench: Workbench) -> Iterator[Page]:
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE_MS)
    opened.goto(bench.address)
    opened.wait_for_url("**/machines")
    yield opened
    opened.close()


def test_a_certificate_of_two_axes_is_no_wider_than_its_paper(browser: Browser) -> None:
    symbols = ["A", "A↑", "A↓", "R", "R↑", "R↓", "E", "E↑", "E↓", "B", "B̄", "M"]
    off = (Contribution("instrument", 1.2, "stated", assumed=False),)
    figures = [Characteristic(s, s, 25.4, 1, 1.2, 4.0, contributions=off) for s in symbols]
    parts = tuple(Part(f"axis {axis}, 0 to 250 mm, 7 targets", (axis,), tuple(figures), True) for axis in "XZ")
    sheet = judged(Sheet("ISO 230-2, positioning", "A", parts, "", ()), {}).as_dict()
    opened = browser.new_page(viewport={"width": 718, "height": 900})
    opened.set_content(certificate_page({"campaign": "c", "machine": "m"}, sheet, [go.Figure()] * 2, []))
    assert opened.evaluate("document.documentElement.scrollWidth") <= 718
    opened.close()


def test_every_page_is_among_those_that_are_looked_at(tmp_path: Path) -> None:
    app = application(Bench(Home(tmp_path), Access("127.0.0.1", 8765))).app
    # A newer fastapi keeps the routers that were included.
    parts = [getattr(part, "original_router", app).routes for part in app.routes]
    routes = {r.path: r for routes in parts for r in routes if isinstance(r, Route) and "GET" in (r.methods or ())}
    pages = [r for r in routes.values() if not _NO_PAGES.search(r.path)]
    assert len(pages) > 15
    missed = [r.path for r in pages if not any(r.path_regex.match(path.partition("?")[0]) for path in PAGES)]
    assert missed == []


@pytest.mark.parametrize(
    ("width", "scheme"),
    [
        pytest.param(1440, "light", marks=pytest.mark.long),
        pytest.param(820, "dark", marks=pytest.mark.long),
        pytest.param(1440, "dark", marks=pytest.mark.long),
        pytest.param(820, "light", marks=pytest.mark.long),
    ],
)
def test_nothing_serious_is_found(page: Page, bench: Workbench, width: int, scheme: str) -> None:
    page.set_viewport_size({"width": width, "height": 1000})
    page.emulate_media(color_scheme="dark" if scheme == "dark" else "light", reduced_motion="reduce")
    found: dict[str, list[str]] = {}
    for path in PAGES:
        page.goto(bench.base + path)
        if page.locator("body[data-may]").count():
            _settled(page)
        for one in Axe().run(page).response["violations"]:
            if one["impact"] in ("serious", "critical"):
                where = "; ".join(f"{node['html'][:160]} {node['failureSummary'][:200]}" for node in one["nodes"][:3])
                found.setdefault(path, []).append(f"{one['id']} ({one['impact']}): {where}")
        wide = page.evaluate("document.documentElement.scrollWidth")
        if wide > width:
            found.setdefault(path, []).append(f"{wide} px wide in a window of {width} px")
    assert not found, "\n".join(f"{path}: {line}" for path, lines in found.items() for line in lines)
