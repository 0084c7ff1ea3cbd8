"""A home that version ef27d08 made: the virtual mill's first four runs, a twin, a champion of the demo."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from dtwin.config import Home
from dtwin.errors import DtwinError, StoreError
from dtwin.lake.store import Lake
from dtwin.pipeline.migrating import _BEFORE, _MADE, migrate
from dtwin.serve.pointer import resolve
from dtwin.twins.shelf import PATHS, TwinShelf

EARLIER = Path(__file__).parents[1] / "home_before_hashes.zip"


@pytest.fixture
def home(tmp_path: Path) -> Home:
    with zipfile.ZipFile(EARLIER) as made:
        made.extractall(tmp_path / "home")
    return Home(tmp_path / "home")


def _quiet(done: int, total: int, what: str) -> None:
    pass


def test_an_earlier_home_is_refused_until_it_is_migrated_and_then_all_of_it_opens(home: Home) -> None:
    with pytest.raises(StoreError, match="earlier version") as refused:
        Lake(home.lake).runs()
    assert "dtwin migrate" in str(refused.value.hint)
    found = migrate(home, _quiet)
    assert (found.campaigns, found.n_runs, found.documents) == (("mill-backlash",), 4, 1)
    assert found.machines == ("virtual-cobot",)
    lake = Lake(home.lake)
    rows = lake.runs("mill-backlash")
    assert [row["run_id"] for row in rows] == ["r001", "r002", "r003", "r004"]
    run = lake.load(rows[0])
    assert run.meta.covariates["temperature_c"] == pytest.approx(19.98452951416706)
    assert run.n_samples == 1080
    assert resolve("latest", "virtual-cobot", home).version == 1
    (twin,) = TwinShelf(home, PATHS).history("t1")
    assert (twin["version"], twin["action"]) == (1, "fit")
    # The second time there is nothing to do, and what was set aside stays.
    again = migrate(home, _quiet)
    assert (again.campaigns, again.documents, again.machines, again.before) == ((), 0, (), None)
    assert (home.root / _BEFORE / "runs").is_dir()


def test_a_changed_run_of_an_earlier_home_is_refused_and_nothing_is_replaced(home: Home) -> None:
    samples = home.lake / "samples" / "mill-backlash"
    first, second = sorted(samples.glob("*.parquet"))[:2]
    first.write_bytes(second.read_bytes())
    with pytest.raises(StoreError, match="not what was ingested"):
        migrate(home, _quiet)
    assert not (home.root / _BEFORE).exists()
    with pytest.raises(DtwinError):
        Lake(home.lake).runs()


def test_a_kill_between_the_two_renames_is_mended(home: Home) -> None:
    migrate(home, _quiet)
    home.lake.rename(home.root / _MADE)
    migrate(home, _quiet)
    assert len(Lake(home.lake).runs()) == 4
