"""Records of machines: kept as told, checked when read, and what a machine's history shows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dtwin.acquire.ingest import ingest
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lake.store import Lake
from dtwin.machine_record import read_record, tolerances_of
from dtwin.tolerances import Limits

ROOT = Path(__file__).parents[2]


def said(*words: str) -> dict[str, object]:
    done = CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return dict(json.loads(done.stdout))


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Home:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path))
    return Home(tmp_path)


def test_what_is_told_stays_until_it_is_told_anew(home: Home) -> None:
    said("machine", "add", "mill-a", "--serial", "7", "--axis", "X:travel_mm=500,pitch_mm=10", "--tolerance", "G(b)=10")
    said("machine", "add", "mill-a", "--type", "mill", "--tolerance", "Fmin(CW)=-5:5", "--tolerance", "G(b)=8")
    said("machine", "event", "mill-a", "crash", "--on", "2026-03-04", "--note", "vice")
    said("machine", "event", "mill-a", "repair", "--on", "2026-01-02")
    known = read_record(home, "mill-a")
    assert known is not None
    assert known.facts == {"type": "mill", "serial": "7"}
    assert known.axes == {"X": {"travel_mm": 500.0, "pitch_mm": 10.0}}
    assert tolerances_of(home, "mill-a") == {"G(b)": Limits(None, 8.0), "Fmin(CW)": Limits(-5.0, 5.0)}
    assert [(e.on.isoformat(), e.what) for e in known.events] == [("2026-01-02", "repair"), ("2026-03-04", "crash")]


@pytest.mark.parametrize(
    "text",
    [
        "what = 3",
        "serial = 3",
        "axes = 3",
        "[axes.X]\ntravel_mm = -1.0",
        "[axes.X]\nlead = 1.0",
        '[tolerances]\n"G(b)" = "x"',
        '[[events]]\non = "yesterday"\nwhat = "crash"',
        '[[events]]\non = 2026-01-01\nwhat = "dance"',
        "events = [1]",
        "= ",
    ],
)
def test_a_file_that_is_no_record_is_refused_with_its_place(home: Home, text: str) -> None:
    home.machines.mkdir(parents=True)
    (home.machines / "mill-a.toml").write_text(text)
    with pytest.raises(InputError) as refused:
        read_record(home, "mill-a")
    assert "mill-a.toml" in str(refused.value.where)


def test_a_name_cannot_leave_the_folder(home: Home) -> None:
    with pytest.raises(InputError, match="usable name"):
        read_record(home, "../../x")


def test_the_history_of_a_machine_has_its_tests_in_their_order(home: Home) -> None:
    ingest(ROOT / "data/examples/nothing-hidden", Lake(home.lake))
    ingest(ROOT / "data/samples/ur10e_xy_r100_f5000.b5r", Lake(home.lake))
    said("machine", "add", "virtual-mill", "--tolerance", "G(b)=50")
    said("machine", "add", "mill-new")
    listed = said("machine", "list")["machines"]
    assert isinstance(listed, list)
    assert [(m["machine"], len(m["campaigns"])) for m in listed] == [
        ("mill-new", 0),
        ("ur10e-error-map", 1),
        ("virtual-mill", 1),
    ]
    shown = said("machine", "show", "virtual-mill")
    assert isinstance(shown["tests"], list)
    (test,) = shown["tests"]
    assert (test["campaign"], test["figure"], test["decision"]) == ("nothing-hidden", "G(b)", "inside")
    largest = max(c["value_um"] for p in test["sheet"]["parts"] for c in p["characteristics"] if c["symbol"] == "G(b)")
    assert test["value_um"] == largest
    unknown = CliRunner().invoke(app, ["machine", "show", "nix"])
    assert unknown.exit_code != 0
