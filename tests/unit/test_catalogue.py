from __future__ import annotations

import os
import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from entered_workbench import enter
from starlette.testclient import TestClient
from test_store import CAMPAIGN, make_run

from dtwin.config import Home
from dtwin.documents import write_document
from dtwin.errors import StoreError
from dtwin.lake.store import Lake
from dtwin.pipeline.home_catalogue import catalogue, outlines, twin_lines
from dtwin.pipeline.machine_history import machine_overviews
from dtwin.workbench import _bench, _campaign_routes
from dtwin.workbench._access import Access
from dtwin.workbench._bench import Bench
from dtwin.workbench.server import application


def committed(lake: Lake, name: str, machine: str, days: list[str]) -> None:
    runs = [make_run(f"r{k}", k) for k in range(len(days))]
    dated = [replace(run, meta=replace(run.meta, started=day)) for run, day in zip(runs, days, strict=True)]
    lake.commit(replace(CAMPAIGN, name=name, machine=machine), dated)


def amended(lake: Lake, name: str, run: str, changes: dict[str, object]) -> None:
    lake.amend(name, [{"run_id": run, "who": "w", "when": "t", "because": "x", "changes": changes}])


@pytest.fixture
def home(tmp_path: Path) -> Home:
    found = Home(tmp_path / "home")
    lake = Lake(found.lake)
    committed(lake, "a", "m1", ["2024-03-01T08:00:00Z", "2024-03-02T08:00:00Z", "2024-03-03T08:00:00Z"])
    committed(lake, "b", "m2", ["2024-05-01T08:00:00Z"])
    return found


def test_a_line_says_what_was_ingested_and_what_is_stated_anew(home: Home) -> None:
    lines = {line.name: line for line in catalogue(home)}
    assert (lines["a"].machine, lines["a"].runs, lines["a"].used) == ("m1", 3, 3)
    assert (lines["a"].started, lines["a"].last) == ("2024-03-01T08:00:00Z", "2024-03-03T08:00:00Z")
    lake = Lake(home.lake)
    amended(lake, "a", "r2", {"left_out": True})
    amended(lake, "b", "r0", {"setup": "anew"})
    again = {line.name: line for line in catalogue(home)}
    assert (again["a"].runs, again["a"].used, again["a"].last) == (3, 2, "2024-03-02T08:00:00Z")
    assert again["b"].setups == ["anew"]


def test_runs_of_a_campaign_that_did_not_change_are_not_read(home: Home) -> None:
    before = {line.name: line for line in catalogue(home)}
    lake = Lake(home.lake)
    (file,) = (f for f in lake.tables["runs"].files() if f.startswith("a/"))
    (lake.root / "runs" / file).unlink()
    committed(lake, "c", "m1", ["2024-06-01T08:00:00Z"])
    after = {line.name: line for line in catalogue(home)}
    assert set(after) == {"a", "b", "c"}
    assert after["a"] == before["a"]
    amended(lake, "b", "r0", {"setup": "anew"})
    assert {line.name: line for line in catalogue(home)}["b"].setups == ["anew"]


def test_while_campaigns_are_read_machines_are_shown_by_the_names_of_files(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    lake = Lake(home.lake)
    amended(lake, "a", "r1", {"machine": "m3"})
    amended(lake, "b", "r0", {"left_out": True})
    committed(lake, "c", "m2", ["2024-06-01T08:00:00Z"])
    known = {(one.name, one.machine) for one in outlines(home)}
    assert known == {(one.name, one.machine) for one in catalogue(home) if one.used}
    let_go = threading.Event()
    monkeypatch.setattr(_bench, "catalogue", lambda home: let_go.wait(300) and catalogue(home))
    monkeypatch.setattr(_bench, "_PATIENCE_S", 0.01)
    access = Access("127.0.0.1", 8765)
    client = TestClient(application(Bench(home, access)), base_url="http://127.0.0.1:8765")
    enter(client, access.token)
    page = client.get("/machines").text
    assert 'data-unread="2"' in page
    assert 'data-machine="m2"' in page
    assert "2024-06-01" not in page
    let_go.set()
    assert client.get("/api/machines").json()["m2"] == "2024-06-01"


@pytest.mark.parametrize("at", [0.1, 0.5, 0.9])
def test_a_damaged_line_is_made_again(home: Home, at: float) -> None:
    whole = catalogue(home)
    kept = home.root / "kept" / "catalogue" / "campaigns.json"
    data = bytearray(kept.read_bytes())
    data[int(at * len(data))] ^= 4
    kept.write_bytes(data)
    assert catalogue(home) == whole


def test_without_its_kept_lines_a_damaged_lake_is_told(home: Home) -> None:
    (file, _) = Lake(home.lake).tables["runs"].files()
    (home.lake / "runs" / file).unlink()
    with pytest.raises(StoreError):
        catalogue(home)


def test_a_machine_whose_runs_are_all_left_out_is_not_listed(home: Home) -> None:
    amended(Lake(home.lake), "b", "r0", {"left_out": True})
    (only,) = machine_overviews(home)
    assert (only["machine"], only["campaigns"], only["last_test"]) == ("m1", ["a"], "2024-03-03")


def test_a_line_of_a_twin_is_its_newest_version_and_others_are_not_read(home: Home) -> None:
    def stored(name: str, version: int, kind: str = "paths") -> None:
        figures = {"rms_before_um": 3.0, "rms_after_um": 2.0 - version / 10}
        document = {"twin": name, "version": version, "machine": "m1", "campaign": "a", "action": "fit", "kind": kind}
        write_document(home.root / "twins" / name / f"v{version:03d}.json", {**document, "figures": figures}, "twin")

    def told() -> list[tuple[str, int, str | None]]:
        return [(line.name, line.newest["version"], line.newest["verdict"]) for line in twin_lines(home)]

    assert twin_lines(home) == []
    stored("old", 1)
    stored("heat", 1, "volumetric")
    (home.root / "twins" / "empty").mkdir()
    assert told() == [("heat", 1, None), ("old", 1, None)]
    (home.root / "twins/heat/v001.json").write_text("{")
    os.utime(home.root / "twins/heat", ns=(0, twin_lines(home)[0].changed))
    stored("old", 2)
    assert told() == [("heat", 1, None), ("old", 2, None)]
    verdict = {"verdict": "nothing_missing", "candidates": []}
    write_document(home.root / "twins/old/v002.diagnosis.json", verdict, "diagnosis")
    assert told()[1] == ("old", 2, "nothing_missing")
    shutil.rmtree(home.root / "twins/old")
    assert told() == [("heat", 1, None)]
    assert machine_overviews(home)[0]["twins"] == ["heat"]
    stored("heat", 2, "volumetric")
    (home.root / "twins/heat/v002.json").write_text("{")
    with pytest.raises(StoreError):
        twin_lines(home)


def test_the_list_of_campaigns_is_found_in_and_paged(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_campaign_routes, "_ON_A_PAGE", 1)
    access = Access("127.0.0.1", 8765)
    browser = TestClient(application(Bench(home, access)), base_url="http://127.0.0.1:8765")
    enter(browser, access.token)

    def shown(query: str) -> list[str]:
        return re.findall(r'href="/campaigns/(\w+)"', browser.get(f"/campaigns?{query}").text)

    assert sorted(shown("page=1") + shown("page=2")) == ["a", "b"]
    assert shown("page=99") == shown("page=2")
    assert shown("page=-3") == shown("page=1")
    assert shown("find=M2") == ["b"]
    assert shown("find=nix") == []
    assert browser.get("/campaigns?page=x").status_code == 400
