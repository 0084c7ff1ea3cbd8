"""The workbench in a real browser: from a dropped file to an error that falls."""

from __future__ import annotations

import io
import json
import math
import re
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from command_here import printed
from playwright.sync_api import Browser, BrowserContext, Page, Route, expect
from workbench_server import Workbench, running_workbench

from dtwin.config import Home
from dtwin.people import add_person

pytestmark = pytest.mark.system
pytest_plugins = ["chromium"]

PATIENCE_MS = 300_000
# Plotly's button that uploads a chart to its cloud.
SHARES = ".modebar-btn[data-title^='Share']"
expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mill") / "mill"
    printed("simulate", "--machine", "mill", "--hidden", "backlash", "--quick", "--out", out)
    return out


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    own = tmp_path_factory.mktemp("effects")
    home = tmp_path_factory.mktemp("workbench")
    with running_workbench(home, "--effects-path", str(own)) as started:
        yield started
        assert started.stop() == 0
        assert started.process.stderr is not None
        said = started.process.stderr.read()
        assert said == "stopped\n"


@pytest.fixture(scope="module")
def context(browser: Browser) -> Iterator[BrowserContext]:
    opened = browser.new_context(viewport={"width": 1280, "height": 900})
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def tab(context: BrowserContext, bench: Workbench) -> Iterator[tuple[Page, list[str], set[str]]]:
    """One page for all tests, what fails on it, and what it asks of other computers.

    A page of its own would read Plotly again for every test: two seconds of a processor.
    """
    opened = context.new_page()
    opened.set_default_timeout(PATIENCE_MS)
    errors: list[str] = []
    elsewhere: set[str] = set()
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("request", lambda r: elsewhere.add(r.url) if not _own(r.url, bench) else None)
    yield opened, errors, elsewhere
    opened.close()


@pytest.fixture
def page(tab: tuple[Page, list[str], set[str]], bench: Workbench) -> Iterator[Page]:
    opened, errors, elsewhere = tab
    opened.goto(bench.address)
    opened.wait_for_url("**/machines")
    yield opened
    opened.unroute_all()
    assert not errors
    assert not elsewhere, "the page asks other computers"


def _own(url: str, bench: Workbench) -> bool:
    return url.startswith((bench.base, "data:", "blob:"))


def _zipped(folder: Path, **changed: str) -> bytes:
    """The campaign as an archive, with other words in its campaign.toml."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for path in sorted(folder.iterdir()):
            content = path.read_bytes()
            if path.name == "campaign.toml":
                for key, value in changed.items():
                    pattern = rf'^{key} = ".*"$'.encode()
                    content = re.sub(pattern, f'{key} = "{value}"'.encode(), content, flags=re.M)
            archive.writestr(f"{folder.name}/{path.name}", content)
    return out.getvalue()


def _ingested(bench: Workbench, archive: bytes) -> None:
    tray = json.loads(bench.act("/api/trays")[1])["tray"]
    assert bench.act(f"/api/trays/{tray}?name=mill.zip", archive, "PUT")[0] == 200
    job = json.loads(bench.act(f"/api/trays/{tray}/ingest")[1])["job"]
    assert _awaited(bench, job)["state"] == "done"


def _heights(page: Page) -> list[float]:
    expect(page.locator("#waterfall .bars path").first).to_be_attached()
    found = page.evaluate("document.querySelector('#waterfall .canvas').data[0].y")
    # The height of the newest bar, at the floor, stands on the right above it.
    floor = page.evaluate("document.querySelector('#waterfall .canvas').layout.annotations[0]")
    assert (floor["xanchor"], floor["yanchor"]) == ("left", "top")
    return [float(height) for height in found]


def _awaited(bench: Workbench, job: str) -> dict[str, str]:
    found: dict[str, str] = {"state": "waiting"}
    while found["state"] in ("waiting", "running"):
        time.sleep(0.1)
        found = json.loads(bench.ask(f"/api/jobs/{job}")[1])
    return found


def _settled(page: Page) -> None:
    expect(page.locator("body[data-drawn]")).to_be_attached()
    expect(page.locator("[aria-busy]")).to_have_count(0)
    expect(page.locator("figure .refusal")).to_have_count(0)


def test_from_a_dropped_file_to_an_error_that_falls(
    page: Page, bench: Workbench, folder: Path, artifacts: Path
) -> None:
    expect(page.get_by_text("Nothing was measured yet.")).to_be_visible()
    page.set_input_files("#pick-files", {"name": "mill.zip", "mimeType": "application/zip", "buffer": _zipped(folder)})
    page.wait_for_url("**/campaigns/mill-backlash")
    expect(page.get_by_role("heading", name="mill-backlash")).to_be_visible()
    expect(page.get_by_text("36 runs in 2 set-ups")).to_be_visible()
    expect(page.locator("input[value=joint_reversal]")).to_have_count(0)
    assert not list((bench.home / "workbench" / "uploads").glob("*")), "the tray is emptied"

    expect(page.get_by_text("ISO 230-4, circular test")).to_be_visible()
    expect(page.get_by_role("row", name="G(b)").first).to_contain_text("±")
    expect(page.locator(".sheet [data-figure]")).to_contain_text("µm per division")
    page.get_by_text("Fit a twin with chosen effects").click()
    page.get_by_label("Name of the twin").fill("mill")
    page.locator("input[value=squareness]").check()
    page.locator("input[value=scale_mismatch]").check()
    page.get_by_role("button", name="Fit").click()
    expect(page.locator("#work")).to_be_visible()
    page.wait_for_url("**/twins/mill")
    _settled(page)
    expect(page.get_by_text("noise floor ±", exact=False).first).to_be_visible()
    expect(page.locator(".modebar-btn").first).to_be_attached()
    expect(page.locator(SHARES)).to_have_count(0)
    page.screenshot(path=artifacts / "compare.png", full_page=True)

    page.get_by_role("link", name="Diagnose", exact=True).click()
    expect(page.get_by_text("was not diagnosed yet")).to_be_visible()
    page.get_by_role("button", name="Diagnose").click()
    expect(page.get_by_role("heading", name="An effect is missing")).to_be_visible()
    _settled(page)
    expect(page.locator(".verdict")).to_contain_text("Backlash X is missing")
    expect(page.locator("#signature-plot")).to_contain_text("What Backlash X would take away")
    page.screenshot(path=artifacts / "diagnose.png", full_page=True)

    page.get_by_role("button", name="Add Backlash X").first.click()
    page.wait_for_url("**/twins/mill/versions")
    before, first, second = _heights(page)
    assert before > first > 1.5 * second
    page.screenshot(path=artifacts / "versions.png", full_page=True)

    page.get_by_role("button", name="Roll back to 1").click()
    page.wait_for_function("() => document.querySelectorAll('[data-post$=rollback]').length === 2")
    assert _heights(page)[-1] == pytest.approx(first, abs=0.005)
    page.goto(f"{bench.base}/twins/mill/versions?first=2&second=3")
    expect(page.get_by_role("heading", name="Version 2: add backlash X")).to_be_visible()
    expect(page.get_by_role("heading", name="Version 3: restore v1")).to_be_visible()


def test_compare_draws_what_is_chosen(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/twins/mill")
    _settled(page)
    box = page.locator("#map .nsewdrag").bounding_box()
    assert box is not None
    page.locator("#map").scroll_into_view_if_needed()
    page.locator("#map .nsewdrag").click(position={"x": box["width"] / 2, "y": 3})
    expect(page.locator("#conditions input").first).to_be_checked()
    expect(page.locator("#runs input")).to_have_count(3)
    page.locator("#runs input").first.check()
    expect(page.locator("#polar")).to_contain_text("run r001")
    assert "run=r001" in page.url
    page.get_by_label("Plane").focus()
    page.get_by_label("Direction").select_option("CW")
    expect(page.locator("#conditions label:visible")).to_have_count(6)


def test_magnification_takes_german_and_english_numbers(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/twins/mill")
    _settled(page)
    field = page.get_by_label("Magnification as a number")
    for typed, meant in (("2000,5", 2000.5), ("1.500,5", 1500.5), ("0.5", 0.5)):
        field.fill(typed)
        field.press("Enter")
        drawn = page.evaluate(
            "() => { const p = document.querySelector('#polar .canvas'); const t = p.data.at(-1);"
            "return (t.r[7] - p.layout.meta.radius_mm) * 1000 / t.customdata[7]; }"
        )
        assert drawn == pytest.approx(meant, rel=1e-6)
    field.fill("viel")
    field.press("Enter")
    expect(page.get_by_text("not a magnification")).to_be_visible()


def test_every_page_is_reached_by_keyboard_fits_a_phone_and_passes_axe(browser: Browser, bench: Workbench) -> None:
    phone = browser.new_page(viewport={"width": 390, "height": 800})
    phone.set_default_timeout(PATIENCE_MS)
    phone.goto(bench.address)
    phone.wait_for_url("**/machines")
    barriers: dict[str, str] = {}
    phone.keyboard.press("Tab")
    assert phone.evaluate("document.activeElement.textContent") == "Skip to the content"
    for path in (
        "/machines",
        "/machines/virtual-mill",
        "/campaigns",
        "/campaigns/mill-backlash",
        "/twins",
        "/twins/mill",
        "/twins/mill/diagnose",
        "/twins/mill/versions",
        "/effects",
        "/models",
        "/live",
    ):
        phone.goto(bench.base + path)
        _settled(phone)
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390, path
        unnamed = phone.evaluate(
            "() => [...document.querySelectorAll('button, a[href], input:not([type=hidden]), select, textarea')]"
            ".filter(e => !(e.textContent.trim() || e.getAttribute('aria-label') || e.labels?.length))"
            ".map(e => e.outerHTML)"
        )
        assert unnamed == [], path
        broken = Axe().run(phone)
        if broken.violations_count:
            barriers[path] = broken.generate_report()
    # Pages without figures have let the browser compile what draws.
    assert "plotly.js" in phone.evaluate("localStorage.getItem('dtwin-compiled')")
    phone.close()
    assert not barriers, "\n".join(f"{path}: {report}" for path, report in barriers.items())


def test_a_real_recording_is_dropped_on_the_page(page: Page, bench: Workbench, real_recording: Path) -> None:
    page.goto(f"{bench.base}/campaigns")
    transfer = page.evaluate_handle(
        "text => { const d = new DataTransfer();d.items.add(new File([text], 'ur10e.b5r')); return d; }",
        real_recording.read_text(encoding="latin-1"),
    )
    page.dispatch_event("#drop", "drop", {"dataTransfer": transfer})
    page.wait_for_url("**/campaigns/ur10e")
    expect(page.get_by_text("conditions have no repeat")).to_be_visible()
    page.get_by_role("link", name="ccw", exact=True).click()
    _settled(page)
    expect(page.get_by_text("spectrum of one run")).to_be_visible()
    assert "tests are decided by those in their files" in bench.ask("/machines/ur10e-error-map")[1]
    # Before the drawing library runs, a polar plot stands as lines.
    page.route("**/plotly.js*", lambda route: route.abort())
    page.goto(f"{bench.base}/campaigns/ur10e")
    expect(page.locator("#sheet ~ .plot")).to_contain_text("plotly.js did not load")
    expect(page.locator(".canvas").get_by_text("0", exact=True)).to_be_visible()
    # The nominal circle and a curve for each direction, inside the figure.
    boxes = [line.bounding_box() for line in page.locator(".canvas polyline").all()]
    assert len(boxes) == 3
    assert all(b and 150.0 < b["width"] < 560.0 and 150.0 < b["height"] < 560.0 for b in boxes)


def test_a_table_alone_is_asked_how_it_was_measured_then_amended_and_left_out(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/campaigns")
    t_s = [i * 0.01 for i in range(800)]
    rows = [f"{t:.2f};{-45 * t:.2f};{3 * math.sin(t) + 0.7 * math.cos(9 * t):.3f}" for t in t_s]
    content = "t_s;angle_deg;deviation_um\n" + "\n".join(rows).replace(".", ",")
    page.set_input_files("#pick-files", {"name": "alone.csv", "mimeType": "text/csv", "buffer": content.encode()})
    page.get_by_label("Machine", exact=True).fill("mill-x")
    page.get_by_label("Plane").select_option("XY")
    page.get_by_label("Radius, mm").fill("1500")
    page.get_by_label("Programmed feed, mm/min").fill("7069")
    page.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/alone")
    expect(page.locator("tbody").get_by_text("CW", exact=True)).to_be_visible()
    expect(page.get_by_text("a wrong feed, or a radius in another unit").first).to_be_visible()

    page.get_by_label("Field").fill("radius_mm")
    page.get_by_label("is", exact=True).fill("150")
    page.get_by_label("because").fill("one nought too many")
    page.get_by_role("button", name="Amend").click()
    expect(page.get_by_text("radius_mm stated anew, because one nought too many")).to_be_visible()
    expect(page.get_by_text("a radius in another unit")).to_have_count(0)

    page.get_by_role("link", name="alone", exact=True).click()
    _settled(page)
    page.get_by_label("Because").fill("the magnet slipped")
    page.get_by_role("button", name="Leave this run out").click()
    expect(page.get_by_text("left out by hand")).to_be_visible()
    expect(page.get_by_text("left out, because the magnet slipped")).to_be_visible()
    expect(page.get_by_text("radius_mm stated anew, because one nought too many")).to_be_visible()


def test_a_report_with_tables_is_read_as_it_is(page: Page, bench: Workbench) -> None:
    table = [
        "| target | actual 1 | actual 2 |",
        "| --- | --- | --- |",
        *(f"| {n} | {n}.001 | {n}.002 |" for n in (0, 10, 20)),
    ]
    content = "\n".join(["## Forward", *table, "", "## Reverse", *table])
    page.goto(f"{bench.base}/campaigns")
    page.set_input_files("#pick-files", {"name": "slide.md", "mimeType": "text/plain", "buffer": content.encode()})
    page.get_by_label("Machine", exact=True).fill("mill-y")
    page.get_by_label("Axis").fill("X")
    page.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/slide")
    expect(page.get_by_text("ISO 230-2").first).to_be_visible()


def test_a_report_of_several_instruments_asks_which(page: Page, bench: Workbench, artifacts: Path) -> None:
    lines = ["Cycle | Target [mm] | Encoder [mm] | Laser [mm]", "--- | --- | --- | ---"]
    lines += [f"{c} | {at} | {at}.0001 | {at}.00{c}" for c in (1, 2) for at in (0, 10, 20, 30, 40)]
    content = "\n".join(["## Forward", *lines, "", "## Backward", *lines])
    page.goto(f"{bench.base}/campaigns")
    page.set_input_files("#pick-files", {"name": "both.md", "mimeType": "text/plain", "buffer": content.encode()})
    dialog = page.get_by_role("dialog", name="What is this table?")
    dialog.get_by_label("Machine", exact=True).fill("mill-y")
    dialog.get_by_label("Axis").fill("X")
    dialog.get_by_role("button", name="Ingest").click()
    expect(dialog.locator("[data-refused]")).to_contain_text("got: Encoder, Laser")
    page.screenshot(path=artifacts / "several-instruments.png")
    dialog.get_by_label("Instrument").fill("laser")
    dialog.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/both")
    expect(page.get_by_text("ISO 230-2").first).to_be_visible()


def test_tables_that_are_dropped_at_once_keep_machine_campaign_and_day(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/campaigns")
    rows = "\n".join(f"{n},5;{math.sin(n):.3f}".replace(".", ",") for n in range(360))
    heads = "Ebene XY\nRadius 150 mm\nVorschub {} mm/min\nWinkel [°];ccw [µm]\n"
    files = {f"k{feed}.csv": (heads.format(feed) + rows).encode() for feed in (1000, 2000)}
    page.set_input_files("#pick-files", [{"name": n, "mimeType": "text/csv", "buffer": b} for n, b in files.items()])
    dialog = page.get_by_role("dialog", name="What is this table?")
    dialog.get_by_label("Machine", exact=True).fill("mill-z")
    dialog.get_by_label("Campaign").fill("both-feeds")
    dialog.get_by_role("button", name="Ingest").click()
    expect(dialog.get_by_label("Programmed feed, mm/min")).to_have_value("2000")
    expect(dialog.get_by_label("Machine", exact=True)).to_have_value("mill-z")
    dialog.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/both-feeds")
    expect(page.locator("tbody").get_by_text("CCW", exact=True)).to_have_count(2)


def test_a_foreign_table_is_shown_corrected_and_remembered(page: Page, bench: Workbench, artifacts: Path) -> None:
    def drop(name: str, shift: float = 0.0) -> None:
        rows = [
            ";".join(f"{v:.4f}".replace(".", ",") for v in (0.1 * n, 0.9 * n + 0.5, 0.004 * math.sin(n) + shift))
            + ";gut"
            for n in range(400)
        ]
        content = "\n".join(["Kreisformtest Müller", "Zeit [s];Phi;Abweichung [mm];Bemerkung", *rows])
        page.goto(f"{bench.base}/campaigns")
        buffer = content.encode("cp1252")
        page.set_input_files("#pick-files", {"name": name, "mimeType": "text/csv", "buffer": buffer})
        expect(page.get_by_role("dialog", name="What is this table?")).to_be_visible()

    drop("kreis.csv")
    dialog = page.get_by_role("dialog", name="What is this table?")
    # Its angle has no unit: no kind of test is known yet, and the reason is said in the words of the command line.
    expect(dialog.locator("[data-refused]")).to_contain_text("the columns are those of no kind of test")
    expect(dialog.get_by_role("cell", name="0.5000 1.4000", exact=False)).to_be_visible()
    dialog.get_by_label("Phi is here").fill("angle_deg")
    dialog.get_by_role("button", name="Look again").click()
    expect(dialog.locator("[data-refused]")).to_be_hidden()
    expect(dialog.locator("[data-form]")).to_have_text(
        "cp1252, columns parted by semicolons, 1 line above the heads; kind circular"
    )
    expect(dialog.get_by_label("Abweichung [mm] is here")).to_have_value("deviation_um")
    expect(dialog.locator("tbody tr").nth(2).locator("td").last).to_have_text("1000")
    assert not Axe().run(page).response["violations"]
    page.screenshot(path=artifacts / "import.png", full_page=True)
    dialog.get_by_label("Machine", exact=True).fill("mill-y")
    dialog.get_by_role("button", name="Ingest").click()
    expect(dialog.locator("[data-refused]")).to_have_text("still to be told: plane, radius_mm, feed_mm_min")
    dialog.get_by_label("Plane").select_option("XY")
    dialog.get_by_label("Radius, mm").fill("150,5")
    dialog.get_by_label("Programmed feed, mm/min").fill("2000")
    dialog.get_by_label("Measured on").fill("2026-03-02")
    dialog.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/kreis")
    assert "<dt>measured</dt><dd>2026-03-02</dd>" in bench.ask("/campaigns/kreis/certificate.html")[1]

    # The next file with these heads: answered already, but its conditions are asked for.
    drop("kreis-2.csv", 0.001)
    expect(dialog.locator("[data-refused]")).to_be_hidden()
    expect(dialog.get_by_label("Phi is here")).to_have_value("angle_deg")
    expect(dialog.get_by_label("Radius, mm")).to_have_value("150.5")
    dialog.get_by_role("button", name="Ingest").click()
    expect(dialog.locator("[data-refused]")).to_have_text(
        "say whether the conditions of kreis.csv hold for this file, too"
    )
    dialog.get_by_label("Radius, mm").fill("100")
    dialog.get_by_role("button", name="Look again").click()
    told = dialog.get_by_label(
        "machine mill-y, plane XY, feed_mm_min 2000, as for kreis.csv: this file was measured so, too"
    )
    told.check()
    dialog.get_by_role("button", name="Ingest").click()
    page.wait_for_url("**/campaigns/kreis-2")
    text = bench.ask("/campaigns/kreis-2")[1]
    assert "mill-y" in text
    assert "100" in text

    # Nothing is kept of what was cancelled.
    drop("kreis-3.csv")
    dialog.get_by_role("button", name="Cancel").click()
    expect(page.locator("#work-error")).to_contain_text("nothing was ingested")
    assert "kreis-3" not in bench.ask("/campaigns")[1]


def test_what_cannot_be_ingested_is_said_in_the_words_of_the_command_line(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/campaigns")
    name = "<img src=x onerror=alert(1)>.b5r"
    page.set_input_files("#pick-files", {"name": name, "mimeType": "text/plain", "buffer": b"<a>"})
    expect(page.locator("#work-error")).to_contain_text("error[upload.name]")
    assert not list(bench.home.glob("workbench/uploads/*"))
    page.get_by_role("button", name="Close").click()
    page.set_input_files("#pick-files", {"name": "x.b5r", "mimeType": "text/plain", "buffer": b"<a>"})
    expect(page.locator("#work-error")).to_contain_text("error[xml.malformed]")
    expect(page.locator("#work-error")).not_to_contain_text("uploads")
    page.get_by_role("button", name="Close").click()
    page.set_input_files("#pick-files", {"name": "page.csv", "mimeType": "text/csv", "buffer": b"<html></html>"})
    expect(page.locator("#work-error")).to_contain_text("at: page.csv")
    page.get_by_role("button", name="Close").click()
    page.route("**/api/trays*", lambda route: route.abort())
    page.set_input_files("#pick-files", {"name": "x.b5r", "mimeType": "text/plain", "buffer": b"<a>"})
    expect(page.locator("#work-error")).to_contain_text("the workbench does not answer")


def test_an_own_effect_is_checked_saved_and_used(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/effects?edit=four_lobes")
    expect(page.get_by_text("it is run on this computer")).to_be_visible()
    source = page.get_by_label("four_lobes.py")
    good = source.input_value()
    source.fill(good.replace("[:, None]", ""))
    page.get_by_role("button", name="Check and save").click()
    expect(page.locator("#saved")).to_contain_text("error[effect.shape]")
    source.fill(good)
    page.get_by_role("button", name="Check and save").click()
    expect(page.locator("#saved")).to_contain_text("saved, and it can be fitted")
    page.goto(f"{bench.base}/campaigns/mill-backlash")
    page.get_by_text("Fit a twin with chosen effects").click()
    expect(page.locator("input[value=four_lobes]")).to_have_count(1)


def test_a_machine_is_given_a_tolerance_and_an_event_and_its_tests_are_decided(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/machines/virtual-mill")
    # The figures that may have one are offered.
    assert "G(b)" in page.locator("#figures option").evaluate_all("options => options.map((one) => one.value)")
    page.get_by_label("Figure").fill("G(b)")
    page.get_by_label("at most, µm").fill("much")
    page.get_by_role("button", name="State it").first.click()
    expect(page.locator("#work-error")).to_contain_text("got: much")
    page.keyboard.press("Escape")
    page.get_by_label("at most, µm").fill("1,5")
    page.get_by_role("button", name="State it").first.click()
    expect(page.get_by_text("G(b): ≤ 1.5 µm")).to_be_visible()
    # The page is a new one, whose buttons its script has not yet seen.
    _settled(page)
    page.locator("select[name=what]").select_option("crash")
    page.get_by_label("note", exact=True).fill("the vice")
    page.get_by_role("button", name="Note it").click()
    expect(page.get_by_text("crash: the vice")).to_be_visible()
    _settled(page)
    page.get_by_label("Test it every").fill("30")
    page.get_by_role("button", name="State it").last.click()
    expect(page.locator(".verdict")).to_contain_text("overdue")
    waiting: list[Route] = []
    page.route("**/api/machines/*/summary", lambda route: waiting.append(route), times=1)
    page.goto(f"{bench.base}/machines")
    # Two hundred machines that nobody looked at take minutes.
    expect(page.locator("[data-machines] caption")).to_contain_text("by name until all are judged: 0 of")
    # The words stand before the page asks for the first machine.
    for _ in range(500):
        if waiting:
            break
        page.wait_for_timeout(20)
    waiting[0].continue_()
    expect(page.locator("[data-machine=virtual-mill]")).to_contain_text("outside overdue")
    expect(page.locator("[data-machines] caption")).not_to_contain_text("judged")
    page.get_by_role("link", name="virtual-mill", exact=True).click()
    page.get_by_role("link", name="mill-backlash").click()
    expect(page.locator("#sheet")).to_contain_text("outside")


def test_one_button_finds_what_the_runs_can_tell(page: Page, bench: Workbench) -> None:
    page.goto(f"{bench.base}/campaigns/mill-backlash")
    with page.expect_response("**/find") as asked:
        page.get_by_role("button", name="Find what these runs can tell").click()
    # Asked in two tabs, it is one twin.
    again = bench.act("/api/campaigns/mill-backlash/find", b'{"name": "twice"}')[1]
    assert json.loads(again)["job"] == asked.value.json()["job"]
    page.wait_for_url("**/diagnose")
    expect(page.get_by_role("heading", name="Nothing is missing")).to_be_visible()


def test_a_twin_is_held_against_other_measurements_of_its_machine(page: Page, bench: Workbench, folder: Path) -> None:
    _ingested(bench, _zipped(folder, name="mill-again"))
    _ingested(bench, _zipped(folder, name="other", machine="other-mill"))
    page.goto(f"{bench.base}/twins/mill")
    expect(page.get_by_label("Measurements").locator("option")).to_have_count(2)
    page.get_by_label("Measurements").select_option("mill-again")
    page.get_by_role("button", name="Compare with these").click()
    expect(page.get_by_text("not those of the fit")).to_be_visible()
    _settled(page)
    expect(page.locator("#runs a").first).to_have_attribute("href", re.compile("/mill-again/"))
    status, text = bench.ask("/twins/mill?on=other")
    assert (status, "error[twin.machine]" in text) == (400, True)


def test_one_button_finds_and_adds_all_that_the_runs_can_tell(page: Page, bench: Workbench, artifacts: Path) -> None:
    wanted = {"campaign": "mill-backlash", "effects": ["centre_offset"], "name": "bare"}
    job = json.loads(bench.act("/api/twins", json.dumps(wanted).encode())[1])["job"]
    assert _awaited(bench, job)["state"] == "done"
    page.goto(f"{bench.base}/twins/bare/diagnose")
    page.get_by_role("button", name="Diagnose").click()
    table = page.get_by_role("table", name="Found together")
    expect(table.get_by_role("row")).to_have_count(4)
    expect(page.locator(".verdict h3")).to_have_text(["Geometry", "Drive"])
    page.screenshot(path=artifacts / "found.png", full_page=True)
    page.get_by_role("button", name="Find and add all").click()
    page.wait_for_url("**/twins/bare/versions")
    for name in ("Backlash X", "Scale mismatch XY", "Squareness XY"):
        expect(page.get_by_text(f"add {name}").first).to_be_visible()


def test_two_browsers_that_press_at_once_do_not_undo_each_other(bench: Workbench) -> None:
    body = json.dumps({"effect": "backlash", "axis": "X"}).encode()
    jobs = [json.loads(bench.act("/api/twins/mill/add", body)[1])["job"] for _ in range(2)]
    found = [_awaited(bench, job) for job in jobs]
    assert [job["state"] for job in found] == ["done", "failed"]
    assert "error[twin.has_effect]" in found[1]["error"]


def test_the_report_is_one_file_that_needs_nothing_else(browser: Browser, bench: Workbench, tmp_path: Path) -> None:
    status, text = bench.ask("/twins/mill/report.html")
    assert status == 200
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    opened = browser.new_page()
    asked: list[str] = []
    opened.on("request", lambda request: asked.append(request.url))
    opened.goto(path.as_uri())
    expect(opened.get_by_role("heading", name="Machine virtual-mill: twin mill")).to_be_visible()
    # The verdict first, in the words of the shop, and of what test it is.
    expect(opened.locator("section").first).to_contain_text("Scale mismatch, XY: ")
    expect(opened.locator("section").first).to_contain_text("mill-backlash")
    expect(opened.locator(".js-plotly-plot").first).to_be_visible()
    assert all(url.startswith(("file:", "data:", "blob:")) for url in asked)
    expect(opened.locator(".modebar-btn").first).to_be_attached()
    expect(opened.locator(SHARES)).to_have_count(0)
    # The German one by a button; what the printer says against it is told on the page.
    opened.goto(f"{bench.base}/twins/mill")
    head = {"content-type": "application/pdf", "content-disposition": 'attachment; filename="m.pdf"'}
    opened.route("**/report.pdf?language=de", lambda route: route.fulfill(body="%PDF-", headers=head))
    opened.route("**/report.pdf", lambda route: route.fulfill(status=400, body="<pre>no printer</pre>"))
    with opened.expect_download() as download:
        opened.get_by_role("link", name="Bericht (PDF)").click()
    assert download.value.suggested_filename == "m.pdf"
    opened.get_by_role("link", name="Report (PDF)").click()
    expect(opened.locator("#work-error")).to_have_text("no printer")
    opened.close()


def test_without_the_token_the_page_only_reads(browser: Browser, bench: Workbench) -> None:
    stranger = browser.new_page()
    stranger.goto(f"{bench.base}/campaigns")
    expect(stranger.get_by_text("Read only: this browser does not have the token.")).to_be_visible()
    stranger.close()
    body = json.dumps({"campaign": "mill-backlash", "name": "mill"}).encode()
    given = {"origin": bench.base, "content_type": "application/json"}
    key = bench.entered[1]
    for cookie, dtwin_key in (("", key), (bench.cookie[:-1], key), (bench.cookie + "x", key), (bench.cookie, "")):
        told = given | {"cookie": cookie, "dtwin_key": dtwin_key}
        status, text = bench.ask("/api/twins", method="POST", body=body, **told)
        assert (status, "the token is missing" in text) == (403, True)
    assert bench.ask("/?token=wrong")[0] == 403


def test_the_browser_is_not_told_the_token_in_words_that_every_user_sees(browser: Browser, tmp_path: Path) -> None:
    told, program = tmp_path / "told", tmp_path / "browser"
    program.write_text(f'#!/bin/sh\necho "$@" > {told}.part; mv {told}.part {told}\n')
    program.chmod(0o755)
    with running_workbench(tmp_path / "home", browser=program) as opened:
        while not told.exists():
            time.sleep(0.05)
        words = told.read_text()
        assert opened.token not in words
        way = Path(words.strip().removeprefix("file://"))
        assert way.stat().st_mode & 0o077 == 0
        page = browser.new_page()
        page.goto(words.strip())
        page.wait_for_url(f"{opened.base}/machines")
        assert page.get_by_text("Read only").count() == 0
        page.close()
        assert opened.stop() == 0
    assert not way.exists()


def test_a_person_sees_which_buttons_are_not_for_them(browser: Browser, bench: Workbench) -> None:
    state = Home(bench.home)
    token = add_person(state, "max", ["measure"])
    try:
        other = browser.new_page()
        other.goto(f"{bench.base}/?token={token}")
        other.wait_for_url("**/machines")
        other.goto(f"{bench.base}/campaigns/mill-backlash")
        find = other.get_by_role("button", name="Find what these runs can tell")
        expect(find).to_be_disabled()
        assert "the role train" in (find.get_attribute("title") or "")
        expect(other.get_by_role("button", name="Amend")).to_be_enabled()
        other.close()
    finally:
        (state.root / "people.toml").unlink()


@pytest.mark.parametrize("origin", ["http://example.org", "null", "http://127.0.0.1:1"])
def test_another_site_cannot_change_anything(bench: Workbench, origin: str) -> None:
    body = json.dumps({"effect": "backlash"}).encode()
    status, text = bench.ask(
        "/api/twins/mill/add",
        method="POST",
        body=body,
        cookie=bench.cookie,
        origin=origin,
        content_type="application/json",
    )
    assert (status, "from another site" in text) == (403, True)


def test_a_name_that_was_pointed_here_is_refused(bench: Workbench) -> None:
    port = bench.base.rsplit(":", 1)[1]
    assert bench.ask("/campaigns", host=f"evil.example:{port}")[0] == 403
    assert bench.ask("/campaigns", host=f"localhost:{port}")[0] == 200


def test_a_hostile_archive_leaves_nothing(bench: Workbench) -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("../../escaped.toml", "x")
    status, text = bench.act("/api/trays")
    assert status == 200
    tray = json.loads(text)["tray"]
    assert bench.act(f"/api/trays/{tray}?name=a.zip", out.getvalue(), "PUT")[0] == 200
    assert bench.act(f"/api/trays/{tray}?name=../x.b5r", b"x", "PUT")[0] == 400
    job = json.loads(bench.act(f"/api/trays/{tray}/ingest")[1])["job"]
    found = _awaited(bench, job)
    assert (found["state"], "error[upload.name]" in found["error"]) == ("failed", True)
    assert not list(bench.home.parent.rglob("escaped.toml"))


def test_a_taken_port_and_a_taken_home_are_said(bench: Workbench, tmp_path: Path) -> None:
    port = bench.base.rsplit(":", 1)[1]

    def refused(home: Path, *options: str) -> str:
        command = [sys.executable, "-m", "dtwin", "ui", "--no-browser", *options]
        done = subprocess.run(command, env={"DTWIN_HOME": str(home), "PATH": ""}, capture_output=True, text=True)
        assert done.returncode == 1
        return done.stderr

    assert "error[ui.port]: the port is taken" in refused(tmp_path, "--port", port)
    assert "error[ui.running]" in refused(bench.home)


def test_a_kill_in_the_middle_of_a_fit_loses_nothing(tmp_path: Path, folder: Path) -> None:
    with running_workbench(tmp_path / "home") as first:
        _ingested(first, _zipped(folder))
        wanted = {"campaign": "mill-backlash", "name": "mill", "effects": ["squareness"]}
        job = json.loads(first.act("/api/twins", json.dumps(wanted).encode())[1])["job"]
        while json.loads(first.ask(f"/api/jobs/{job}")[1])["state"] != "running":
            pass
        first.process.kill()
        first.process.wait()
    with running_workbench(tmp_path / "home") as second:
        text = second.ask("/campaigns")[1]
        assert re.search(r"Fit mill.*start it again", text, re.DOTALL)
        assert "mill-backlash" in text
        assert json.loads(second.ask(f"/api/jobs/{job}")[1])["state"] == "interrupted"
        assert "No twin was fitted yet" in second.ask("/twins")[1]
