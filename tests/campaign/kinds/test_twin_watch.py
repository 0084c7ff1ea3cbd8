"""Twins of a machine are looked at for every kind of campaign, and only those of its kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from dtwin.acquire.ingest import ingest
from dtwin.acquire.virtual_mill import simulate_mill
from dtwin.config import Home
from dtwin.kinds.linear._plan import linear_plan
from dtwin.kinds.linear._simulate import simulate_lathe
from dtwin.lake.store import Lake
from dtwin.twins.on_campaign import look_at
from dtwin.twins.verbs import Twins

AXIS = {
    "name": "axis",
    "machine": "virtual-mill",
    "axis": "Z",
    "unit": "in",
    "start": 1,
    "end": 25,
    "step": 0.25,
    "runs": 2,
    "dwell_s": 6,
    "feed_min": 20,
    "overshoot": 0.1,
    "window": 0.01,
    "axis_low": 0,
    "axis_high": 41,
    "pitch": 0.25,
}


def test_a_twin_of_an_axis_is_looked_at_and_one_of_circles_on_the_same_machine_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DTWIN_MLFLOW", "later")
    home = Home(tmp_path / "home")
    simulate_mill(tmp_path / "circles", quick=True)
    simulate_lathe(tmp_path / "axis", plan=linear_plan(AXIS, "the test"), truth="mechanism")
    lake = Lake(home.lake)
    circles, axis = (ingest(tmp_path / name, lake).campaign for name in ("circles", "axis"))
    machine = lake.campaign(circles).machine
    twins = Twins(home)
    twins.fit(circles, ["scale_mismatch"], "of-circles")
    twins.fit(axis, ["backlash"], "of-the-axis")
    assert [view.name for view in look_at(home, machine, circles)] == ["of-circles"]
    (seen,) = look_at(home, lake.campaign(axis).machine, axis)
    assert (seen.name, seen.diagnosed) == ("of-the-axis", True)
    assert seen.headline
