"""Runs that were read once are not read again, and nothing else changes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.pipeline.measuring import ingest
from dtwin.twins.measured import Loaded, _read_reduced, _stamp_of, load

pytestmark = pytest.mark.system


@pytest.fixture
def home(tmp_path: Path) -> Home:
    made = Home(tmp_path / "home")
    simulate_mill(tmp_path / "mill", quick=True, hidden="servo")
    ingest(tmp_path / "mill", made)
    return made


def _name(home: Home) -> str:
    (name,) = Lake(home.lake).campaigns()
    return name


def assert_same(first: Loaded, second: Loaded) -> None:
    a, b = first.obs, second.obs
    for name in ("y_um", "mask", "condition_of", "setup_of", "run_of", "feed_mm_s"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
        assert getattr(a, name).dtype == getattr(b, name).dtype, name
    assert (a.conditions, a.setups, a.campaign) == (b.conditions, b.setups, b.campaign)
    assert repr([asdict(m) for m in a.runs]) == repr([asdict(m) for m in b.runs])
    for one, other in zip(a.columns, b.columns, strict=True):
        assert set(one) == set(other)
        assert all(np.array_equal(one[n], other[n], equal_nan=True) for n in one)
    assert first.data == second.data
    assert first.controller_um is not None
    assert np.array_equal(first.controller_um, second.controller_um, equal_nan=True)


def test_the_second_reading_is_the_first_without_the_samples(home: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    first = load(home, _name(home))

    def nobody_reads(*_: object, **__: object) -> None:
        raise AssertionError("a run was read again")

    with monkeypatch.context() as patch:
        patch.setattr(Lake, "load", nobody_reads)
        assert_same(first, load(home, _name(home)))


@pytest.mark.parametrize("spoilt", [b"", b"PK\x03\x04 no archive", None])
def test_a_spoilt_or_cut_file_is_made_again(home: Home, spoilt: bytes | None) -> None:
    first = load(home, _name(home))
    (path,) = (home.root / "reduced").glob("*.npz")
    kept = path.read_bytes()
    middle = len(kept) // 2
    flipped = bytes([kept[middle] ^ 0xFF])
    path.write_bytes(spoilt if spoilt is not None else kept[:middle] + flipped + kept[middle + 1 :])
    assert_same(first, load(home, _name(home)))
    assert path.read_bytes() == kept


def test_a_header_that_is_no_python_any_more_is_damage(home: Home) -> None:
    first = load(home, _name(home))
    (path,) = (home.root / "reduced").glob("*.npz")
    kept = path.read_bytes()
    place = kept.index(b"}", kept.index(b"'descr'"))
    path.write_bytes(kept[:place] + b" " + kept[place + 1 :])
    assert_same(first, load(home, _name(home)))


def test_other_runs_are_not_taken_for_these(home: Home) -> None:
    load(home, _name(home))
    rows = Lake(home.lake).runs(_name(home))
    assert _read_reduced(home, _name(home), _stamp_of(rows)) is not None
    changed = [{**rows[0], "content_sha256": "0" * 64}, *rows[1:]]
    for other in (changed, rows[1:], rows[::-1]):
        assert _read_reduced(home, _name(home), _stamp_of(other)) is None
