from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from test_store import CAMPAIGN, make_run

from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.lake.store import Lake
from dtwin.pipeline.catalogue import catalogue
from dtwin.pipeline.machine_history import machine_overviews


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
