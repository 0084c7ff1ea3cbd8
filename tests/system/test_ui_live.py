"""The live page against a process that really holds a machine's lease."""

from __future__ import annotations

import json
import math
import re
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from served_robot import MACHINE, Server, promote, wait_until_corrected, wait_until_released
from virtual_robot import virtual_robot
from workbench_server import Workbench, running_workbench

from dtwin.config import home as dtwin_home
from dtwin.serve.band import COVARIANCE, constant_band

pytestmark = pytest.mark.system
pytest_plugins = ["chromium"]

SERVES = """
import sys, time
from pathlib import Path
from dtwin.config import Home
from dtwin.serve._lease import lease
from dtwin.serve.realtime import stop_on_signals
with lease("127.0.0.1", "mill-a", Home(Path(sys.argv[1]))), stop_on_signals() as asked:
    print("serving", flush=True)
    while not asked():
        time.sleep(0.01)
print("released", flush=True)
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    with running_workbench(tmp_path_factory.mktemp("live")) as started:
        yield started


def test_what_serves_is_shown_and_stopped(bench: Workbench) -> None:
    assert "Nothing is being served" in bench.ask("/live")[1]
    serving = subprocess.Popen([sys.executable, "-c", SERVES, str(bench.home)], stdout=subprocess.PIPE, text=True)
    try:
        assert serving.stdout is not None
        assert serving.stdout.readline() == "serving\n"
        (found,) = json.loads(bench.ask("/api/live")[1])["serving"]
        assert (found["machine"], found["pid"]) == ("mill-a", serving.pid)
        assert "mill-a is held by a server that has shown no tick yet" in bench.ask("/live")[1]
        assert bench.ask("/api/live/mill-a/stop", method="POST", body=b"{}")[0] == 403
        assert serving.poll() is None
        assert bench.act("/api/live/other/stop")[0] == 400
        assert bench.act("/api/live/mill-a/stop")[0] == 200
        assert serving.stdout.read() == "released\n"
        assert serving.wait(300) == 0
    finally:
        if serving.poll() is None:
            serving.send_signal(signal.SIGKILL)
        serving.wait()
    assert json.loads(bench.ask("/api/live")[1])["serving"] == []


def test_a_server_that_was_killed_is_said_to_be_gone_until_another_serves(bench: Workbench) -> None:
    path = bench.home / "logs" / "serve-mill-k.events.jsonl"
    path.parent.mkdir(exist_ok=True)
    begun = {
        "time": "2026-03-02T08:00:00+00:00",
        "event": "serving",
        "session": "a",
        "mode": "live",
        "model_sha256": "x",
    }
    path.write_text(json.dumps(begun) + "\n", encoding="utf-8")
    shown = bench.ask("/live")[1]
    assert "The server of mill-k that began to correct at 2026-03-02 08:00" in shown
    assert "No session was logged yet" not in shown
    killed, ended = (
        {"time": "2026-03-02T08:01:00+00:00", "event": what, "session": "a"} for what in ("killed", "released")
    )
    path.write_text(f"{json.dumps(begun)}\n{json.dumps(killed)}\n", encoding="utf-8")
    assert "The server of mill-k that began to correct at 2026-03-02 08:00" in bench.ask("/live")[1]
    # The last one says how it ended: those before it stay in the list.
    later = [begun | {"session": name, "time": f"2026-03-02T08:02:0{n}+00:00"} for n, name in enumerate("bcd")]
    lines = [begun, killed, *later, ended | {"session": "d"}]
    path.write_text("\n".join(map(json.dumps, lines)) + "\n", encoding="utf-8")
    shown = bench.ask("/live")[1]
    assert "gone without a word" not in shown
    assert shown.count("Ended without a word: it was killed, or the power was lost.") == 3
    assert re.findall(r"<h3>mill-k, ([^<]+)</h3>", shown) == [
        "2026-03-02 08:02:01",
        "2026-03-02 08:02:00",
        "2026-03-02 08:00",
    ]
    path.write_text(f"{json.dumps(begun)}\n{json.dumps(ended)}\n", encoding="utf-8")
    assert "gone without a word" not in bench.ask("/live")[1]


def test_a_session_that_ended_shows_its_figures(bench: Workbench) -> None:
    log = bench.home / "logs" / "serve-mill-a.jsonl"
    log.parent.mkdir(exist_ok=True)
    percentiles = {"p50": 2.0, "p99": 2.5, "p99.9": 3.0, "max": 4.0}
    session = {
        "started": "2026-03-02T08:00:00+00:00",
        "duration_s": 22.0,
        "machine": "mill-a",
        "model": {"version": 3},
        "host": "127.0.0.1",
        "device": "virtual",
        "trial": False,
        "clamp_um": 93.0,
        "clock": "wall",
        "mode": "live",
        "ended": "duration",
        "released": True,
        "reasons": {"ok": 990, "clamped": 7, "slew_limited": 3},
        "largest_um": 93.0,
        "fault": None,
        "timing": {
            "ticks": 1000,
            "late_ticks": 3,
            "missed_states": 1,
            "timeouts": 0,
            "late_share": 0.004,
            "period_ms": percentiles,
            "state_age_ms": percentiles,
            "jitter_us_histogram": {"<10": 900, ">=10": 100},
        },
    }
    spoilt = ["cut off}", "5", "[1]", "{}", *(json.dumps(session | {key: None}) for key in ("started", "reasons"))]
    spoilt.append(json.dumps({key: value for key, value in session.items() if key != "duration_s"}))
    log.write_text("\n".join([*spoilt, json.dumps(session), ""]), encoding="utf-8")
    assert len(json.loads(bench.ask("/api/live")[1])["sessions"]) == 1
    text = bench.ask("/live")[1]
    assert "clamped 7, slew limited 3" in text
    assert "0.40 <small>%, 3 late, 1 missed" in text
    # Of all the time, as ticks that were missed are none; half of the periods are of 2 ms.
    assert "45.45 <small>Hz, 1000 ticks" in text
    # The page loads itself anew when the two differ, as they are written.
    made_of = re.findall("data-seen='(.*?)'", text)[0]
    assert json.dumps(json.loads(made_of)) == json.dumps(json.loads(bench.ask("/api/live")[1]))
    figure = json.loads(bench.ask("/api/live/mill-a/jitter?started=2026-03-02T08%3A00%3A00%2B00%3A00")[1])
    assert figure["data"][0]["x"] == ["0 to 10", "over 10"]


def test_a_page_that_is_not_answered_says_so(browser: Browser, tmp_path: Path, artifacts: Path) -> None:
    """As when the computer of the workbench is held up: what is served may have changed since."""
    viewport = {"width": 820, "height": 900}
    with running_workbench(tmp_path) as workbench, browser.new_page(viewport=viewport) as page:
        page.goto(workbench.address)
        serving = subprocess.Popen([sys.executable, "-c", SERVES, str(tmp_path)], stdout=subprocess.PIPE)
        try:
            page.goto(f"{workbench.base}/live")
            heading, said = page.locator("#live h2"), page.locator("#unanswered")
            expect(heading).to_contain_text("has shown no tick yet", timeout=60_000)
            expect(said).to_be_hidden()
            # As after a start of the workbench that made another token.
            page.route("**/api/live", lambda asked: asked.fulfill(status=403, body="open the address"))
            refused = "refuses this page, which may no longer be true: open the address"
            expect(said).to_contain_text(refused, timeout=60_000)
            page.unroute("**/api/live")
            expect(said).to_be_hidden(timeout=60_000)
            workbench.process.send_signal(signal.SIGSTOP)
            expect(heading).to_have_text("mill-a does not answer this page", timeout=60_000)
            expect(said).to_be_visible(timeout=60_000)
            page.screenshot(path=artifacts / "live-unanswered.png")
            serving.kill()
            workbench.process.send_signal(signal.SIGCONT)
            expect(page.get_by_text("Nothing is being served")).to_be_visible(timeout=60_000)
            expect(said).to_be_hidden(timeout=60_000)
        finally:
            workbench.process.send_signal(signal.SIGCONT)
            serving.kill()
            serving.communicate()


def test_a_loop_that_runs_is_followed_and_stopped_in_the_browser(
    browser: Browser, tmp_path: Path, artifacts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Real server, real ur-rtde client, virtual controller on the wall clock."""
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path))
    promote(dtwin_home(), band=constant_band({"radial_error_um": 3.0}, COVARIANCE))
    with (
        virtual_robot("--feed-mm-min=12000", "--radius-mm=50") as robot,
        running_workbench(tmp_path) as workbench,
        browser.new_page(viewport={"width": 1024, "height": 1300}) as page,
    ):
        page.set_default_timeout(60_000)
        expect.set_options(timeout=60_000)
        server = Server(f"--host={robot.host}")
        wait_until_corrected(robot)
        page.goto(workbench.address)
        page.wait_for_url("**/machines")
        page.goto(f"{workbench.base}/live")
        now = page.locator("[data-now]")
        expect(now.locator("[data-key=rate]")).not_to_have_text("\u2013")
        expect(page.locator("h2", has_text=f"{MACHINE} is being corrected")).to_be_visible()
        first = int(now.locator("[data-key=ticks]").inner_text())
        expect(now.locator("[data-key=ticks]")).not_to_have_text(str(first))
        assert int(now.locator("[data-key=ticks]").inner_text()) > first
        expect(page.locator("figcaption", has_text="newest circle of R50")).to_be_visible()
        # The promoted equation foretells 24 um along the radius: so much is taken away.
        # After a stall of a busy computer it comes back under the slew limit.
        until = time.monotonic() + 300.0
        while True:
            seen = json.loads(workbench.ask(f"/api/live/{MACHINE}/now")[1])
            if math.hypot(*seen["correction_um"]) == pytest.approx(24.0, rel=0.01):
                break
            assert time.monotonic() < until, seen["correction_um"]
        # 3 um along the radius, k = 2, whatever its direction in the plane.
        assert math.hypot(*(seen["band_um"])) == pytest.approx(3.0)
        expect(now.locator("[data-key=band]")).to_have_text(re.compile(r"^\d\.\d\d  \d\.\d\d  0\.00$"))
        strips = "document.querySelectorAll('[data-moving] .canvas')[0].data.filter(d => d.fill === 'toself').length"
        page.wait_for_function(f"() => {strips} === 3")
        drawn = "document.querySelectorAll('[data-moving] .canvas')[1].data.map(d => d.y)"
        page.wait_for_function(f"() => {drawn}.length === 2")
        # A circle in which the loop stalled, or the program began anew, begins at zero; each next
        # one is drawn.
        while True:
            with_it, without = page.evaluate(drawn)
            taken = statistics.median(a - b for a, b in zip(with_it, without, strict=True))
            if taken == pytest.approx(-24.0, rel=0.02):
                break
            assert time.monotonic() < until, taken
            time.sleep(1.0)
        page.screenshot(path=artifacts / "live.png", full_page=True)
        page.get_by_role("button", name="Stop and release the correction").click()
        assert server.end()[0] == 0
        wait_until_released(robot)
        expect(page.get_by_text("Nothing is being served")).to_be_visible()
        assert workbench.ask(f"/api/live/{MACHINE}/now")[0] == 400
