"""What sister machines say of each other: on drawn numbers, and by the command on a lake."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fleet_lake import fill
from typer.testing import CliRunner

from dtwin.acquire.ingest import ingest
from dtwin.cli import app
from dtwin.config import home
from dtwin.errors import InputError
from dtwin.fleet.jobs import DIAGNOSE
from dtwin.fleet.run import run_fleet
from dtwin.fleet.sisters import _compared
from dtwin.lake.store import Lake
from dtwin.machine_record import keep_record


def test_machines_that_are_alike_help_each_other_and_those_that_are_not_keep_their_own() -> None:
    rng = np.random.default_rng(1)
    errors = np.full(12, 1.0)
    kept = {}
    for between in (0.0, 10.0):
        alone, together, covered = [], [], []
        for _ in range(60):
            truth = 5.0 + between * rng.standard_normal(12)
            values = truth + errors * rng.standard_normal(12)
            found = _compared(values, errors, 12)
            alone += list(values - truth)
            together += list(found.values - truth)
            covered += list(abs(found.values - truth) <= 2.0 * found.errors)
        kept[between] = float(np.std(together) / np.std(alone))
        assert np.mean(covered) > 0.93
    assert kept[0.0] < 0.6
    assert kept[10.0] == pytest.approx(1.0, abs=0.03)


def test_the_one_that_differs_is_named_and_keeps_its_size() -> None:
    rng = np.random.default_rng(2)
    named, false = 0, 0
    for _ in range(60):
        values = 5.0 + rng.standard_normal(10)
        values[3] += 12.0
        found = _compared(values, np.full(10, 0.5), 10)
        named += bool(found.differs[3])
        false += int(found.differs.sum() - found.differs[3])
        if found.differs[3]:
            assert (found.values[3], found.errors[3]) == (values[3], 0.5)
    assert named >= 57
    assert false <= 6


def test_two_that_differ_do_not_hide_each_other() -> None:
    values = np.array([5.1, 4.9, 5.0, 5.2, 4.8, 5.05, 4.95, 5.1, 30.0, 24.0])
    assert list(np.flatnonzero(_compared(values, np.full(10, 0.1), 10).differs)) == [8, 9]


def test_the_command_names_the_machine_that_is_not_like_its_sisters() -> None:
    # One campaign each; the size grows with the number, and the last is of another sort.
    fill(home(), 6, machines=6, size_um=lambda number: 40.0 if number == 5 else 3.0 + 0.1 * (number % 3))
    for number in range(6):
        keep_record(home(), f"mill-{number}", {"type": "3-axis mill"})
    shell = CliRunner()
    # Figures are compared without a diagnosis.
    early = json.loads(shell.invoke(app, ["fleet", "sisters", "--type", "3-axis mill", "--json"]).stdout)
    assert [(one["effect"], [m["machine"] for m in one["machines"] if m["differs"]]) for one in early["sizes"]] == [
        ("G(b)", ["mill-5"]),
        ("H", []),
        ("D", []),
    ]
    few = shell.invoke(app, ["fleet", "sisters", "--machine", "mill-1"]).exception
    assert isinstance(few, InputError)
    assert few.got == "1 machines with a campaign of one sort, of 1 machines"
    run_fleet(home(), DIAGNOSE, workers=1)
    found = json.loads(shell.invoke(app, ["fleet", "sisters", "--type", "3-axis mill", "--json"]).stdout)
    (size,) = [one for one in found["sizes"] if one["effect"] == "squareness XY"]
    assert [m["machine"] for m in size["machines"] if m["differs"]] == ["mill-5"]
    assert size["spread"] < 0.1 * abs(size["mean"])
    assert "differs (p =" in shell.invoke(app, ["fleet", "sisters", "--type", "3-axis mill"]).stdout
    assert isinstance(shell.invoke(app, ["fleet", "sisters"]).exception, InputError)


def test_a_sister_with_more_play_is_named_by_it(tmp_path: Path) -> None:
    rng, at = np.random.default_rng(0), np.linspace(0.0, 400.0, 9)
    for number in range(5):
        play = 15.0 if number == 3 else 3.0 + 0.2 * rng.normal()
        lines = ["target;cycle;forward [um];reverse [um]"]
        for cycle in range(1, 5):
            error = rng.normal(0.0, 0.3, (2, at.size)) - [[0.0], [play]]
            lines += [f"{x:g};{cycle};{up:.3f};{down:.3f}" for x, up, down in zip(at, *error, strict=True)]
        (tmp_path / f"s{number}.csv").write_text("\n".join(lines), encoding="utf-8")
        ingest(tmp_path / f"s{number}.csv", Lake(home().lake), told={"axis": "X", "machine": f"axis-{number}"})
    asked = [word for number in range(5) for word in ("--machine", f"axis-{number}")]
    # The reversal error says so without a diagnosis.
    found = json.loads(CliRunner().invoke(app, ["fleet", "sisters", *asked, "--json"]).stdout)
    (reversal,) = [one for one in found["sizes"] if one["effect"] == "B"]
    assert [m["machine"] for m in reversal["machines"] if m["differs"]] == ["axis-3"]
    run_fleet(home(), DIAGNOSE, workers=1)
    found = json.loads(CliRunner().invoke(app, ["fleet", "sisters", *asked, "--json"]).stdout)
    (size,) = [one for one in found["sizes"] if one["effect"] == "backlash X"]
    assert [m["machine"] for m in size["machines"] if m["differs"]] == ["axis-3"]
    assert size["machines"][3]["value"] == pytest.approx(-15.0, abs=0.5)
