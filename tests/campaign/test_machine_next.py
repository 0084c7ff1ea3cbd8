"""Which test of a machine to make next: by command, in the browser, and as files that the plan verb takes."""

from __future__ import annotations

import io
import time
import tomllib
import zipfile
from pathlib import Path

import pytest
from command_here import refused, said
from entered_workbench import enter
from laser_axis import write_laser
from starlette.testclient import TestClient

from dtwin.acquire.ingest import ingest
from dtwin.config import Home
from dtwin.kinds.kind import NotOffered
from dtwin.lake.store import Lake
from dtwin.physics.library import Library
from dtwin.pipeline.machine_next import _by_axis
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a home with a laser test of X."""
    made = tmp_path_factory.mktemp("next")
    ingest(write_laser(made / "laser-x", "mill-7", "X", 10.0, 4.0), Lake(Home(made / "home").lake))
    return made


@pytest.fixture
def home(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DTWIN_HOME", str(folder / "home"))
    return folder / "home"


def test_what_was_measured_is_not_proposed_first_and_the_plan_can_be_used(home: Path, tmp_path: Path) -> None:
    for axis in "XYZ":
        said("machine", "add", "mill-7", "--axis", f"{axis}:travel_mm=400,pitch_mm=10")
    file = tmp_path / "next.toml"
    found = said("machine", "next", "mill-7", "--out", str(file))
    assert found["measured"] == ["laser-x"]
    rates = [test["bits_per_minute"] for test in found["tests"]]
    assert rates == sorted(rates, reverse=True)
    lasers = [test["document"]["plan"]["axis"] for test in found["tests"] if test["kind"] == "linear"]
    assert lasers[-1] == "X"
    assert tomllib.loads(file.read_text()) == found["tests"][0]["document"]
    assert said("plan", str(file))["name"] == found["tests"][0]["name"]
    assert "scale X" not in " ".join(found["untold"])


def test_what_cannot_have_a_twin_is_passed_over_and_a_spoilt_test_gives_way_to_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a lathe's X and Z in one folder, or of a newest test without a sound run, nothing was said of the machine at all."""
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    lake = Lake(Home(tmp_path / "home").lake)
    for name, lead_ppm, year in (("sound", 10.0, "2024"), ("both", 10.0, "2025"), ("spoilt", 1e7, "2026")):
        made = write_laser(tmp_path / name, "mill-7", "X", lead_ppm, 4.0)
        file = made / "campaign.toml"
        stated = file.read_text(encoding="utf-8").replace("2025", year)
        if name == "both":
            # Axis Z below axis X, with readings of its own.
            other = write_laser(made / "z", "mill-7", "Z", 20.0, 3.0, seed=1) / "campaign.toml"
            runs = other.read_text(encoding="utf-8").partition("[[run]]")[2]
            stated += "[[run]]" + runs.replace('file = "r', 'file = "z/r').replace('id = "r', 'id = "z')
            other.unlink()
        file.write_text(stated, encoding="utf-8")
        ingest(made, lake)
    found = said("machine", "next", "mill-7")
    assert found["measured"] == ["sound"]
    assert list(found["passed_over"]) == ["both"]
    asked = refused("machine", "diagnose", "mill-7", "--campaign", "both", "--campaign", "sound")
    assert asked.code == "twin.axis"


def test_kinds_and_minutes_choose(home: Path) -> None:
    assert {t["kind"] for t in said("machine", "next", "mill-7", "--kind", "linear")["tests"]} == {"linear"}
    every = said("machine", "next", "mill-7")["tests"]
    quick = said("machine", "next", "mill-7", "--minutes", "30")["tests"]
    assert 0 < len(quick) < len(every)
    assert max(test["minutes"] for test in quick) <= 30.0


def test_what_cannot_be_proposed_is_refused_with_what_can(home: Path) -> None:
    assert "mill-7" in str(refused("machine", "next", "mill-8").allowed)
    assert "mounting included" in str(refused("machine", "next", "mill-7", "--minutes", "1").allowed)
    assert isinstance(refused("machine", "next", "mill-7", "--kind", "poses"), NotOffered)
    assert "linear" in str(refused("machine", "next", "mill-7", "--kind", "lasers").allowed)


def test_a_test_without_repeats_of_a_kind_that_is_not_proposed_counts(home: Path, tmp_path: Path) -> None:
    said("simulate", "--machine", "turning", "--quick", "--out", str(tmp_path / "sines"))
    said("ingest", str(tmp_path / "sines"))
    found = said("machine", "next", "virtual-turning", "--kind", "linear")
    assert found["measured"] == ["slow-tool-servo-linear"]
    assert {test["kind"] for test in found["tests"]} == {"linear"}


def test_the_page_shows_the_tests_and_gives_their_files(home: Path) -> None:
    address = "http://127.0.0.1:8765"
    access = Access("127.0.0.1", 8765)
    browser = TestClient(application(Bench(Home(home), access)), base_url=address, headers={"Origin": address})
    enter(browser, access.token)
    assert "/machines/mill-7/next" in browser.get("/machines/mill-7").text
    # A diagnosis takes longer than a page may.
    (home / "kept/joint/mill-7.json").unlink(missing_ok=True)
    for what in ("next", "together"):
        assert f'data-post="/api/machines/mill-7/{what}"' in browser.get(f"/machines/mill-7/{what}").text
    assert not (home / "kept/joint/mill-7.json").exists()
    job = browser.post("/api/machines/mill-7/next", json={}).json()["job"]
    while (work := browser.get(f"/api/jobs/{job}").json())["state"] in ("waiting", "running"):
        time.sleep(0.05)
    assert work["address"] == "/machines/mill-7/next", work
    page = browser.get("/machines/mill-7/next").text
    tests = said("machine", "next", "mill-7")["tests"]
    assert all(test["name"] in page for test in tests)
    circles = next(test for test in tests if test["kind"] == "circular")
    plan = browser.get(f"/machines/mill-7/next/{circles['name']}.toml")
    assert tomllib.loads(plan.text) == circles["document"]
    packed = browser.get(f"/machines/mill-7/next/{circles['name']}.zip").content
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        assert f"{circles['name']}/t001.nc" in archive.namelist()
    assert browser.get("/machines/mill-7/next/nothing.toml").status_code == 404
    assert browser.get(f"/machines/mill-7/next/{circles['name']}.exe").status_code == 400


def test_a_difference_that_was_found_alone_is_told_by_its_axes() -> None:
    assert _by_axis(["scale_mismatch ZX"], Library()) == ("lead_error Z", "lead_error X")
    assert _by_axis(["scale_mismatch ZX", "servo_lag"], Library()) == ("scale_mismatch ZX", "servo_lag")
