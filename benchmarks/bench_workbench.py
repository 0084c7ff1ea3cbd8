"""Answer times of the workbench for a large campaign: a real server, asked over a socket.

Makes a lake with a campaign of circular runs, fits a twin (and diagnoses it when asked), then asks
every page and figure. The first answer after a start reads the runs; the others find them reduced. Times are of
the server: what the browser needs to draw is not in them. ``--browser`` opens a campaign in Chromium, too, with a
new profile: from the page of machines, and at its own address, until its polar plot stands.

Run: python benchmarks/bench_workbench.py [--runs 1000] [--diagnose] [--browser /usr/bin/chromium] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np

from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.twins.verbs import Twins

NAME = "bench"
PAGES = (
    "/campaigns",
    f"/campaigns/{NAME}",
    f"/campaigns/{NAME}/runs/r0001",
    f"/api/campaigns/{NAME}/runs/r0001/polar",
    f"/api/campaigns/{NAME}/runs/r0001/spectrum",
    "/twins",
    f"/twins/{NAME}",
    f"/api/twins/{NAME}/overlay/polar?condition=3",
    f"/api/twins/{NAME}/overlay/angle?condition=3&condition=5&condition=7",
    f"/api/twins/{NAME}/overlay/harmonics?condition=3",
    f"/api/twins/{NAME}/map",
    f"/api/twins/{NAME}/runs?condition=3",
    f"/twins/{NAME}/diagnose",
    f"/twins/{NAME}/versions",
    f"/api/twins/{NAME}/waterfall",
    "/effects",
)


def made_runs(count: int) -> list[Run]:
    """Runs with squareness, backlash and noise: 24 conditions, as many repeats as are needed."""
    rng = np.random.default_rng(1)
    grid = [
        (plane, radius, feed, direction)
        for plane in ("XY", "YZ")
        for radius in (50.0, 150.0)
        for feed in (1000.0, 2000.0, 4000.0)
        for direction in ("CCW", "CW")
    ]
    runs = []
    for number in range(count):
        plane, radius, feed, direction = grid[number % len(grid)]
        sign = 1.0 if direction == "CCW" else -1.0
        turn = np.linspace(0.0, 720.0, 2000, endpoint=False)
        theta = np.radians(sign * turn)
        error = 0.015 * radius * np.sin(2 * theta) - 1.5 * np.sign(sign * np.sin(theta)) * np.cos(theta)
        speed = np.degrees(feed / 60.0 / radius)
        samples = {
            "t_s": turn / speed,
            "angle_deg": sign * turn,
            "deviation_um": error + rng.normal(0.0, 0.5, turn.size),
        }
        meta = RunMeta(
            f"r{number:04d}",
            plane=plane,
            direction=direction,
            radius_mm=radius,
            feed_mm_min=feed,
            repeat=number // len(grid) + 1,
            setup=f"{plane}-{radius:g}".lower(),
            sample_rate_hz=2000.0 / float(samples["t_s"][-1]),
        )
        runs.append(Run(meta, samples))
    return runs


def entered(printed: str) -> tuple[str, str]:
    """Return the address of a workbench, by the line that it printed, and the cookie that a browser gets from it."""
    found = re.search(r"(http://[^/]+)/\?token=\S+", printed)
    assert found, "the server did not start"
    with urllib.request.urlopen(found[0], timeout=600) as answer:
        return found[1], answer.headers["set-cookie"].partition(";")[0]


def asked(address: str, cookie: str) -> tuple[float, int]:
    request = urllib.request.Request(address, headers={"cookie": cookie})
    begun = time.perf_counter()
    with urllib.request.urlopen(request, timeout=600) as answer:
        size = len(answer.read())
    return 1e3 * (time.perf_counter() - begun), size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--diagnose", action="store_true", help="takes minutes")
    parser.add_argument("--browser", help="the program of Chromium; needs playwright")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--short", action="store_true", help="the same code with little data")
    chosen = parser.parse_args()
    if chosen.short:
        chosen.runs, chosen.repeats = 48, 1
    with tempfile.TemporaryDirectory() as folder:
        home = Home(Path(folder))
        lake = Lake(home.lake)
        campaign = Campaign(NAME, "bench-mill", started="2026-03-02T08:00:00Z")
        runs = made_runs(chosen.runs)
        for first in range(0, len(runs), 24):
            lake.commit(campaign, runs[first : first + 24])
        begun = time.perf_counter()
        twins = Twins(home)
        twins.fit(NAME, ["squareness", "scale_mismatch"], NAME)
        fitted_s = time.perf_counter() - begun
        begun = time.perf_counter()
        if chosen.diagnose:
            twins.diagnose(NAME)
        diagnosed_s = time.perf_counter() - begun
        result = {
            "runs": chosen.runs,
            "fit_s": round(fitted_s, 1),
            "diagnose_s": round(diagnosed_s, 1) if chosen.diagnose else None,
            "load_average": os.getloadavg()[0],
            **measured(folder, chosen.repeats, chosen.browser),
        }
    if chosen.json:
        print(json.dumps(result))
        return
    diagnosed = f", diagnosis {result['diagnose_s']} s" if chosen.diagnose else ""
    print(
        f"{result['runs']} runs; in the background: fit {result['fit_s']} s{diagnosed}; "
        f"load {result['load_average']:.1f}"
    )
    print("answers in ms: first after the start, then median and longest")
    print(f"{'':56s} {'first':>8s} {'median':>8s} {'longest':>8s} {'kB':>7s}")
    for page, found in result["pages"].items():
        print(
            f"{page:56s} {found['first_ms']:8.0f} {found['median_ms']:8.0f} "
            f"{found['longest_ms']:8.0f} {found['kb']:7.0f}"
        )
    if polar := result["polar_s"]:
        print(f"polar plot in Chromium: {polar['from_machines']} s from the machines, {polar['at_once']} s at once")


# Notes the frame in which a polar plot is painted, as lines or by Plotly.
_PAINTED = """new MutationObserver((_, watch) => {
  if (!document.querySelector(".canvas polyline, .js-plotly-plot .polarlayer path")) return;
  watch.disconnect();
  requestAnimationFrame(() => setTimeout(() => { window.polar_ms = performance.now(); }));
}).observe(document, { childList: true, subtree: true });"""


def drawn(program: str, base: str, begin: str, told: str) -> float:
    """Return the seconds until the polar plot of the campaign is painted in a browser that has seen one page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as player:
        browser = player.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(bypass_csp=True)
        page.goto(base + begin)
        page.wait_for_function(told)
        page.add_init_script(_PAINTED)
        page.goto(f"{base}/campaigns/{NAME}")
        page.wait_for_function("window.polar_ms")
        taken_ms = float(page.evaluate("window.polar_ms"))
        browser.close()
    return round(1e-3 * taken_ms, 2)


def measured(folder: str, repeats: int, browser: str | None) -> dict[str, object]:
    server = subprocess.Popen(
        [sys.executable, "-m", "dtwin", "ui", "--no-browser"],
        env=os.environ | {"DTWIN_HOME": folder},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout is not None
        base, cookie = entered(server.stdout.readline())
        pages = {}
        for page in PAGES:
            first, size = asked(base + page, cookie)
            times = [asked(base + page, cookie)[0] for _ in range(repeats)]
            pages[page] = {
                "first_ms": round(first, 1),
                "median_ms": round(statistics.median(times), 1),
                "longest_ms": round(max(times), 1),
                "kb": round(size / 1024, 1),
            }
        polar_s = browser and {
            "from_machines": drawn(browser, base, "/machines", "localStorage.getItem('dtwin-compiled')"),
            "at_once": drawn(browser, base, "/static/icon.svg", "true"),
        }
        return {"pages": pages, "polar_s": polar_s}
    finally:
        server.terminate()
        server.wait(30)


if __name__ == "__main__":
    main()
