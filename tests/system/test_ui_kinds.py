"""Travels and tones in the workbench: every page of their twins answers, and says what it shows."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator

import pytest
from workbench_server import Workbench, running_workbench

from dtwin.config import Home
from dtwin.kinds.drift._evidence import simulate_drift
from dtwin.kinds.drift._twins import DriftTwins
from dtwin.kinds.linear._plan import linear_plan
from dtwin.kinds.linear._simulate import simulate_lathe
from dtwin.kinds.sinusoidal._simulate import Grid, simulate_turning
from dtwin.kinds.volumetric._plan import BallPlan
from dtwin.kinds.volumetric._simulate import TRUTHS, simulate_volumetric
from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.twins.verbs import Twins

pytestmark = pytest.mark.system

PLAN = {
    "name": "z",
    "machine": "lathe",
    "axis": "Z",
    "unit": "in",
    "start": 1,
    "end": 4,
    "step": 0.025,
    "runs": 3,
    "dwell_s": 6,
    "feed_min": 20,
    "overshoot": 0.1,
    "window": 0.01,
    "axis_low": 0,
    "axis_high": 41,
    "pitch": 0.25,
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workbench]:
    folder = tmp_path_factory.mktemp("kinds")
    twins = Twins(Home(folder / "home"))
    simulate_lathe(folder / "z", plan=linear_plan(PLAN, "the test"), truth="mechanism")
    twins.fit(str(folder / "z"), ["lead_error", "backlash"], "axis")
    twins.diagnose("axis")
    simulate_turning(folder / "tones", grid=Grid((10.0, 30.0), (5.0, 10.0)))
    twins.fit(str(folder / "tones"), ["structural_mode"], "slide")
    twins.diagnose("slide")
    plan = BallPlan("balls", "mill", 234.0, every_h=12.0)
    # Twins have no memory: with every second thermocouple in a core they can tell more.
    seen = TRUTHS["pockets"]
    simulate_volumetric(folder / "balls", lambda *_: None, plan=plan, parameters=seen)
    heat = HeatTwins(Home(folder / "home"))
    heat.fit(str(folder / "balls"), ["rigid_shift"], "heat")
    heat.diagnose("heat")
    simulate_drift(folder / "column", lambda *_: None, quick=True)
    drift = DriftTwins(Home(folder / "home"))
    drift.fit(str(folder / "column"), ["follows"], "column")
    drift.diagnose("column")
    with running_workbench(folder / "home") as started:
        yield started


def said(bench: Workbench, path: str) -> str:
    status, text = bench.ask(path)
    assert status == 200, (path, text[:300])
    return text


@pytest.mark.parametrize(
    ("twin", "campaign", "run", "words"),
    [
        ("axis", "z", "z-1", ("Z forward", "Error over the position", "screw pitch 6.35 mm")),
        ("slide", "slow-tool-servo-linear", "g001", ("Z 10 Hz 5 µm", "Error over the phase", "frequency 10 Hz")),
    ],
)
def test_every_page_of_another_kind_answers(
    bench: Workbench, twin: str, campaign: str, run: str, words: tuple[str, ...]
) -> None:
    pages = [f"/campaigns/{campaign}", f"/campaigns/{campaign}/runs/{run}"]
    pages += [f"/twins/{twin}{tab}" for tab in ("", "/diagnose", "/versions")]
    together = "".join(said(bench, page) for page in pages)
    assert all(word in together for word in words)
    assert "Polar" not in said(bench, f"/twins/{twin}")
    assert said(bench, f"/twins/{twin}/report.html").count("<section") >= 4


@pytest.mark.parametrize(("twin", "across"), [("axis", "position, mm"), ("slide", "phase of the command, deg")])
def test_figures_run_along_the_path(bench: Workbench, twin: str, across: str) -> None:
    for figure in ("overlay/angle", "map"):
        drawn = json.loads(said(bench, f"/api/twins/{twin}/{figure}"))
        assert drawn["layout"]["xaxis"]["title"]["text"] == across
    assert json.loads(said(bench, f"/api/twins/{twin}/overlay/harmonics"))["data"]
    status, text = bench.ask(f"/api/twins/{twin}/overlay/polar")
    assert status == 404
    assert "only circles are drawn as polar plots" in text


def test_a_machine_whose_test_has_no_day_was_tested(bench: Workbench) -> None:
    shown = said(bench, "/machines")
    assert ">not stated</td>" in shown
    assert ">never</td>" not in shown


def test_without_repeats_the_page_says_so(bench: Workbench) -> None:
    assert "Repeats are needed" in said(bench, "/twins/slide/diagnose")


def test_what_mlflow_does_not_show_yet_is_said(bench: Workbench) -> None:
    assert "not yet in MLflow" not in said(bench, "/twins")
    (bench.home / "twins" / "slide" / "v001.mlflow.json").unlink()
    assert "not yet in MLflow: slide v001;" in said(bench, "/twins")


def _done(bench: Workbench, path: str, wanted: dict[str, str]) -> str:
    status, text = bench.act(path, json.dumps(wanted).encode())
    assert status == 202, text
    job = json.loads(text)["job"]
    while (state := json.loads(said(bench, f"/api/jobs/{job}"))["state"]) not in ("done", "failed"):
        time.sleep(0.1)
    return str(state)


def test_one_button_finds_what_a_log_of_drift_can_tell(bench: Workbench) -> None:
    (campaign,) = re.findall(r'href="/campaigns/([^"]+)"', said(bench, "/twins/column"))[:1]
    effects = re.findall(r'name="effects" data-list value="([^"]+)"', said(bench, f"/campaigns/{campaign}"))
    assert effects == ["follows", "lag", "second_lag", "sensor_curve"]
    run = said(bench, f"/campaigns/{campaign}/runs/day-1-log")
    assert "Find what these runs can tell" in run
    assert "U covers 95 %" in run
    assert "- Hz" not in run
    assert _done(bench, f"/api/campaigns/{campaign}/find", {"name": "found"}) == "done"
    assert "Nothing is missing" in said(bench, "/twins/found/diagnose")


def test_a_twin_that_is_told_in_words_has_a_page_and_is_changed_there(bench: Workbench) -> None:
    for tab in ("", "/diagnose", "/versions"):
        shown = said(bench, f"/twins/column{tab}")
        assert "An effect is missing" in shown
        assert 'name="effect" value="lag@front"' in shown
        assert "noise of a reading" in shown
    assert json.loads(said(bench, "/api/twins/column/waterfall"))["data"][0]["x"][0] == "no effects"
    drawn = [json.loads(said(bench, f"/api/twins/column/compared/{number}")) for number in (0, 1)]
    assert [[curve["name"] for curve in figure["data"]] for figure in drawn] == [["measured", "twin"], ["left"]]
    for figure in ("map", "overlay/angle", "ranked", "encoder", "runs", "compared/2"):
        assert bench.ask(f"/api/twins/column/{figure}")[0] in (400, 404), figure
    assert _done(bench, "/api/twins/column/add", {"effect": "lag@front"}) == "done"
    assert "was not diagnosed yet" in said(bench, "/twins/column")
    assert said(bench, "/twins/column/report.html").count("<section") >= 3


def test_a_twin_of_heat_has_one_page_and_is_changed_there(bench: Workbench) -> None:
    assert "heat" in said(bench, "/twins")
    assert "axis_expansion" in said(bench, "/campaigns/balls")
    for tab in ("", "/diagnose", "/versions"):
        shown = said(bench, f"/twins/heat{tab}")
        assert "An effect is missing" in shown
        assert 'name="effect" value="EA0"' in shown
    names = json.loads(said(bench, "/api/twins/heat/compared/0"))["data"][0]["x"]
    assert {"EX0", "EXX1", "EXZ1"} <= set(names)
    assert json.loads(said(bench, "/api/twins/heat/compared/1"))["data"]
    assert json.loads(said(bench, "/api/twins/heat/waterfall"))["data"][0]["x"][0] == "no effects"
    assert _done(bench, "/api/twins/heat/add", {"effect": "EA0"}) == "done"
    assert "add EA0" in said(bench, "/twins/heat")
    assert said(bench, "/twins/heat/report.html").count("<section") >= 4
    status, text = bench.ask("/api/twins/heat/map")
    assert status == 400
    assert "another kind of campaign" in text
