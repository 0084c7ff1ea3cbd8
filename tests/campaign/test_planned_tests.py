"""Tests of a machine that are planned: the form, what they would tell, who measures them, and what changed since the last one."""

from __future__ import annotations

import html
import io
import re
import time
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from command_here import said
from entered_workbench import enter
from fleet_lake import fill
from laser_axis import write_laser
from machine_years import steady, write_tests
from starlette.testclient import TestClient
from typer.testing import CliRunner

from dtwin.acquire.ingest import ingest
from dtwin.acquire.virtual_mill import _planned_tests, simulate_mill
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.kind import NotOffered
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.store import Lake
from dtwin.physics.library import Library
from dtwin.pipeline.planned_tests import (
    draft_of,
    drafting_kinds,
    foretold,
    keep_plan,
    kept_plans,
    measured_by,
    with_settings,
)
from dtwin.pipeline.sheet_changes import last_changes, sheet_changes
from dtwin.plan_file import planned_document
from dtwin.report.changes import changes_text
from dtwin.schema import Run, RunMeta
from dtwin.twins.measured import load
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application

CIRCLES = {"plane": "XY", "radius_mm": "150", "feed_mm_min": "1000", "repeats": "3"}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    return Home(tmp_path / "home")


def browser(home: Home) -> TestClient:
    access = Access("127.0.0.1", 8765)
    opened = TestClient(application(Bench(home, access)), base_url="http://127.0.0.1:8765")
    enter(opened, access.token)
    return opened


@pytest.mark.parametrize("kind", drafting_kinds())
def test_every_form_is_a_plan_of_its_kind_that_can_be_changed(home: Home, kind: str) -> None:
    draft = draft_of(home, "mill-7", kind)
    planned = planned_document(draft, "draft")
    assert (planned.kind, planned.summary["machine"]) == (kind, "mill-7")
    assert planned.duration_s > 0.0
    assert tomllib.loads(browser(home).get(f"/machines/mill-7/plan.toml?kind={kind}").text) == draft
    other = with_settings(draft, {"name": "mine"})
    assert planned_document(other, "draft").summary["name"] == "mine"


def test_a_form_begins_with_the_conditions_of_the_last_test_so_that_figures_can_be_compared(home: Home) -> None:
    fill(home, 1)
    (run, *_) = Lake(home.lake).runs(machine="mill-0")
    grid = draft_of(home, "mill-0", "circular")["grid"]
    assert (grid["plane"], grid["radius_mm"], grid["feed_mm_min"]) == tuple(
        [run[name]] for name in ("plane", "radius_mm", "feed_mm_min")
    )
    assert grid["directions"] == ["CCW", "CW"]
    assert len(draft_of(home, "mill-1", "circular")["grid"]["feed_mm_min"]) == 3


def test_a_form_begins_with_the_last_test_of_any_kind(home: Home, tmp_path: Path) -> None:
    """Kind, axis and targets of a laser; tones."""
    ingest(write_laser(tmp_path / "y-1", "mill-7", "Y", 300.0, 4.0), Lake(home.lake))
    form = browser(home).get("/machines/mill-7/plan").text
    assert 'plan?kind=linear" aria-current="page"' in form
    plan = draft_of(home, "mill-7")["plan"]
    assert (plan["kind"], plan["axis"], plan["start"], plan["end"], plan["step"]) == ("linear", "Y", 10.0, 390.0, 20.0)
    assert plan["runs"] == 5
    # An error of 114 µm is outside of the usual window of a laser's trigger.
    assert plan["window"] == pytest.approx(0.23, abs=0.02)
    # The laser counted from a zero of its own: its targets are outside of the travel that is stated since.
    said("machine", "add", "mill-7", "--axis", "Y:low_mm=-200,high_mm=200,pitch_mm=10")
    plan = draft_of(home, "mill-7")["plan"]
    assert -200.0 < plan["start"] < plan["end"] < 200.0
    assert load(home, "y-1").obs.campaign.machine_geometry == {"screw_pitch_mm": 10.0}
    tone = RunMeta("g1", "sinusoidal", condition={"axis": "Y", "frequency_hz": 7.0, "amplitude_um": 3.0})
    tones = kind_named("sinusoidal").draft("mill-7", {}, [Run(tone, {})])["plan"]
    assert (tones["axis"], tones["frequencies_hz"], tones["amplitudes_um"]) == ("Y", [7.0], [3.0])
    page = browser(home).get("/machines/mill-7/plan?kind=sinusoidal").text
    assert "no figures of a standard that could be compared" in page


def test_the_virtual_mill_of_a_ball_array_measures_its_next_test_with_other_noise(home: Home, tmp_path: Path) -> None:
    noise = []
    for name in ("balls-1", "balls-2"):
        asked = {"name": name, "hours": "2", "every_h": "1"}
        document = with_settings(draft_of(home, "warm-mill", "volumetric"), asked)
        (tmp_path / f"{name}.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
        plan = ["--plan", str(tmp_path / f"{name}.toml"), "--out", str(tmp_path / name)]
        said("simulate", "--machine", "volumetric", "--truth", "pockets", "--seed", "3", *plan)
        lake = Lake(home.lake)
        ingest(tmp_path / name, lake)
        assert foretold(home, document, Library())["virtual"] == "volumetric"
        measured = measured_by(home, document)
        assert measured is not None
        assert (measured[1]["truth"], measured[1]["schedule"], measured[2]) == ("pockets", "training", 3)
        noise.append(lake.load(lake.runs(campaign=name)[0]).samples["error_x_um"])
    assert not np.array_equal(*noise)
    assert noise[0] == pytest.approx(noise[1], abs=20.0)


def test_a_feed_in_the_unit_of_its_plan_says_so(home: Home) -> None:
    form = browser(home).get("/machines/mill-7/plan?kind=linear").text
    assert "feed, unit/min" in form
    assert "feed min" not in form
    assert "feed, mm/min" in browser(home).get("/machines/mill-7/plan?kind=circular").text


def test_all_kinds_with_a_plan_have_a_form() -> None:
    assert drafting_kinds() == [kind.name for kind in kinds() if kind.offers("plan")]
    with pytest.raises(NotOffered):
        kind_named("drift").draft("m", {}, ())


@pytest.mark.parametrize(
    ("told", "code"),
    [
        ({"radius": "100"}, "plan.setting"),
        ({"machine": "other"}, "plan.setting"),
        ({"radius_mm": "wide"}, "plan.setting"),
        ({"repeats": "2.5"}, "plan.setting"),
        ({"feed_mm_min": "1.000"}, "plan.setting"),
        ({"feed_mm_min": "500,1,500.5,1,000"}, "plan.setting"),
        ({"radius_mm": "9000"}, "plan.limits"),
        ({"radius_mm": ""}, "plan.grid"),
        ({"plane": "XW"}, "plane.unknown"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_place(home: Home, told: dict[str, str], code: str) -> None:
    with pytest.raises(InputError) as refused:
        foretold(home, with_settings(draft_of(home, "mill-7", "circular"), told), Library())
    assert refused.value.code == code or "plane" in told
    query = "&".join(f"{key}={value}" for key, value in told.items())
    page = browser(home).get(f"/machines/mill-7/plan?{query}")
    assert page.status_code == 400
    assert refused.value.message in html.unescape(page.text)


def test_settings_are_named_with_their_units(home: Home) -> None:
    shown = browser(home).get("/machines/mill-7/plan?kind=volumetric").text
    assert all(label in shown for label in (">every, h <", ">ball, s <", ">drift, µm/h <"))


def test_settings_beyond_all_reason_are_refused(home: Home) -> None:
    for kind, told in (("volumetric", f"balls={'9' * 400}"), ("circular", "&".join(f"a{n}=1" for n in range(70)))):
        page = browser(home).get(f"/machines/mill-7/plan?kind={kind}&{told}")
        assert (page.status_code, "error[plan.setting]" in page.text) == (400, True)


def test_settings_decide_what_becomes_visible_and_what_looks_alike(home: Home) -> None:
    def told(**settings: str) -> dict[str, Any]:
        return foretold(home, with_settings(draft_of(home, "mill-7", "circular"), CIRCLES | settings), Library())

    def size(found: dict[str, Any], label: str) -> float:
        return next(one["amplitude"] or 1e9 for one in found["detectable"] if one["label"] == label)

    one, some, many = told(), told(repeats="12"), told(repeats="48")
    # Noise averages: four times the repeats show half the size.
    assert size(some, "backlash X") / size(many, "backlash X") == pytest.approx(2.0, rel=0.15)
    assert many["minutes"] == pytest.approx(4.0 * some["minutes"])
    together = {frozenset(group) for group in one["alike"]}
    assert any({"scale_mismatch XY", "inertial_compliance"} <= group for group in together)
    several = told(feed_mm_min="500, 1500; 4000", radius_mm="50 150")
    assert not any({"scale_mismatch XY", "inertial_compliance"} <= set(group) for group in several["alike"])


def test_what_takes_days_is_not_computed_by_a_page(home: Home) -> None:
    page = browser(home).get("/machines/mill-7/plan?radius_mm=50,100,150&feed_mm_min=100&repeats=900").text
    assert "is not computed here" in page
    assert "What becomes visible" not in page
    assert "What becomes visible" in browser(home).get("/machines/mill-7/plan?radius_mm=50").text


def test_a_real_machine_waits_and_is_compared_when_its_campaign_comes(home: Home, tmp_path: Path) -> None:
    first, second, third = write_tests(tmp_path / "made", 3, lambda test: 2.0 if test < 2 else 9.0, steady(3.0))
    ingest(first, Lake(home.lake))
    time.sleep(1.1)  # The lake notes the second in which a run came.
    row = Lake(home.lake).runs("t00")[0]
    settings = CIRCLES | {
        "plane": row["plane"],
        "radius_mm": str(row["radius_mm"]),
        "feed_mm_min": str(row["feed_mm_min"]),
    }
    page = browser(home)
    query = "kind=circular&" + "&".join(f"{key}={value}" for key, value in settings.items())
    assert "Keep the plan" in page.get(f"/machines/mill-7/plan?{query}").text
    posted = page.post(
        "/api/machines/mill-7/plans", json={"query": query}, headers={"origin": "http://127.0.0.1:8765"}
    ).json()
    job: dict[str, Any] = {}
    while job.get("state") not in ("done", "failed"):
        job = page.get(f"/api/jobs/{posted['job']}").json()
    assert job["address"] == "/machines/mill-7#planned", job
    (waiting,) = said("machine", "measure", "mill-7")["plans"]
    assert waiting["answer"] == ""
    shown = page.get("/machines/mill-7").text
    assert "waits" in shown
    zipped = zipfile.ZipFile(io.BytesIO(page.get(f"/machines/mill-7/plans/{waiting['name']}.zip").content))
    assert any(name.endswith(".nc") for name in zipped.namelist())
    time.sleep(1.1)
    ingest(second, Lake(home.lake))
    (answered,) = kept_plans(home, "mill-7")
    assert answered["answer"] == "t01"
    shown = page.get("/machines/mill-7").text
    assert "t01 beside t00" in shown
    assert "This cannot be told yet" in shown
    same = said("machine", "changes", "mill-7")
    assert (same["campaign"], same["earlier"]) == ("t01", "t00")
    assert "changed" not in same["counts"]
    ingest(third, Lake(home.lake))
    said("machine", "event", "mill-7", "crash", "--on", "2025-02-20")
    changed = said("machine", "changes", "mill-7")
    widest = {one["symbol"]: one for one in changed["figures"]}["G(b)"]
    assert widest["said"] == "changed"
    assert widest["difference_um"] > 0.0
    assert [event["what"] for event in changed["events"]] == ["crash"]
    assert "crash of 2025-02-20" in page.get("/machines/mill-7/changes?campaign=t02").text
    back = said("machine", "changes", "mill-7", "--campaign", "t01", "--with", "t02")
    mirrored = {one["symbol"]: one for one in back["figures"]}["G(b)"]
    assert mirrored["difference_um"] == pytest.approx(-widest["difference_um"])
    assert [one["answer"] for one in kept_plans(home, "mill-7")] == ["t01"]


def test_another_instrument_between_two_tests_is_told(home: Home, tmp_path: Path) -> None:
    for n, serial in enumerate(("12A345", "77B999", "77B999")):
        folder = tmp_path / f"mill{n}"
        simulate_mill(folder, seed=n, quick=True)
        text = (folder / "campaign.toml").read_text()
        text = text.replace('"mill-backlash"', f'"mill-{n}"')
        told = f'[campaign.instrument]\nmodel = "QC20-W"\nserial = "{serial}"\n'
        text = text.replace("[campaign.machine_geometry]", told + "[campaign.machine_geometry]", 1)
        (folder / "campaign.toml").write_text(text)
        ingest(folder, Lake(home.lake))
    first, second = (sheet_changes(home, f"mill-{n + 1}", f"mill-{n}") for n in (0, 1))
    assert [one.split()[-1] for one in first["instruments"]] == ["12A345", "77B999"]
    (said,) = [line for line in changes_text(first) if line.startswith("measured with")]
    assert "77B999 instead of" in said
    assert "may be the instrument" in said
    assert not [line for line in changes_text(second) if line.startswith("measured with")]


def test_what_was_assumed_claims_no_change(home: Home, tmp_path: Path) -> None:
    # Another seed: the same machine, with another zero of a bar of which nobody says that it was calibrated.
    for seed in (0, 1):
        folder = tmp_path / f"mill{seed}"
        simulate_mill(folder, seed=seed, quick=True)
        text = (folder / "campaign.toml").read_text()
        (folder / "campaign.toml").write_text(text.replace('"mill-backlash"', f'"mill-{seed}"'))
        ingest(folder, Lake(home.lake))
    found = last_changes(home, "virtual-mill")
    assert (found["campaign"], found["earlier"]) == ("mill-1", "mill-0")
    assert "changed" not in found["counts"]
    assert found["counts"]["not changed"] > 0
    moved = max(found["figures"], key=lambda one: abs(one["difference_um"]))
    assert abs(moved["difference_um"]) > 5.0, "the zero of the bar did not move: the test shows nothing"
    assert moved["said"] == "cannot be said"


def test_a_test_is_compared_with_the_last_one_of_the_same_axis(home: Home, tmp_path: Path) -> None:
    for name, axis, lead in (("x-1", "X", 10.0), ("y-1", "Y", 10.0), ("x-2", "X", 60.0), ("z-1", "Z", 0.0)):
        ingest(write_laser(tmp_path / name, "mill-7", axis, lead, 4.0), Lake(home.lake))
    found = said("machine", "changes", "mill-7")
    assert (found["campaign"], found["earlier"]) == ("x-2", "x-1")
    error = {one["symbol"]: one for one in found["figures"]}["E"]
    assert error["difference_um"] == pytest.approx(0.05 * 380.0, rel=0.1)
    alone = CliRunner().invoke(app, ["machine", "changes", "mill-7", "--campaign", "z-1"])
    assert isinstance(alone.exception, InputError)
    assert alone.exception.code == "changes.first"


def test_what_cannot_be_compared_is_refused(home: Home, tmp_path: Path) -> None:
    only, other = write_tests(tmp_path / "made", 2, steady(2.0), steady(3.0))
    ingest(only, Lake(home.lake))
    for words in (
        ("changes", "mill-7"),
        ("changes", "mill-7", "--campaign", "t00"),
        ("changes", "mill-7", "--campaign", "t00", "--with", "t00"),
        ("changes", "mill-8", "--campaign", "t00"),
        ("changes", "nix"),
    ):
        refused = CliRunner().invoke(app, ["machine", *words])
        assert refused.exit_code == 1
        assert isinstance(refused.exception, InputError), words
    keep_plan(home, with_settings(draft_of(home, "mill-7", "circular"), {"name": "t01"}))
    with pytest.raises(InputError, match="there already"):
        keep_plan(home, with_settings(draft_of(home, "mill-7", "circular"), {"name": "t01"}))
    ingest(other, Lake(home.lake))
    assert [one["answer"] for one in kept_plans(home, "mill-7")] == ["t01"]
    taken = browser(home).post(
        "/api/machines/mill-7/plans/t01/drop", json={}, headers={"origin": "http://127.0.0.1:8765"}
    )
    assert taken.status_code == 202


def test_the_virtual_mill_measures_a_plan_in_its_order() -> None:
    document = {
        "plan": {"name": "p", "machine": "m"},
        "grid": {"plane": ["XY"], "radius_mm": [50.0], "feed_mm_min": [1000.0, 2000.0], "repeats": 2},
    }
    planned = planned_document(document, "here").plan
    tests = _planned_tests(replace(planned, directions=("CW",)))
    assert [(t.feed_mm_min, t.repeat, t.direction) for t in tests] == [
        (t.feed_mm_min, t.repeat, "CW") for t in planned.tests
    ]
    assert not re.search("CCW", str(tests))
