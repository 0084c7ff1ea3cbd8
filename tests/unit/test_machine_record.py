"""Records of machines: kept as told, checked when read, and what a machine's history shows."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, date, datetime
from pathlib import Path
from threading import Barrier
from typing import Any, cast

import pytest
from command_here import said
from laser_axis import write_laser
from machine_years import steady, stepping, write_tests
from typer.testing import CliRunner

from dtwin.acquire.amending import amend, leave_out
from dtwin.acquire.ingest import ingest
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import NEWER, InputError
from dtwin.lake.store import Lake
from dtwin.machine_record import Event, MachineRecord, keep_record, read_record, tolerances_of, with_event
from dtwin.pipeline.machine_history import machine_history
from dtwin.pipeline.machine_report import tolerance_words
from dtwin.pipeline.machine_series import Point, Series, by_size, calendar_of, judged_series, next_test, worst_newest
from dtwin.pipeline.planned_tests import draft_of
from dtwin.report.language import Language
from dtwin.report.text import series_cells
from dtwin.tolerances import Limits
from dtwin.twins.verbs import Twins

ROOT = Path(__file__).parents[2]


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


def test_limits_of_an_axis_tell_its_travel_and_where_a_plan_begins(home: Home) -> None:
    said("machine", "add", "mill-a", "--chain", "w-Y-X-b-Z-t", "--axis", "X:low_mm=-250,high_mm=250")
    known = read_record(home, "mill-a")
    assert known is not None
    assert known.facts == {"chain": "w-Y-X-b-Z-t"}
    assert known.reach == {"X": {"low_mm": -250.0, "high_mm": 250.0, "travel_mm": 500.0}}
    plan = draft_of(home, "mill-a", "linear")["plan"]
    assert (plan["axis_low"], plan["axis_high"]) == (-250.0, 250.0)
    assert -250.0 < plan["start"] < plan["end"] < 250.0
    with pytest.raises(InputError, match="not usable"):
        keep_record(home, "mill-a", {"axes": {"Y": {"low_mm": 10.0, "high_mm": -10.0}}})


def test_what_was_mistyped_is_taken_back(home: Home) -> None:
    said("machine", "add", "mill-a", "--tolerance", "G(b)=10", "--tolerance", "D=100")
    for note in ("vice", "", "table"):
        said("machine", "event", "mill-a", "crash", "--on", "2026-03-04", "--note", note)
    said("machine", "event", "mill-a", "repair", "--on", "2026-01-02", "--note", "spindle")
    said("machine", "add", "mill-a", "--tolerance", "D=")
    said("machine", "event", "mill-a", "repair", "--on", "2026-01-02", "--take-back")
    said("machine", "event", "mill-a", "crash", "--on", "2026-03-04", "--take-back")
    for words in (
        ("add", "mill-a", "--tolerance", "D="),
        ("add", "mill-a", "--tolerance", "="),
        ("event", "mill-a", "crash", "--on", "2026-03-04", "--take-back"),
        ("event", "mill-a", "crash", "--on", "2026-03-05", "--take-back"),
        ("event", "mill-a", "crash", "--on", "2026-03-04", "--note", "wall", "--take-back"),
    ):
        assert isinstance(CliRunner().invoke(app, ["machine", *words]).exception, InputError), words
    known = read_record(home, "mill-a")
    assert known is not None
    assert known.tolerances == {"G(b)": Limits(None, 10.0)}
    assert [e.note for e in known.events] == ["vice", "table"]
    assert [tolerance_words("D", 10.0), tolerance_words("Fmin(CW)", {"low": -5.0, "high": None})] == [
        "± 10 µm",
        "≥ -5 µm",
    ]


def test_the_largest_change_comes_first_of_its_tolerance_then_of_the_noise() -> None:
    days = [f"2025-01-{day:02d}" for day in range(1, 13)]
    made = []
    for figure, scatter, step, high in (
        ("H", 0.1, 5.0, None),
        ("D", 1.0, 8.0, None),
        ("G(CW)", 0.1, 2.0, 50.0),
        ("G(b)", 0.1, 2.0, 8.0),
    ):
        at = [10.0 + scatter * (-1) ** i + step * (i > 7) for i in range(12)]
        points = tuple(Point("t", day, value, 0.1) for day, value in zip(days, at, strict=True))
        made.append(Series("XY", figure, "um", points, high=high))
    found = by_size(judged_series(made, MachineRecord("mill")))
    assert [change["text"].split(",")[0] for change in found] == ["G(b)", "H", "D", "G(CW)"]
    assert found[0]["of_tolerance"] == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(
    "text",
    [
        "what = 3",
        "serial = 3",
        "axes = 3",
        "[axes.X]\ntravel_mm = -1.0",
        "[axes.X]\nlead = 1.0",
        '[tolerances]\n"G(b)" = "x"',
        '[tolerances]\n"rotatoin:A" = 1.0',
        '[tolerances]\n"Gx" = 1.0',
        '[tolerances]\n"rotation:G(b)" = 1.0',
        '[[events]]\non = "yesterday"\nwhat = "crash"',
        '[[events]]\non = 2026-01-01\nwhat = "dance"',
        "events = [1]",
        'test_every_days = "x"',
        "test_every_days = -1",
        "= ",
        "a = " + "[" * 100_000,
    ],
)
def test_a_file_that_is_no_record_is_refused_with_its_place(home: Home, text: str) -> None:
    home.machines.mkdir(parents=True)
    (home.machines / "mill-a.toml").write_text(text)
    with pytest.raises(InputError) as refused:
        read_record(home, "mill-a")
    assert "mill-a.toml" in str(refused.value.where)


def test_a_record_of_a_newer_dtwin_hides_no_other_machine_and_stays(home: Home) -> None:
    said("machine", "add", "mill-a")
    newer = home.machines / "mill-b.toml"
    newer.write_text("spindle_rpm = 9000")
    told = cast(list[dict[str, Any]], said("machine", "list")["machines"])
    assert [(m["machine"], m["alarms"]) for m in told] == [
        ("mill-a", "not judged"),
        ("mill-b", "the record of a machine is not usable"),
    ]
    refused = CliRunner().invoke(app, ["machine", "remove", "mill-b"]).exception
    assert isinstance(refused, InputError)
    assert (refused.got, refused.hint) == ("spindle_rpm", NEWER)
    assert newer.exists()


def test_what_cannot_be_meant_of_a_machine_is_refused(home: Home) -> None:
    said("machine", "add", "mill-a", "--tolerance", "Fmin(CW)=-5", "--tolerance", "D=-8:-3")
    for words in (
        ("add", "mill-a", "--tolerance", "G(b)=-8"),
        ("add", "mill-a", "--tolerance", "G(b)=0"),
        ("add", "mill-a", "--axis", "X=500"),
        ("event", "mill-b", "crash"),
        ("measure", "mill-b"),
        ("event", "mill-a", "crash", "--on", "2099-01-01"),
    ):
        assert isinstance(CliRunner().invoke(app, ["machine", *words]).exception, InputError), words
    said("machine", "add", "mill-a", "--test-every", "30")
    asked = CliRunner().invoke(app, ["machine", "show", "mill-a", "--ics", "next.ics"]).exception
    assert isinstance(asked, InputError)
    assert "ingest" in str(asked.hint)
    known = read_record(home, "mill-a")
    assert known is not None
    assert (known.axes, known.events, read_record(home, "mill-b")) == ({}, (), None)
    assert known.tolerances == {"Fmin(CW)": Limits(-5.0, None), "D": Limits(-8.0, -3.0)}


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


def test_a_pointer_that_cannot_be_followed_hides_no_test(home: Home) -> None:
    said("machine", "add", "mill-a", "--serial", "7")
    folder = home.bundles / "mill-a"
    folder.mkdir(parents=True)
    (folder / "champion.json").write_text("{}")
    history = machine_history(home, "mill-a")
    assert history["facts"] == {"serial": "7"}
    assert "seal" in history["champion"]
    assert str(said("machine", "show", "mill-a")["champion"]).startswith("none can be served")


def test_a_crash_shows_in_the_history_of_figures_and_of_fault_sizes(home: Home) -> None:
    folders = write_tests(home.root / "made", 8, steady(2.0), stepping(3.0, 5, 12.0))
    for folder in folders:
        ingest(folder, Lake(home.lake))
    Twins(home).fit("t00", ["backlash:X", "squareness"], "mill-7")
    said("machine", "add", "mill-7", "--test-every", "30")
    said("machine", "event", "mill-7", "crash", "--on", "2025-05-20")

    def listed() -> str:
        (machine,) = cast(list[dict[str, Any]], said("machine", "list")["machines"])
        return str(machine["alarms"])

    assert listed() == "not judged"
    shown = said("machine", "show", "mill-7")
    states = [one["state"] for one in cast(list[dict[str, Any]], shown["series"])]
    assert listed().startswith(f"{states.count('changed')} changed")
    series = {one["name"]: one for one in cast(list[dict[str, Any]], shown["series"])}
    assert series["Squareness, XY"]["state"] == series["G(b), XY R150 F1000"]["state"] == "changed"
    assert "between 2025-05-06 and 2025-06-05; noted then: crash" in series["Squareness, XY"]["changes"][0]["text"]
    assert series["Backlash, X"]["state"] == "steady"
    others = {one["figure"]: one for one in cast(list[dict[str, Any]], shown["others"])}
    assert {*others} == {"G(CCW)", "Fmax(CCW)", "Fmin(CCW)", "G(CW)", "Fmax(CW)", "Fmin(CW)", "H", "D"}
    assert (others["G(CCW)"]["state"], len(others["H"]["points"])) == ("changed", 8)
    sizes = [abs(p["value"]) for p in series["Backlash, X"]["points"]]
    assert sum(sizes) / len(sizes) == pytest.approx(2.0, abs=0.3)
    known = cast(dict[str, Any], shown["known"])
    assert (known["twin"], known["campaigns"], len(known["later"])) == ("mill-7", ["t00"], 7)
    titles = [f"{one['title']}: {one['size']}" for one in known["effects"]]
    assert titles[0].startswith("Backlash X: -2.0")
    assert shown["next_test"] == {"on": "2025-09-03", "why": "a test is wanted every 30 days"}
    calendar = home.root / "next.ics"
    said("machine", "show", "mill-7", "--ics", str(calendar))
    assert b"DTSTART;VALUE=DATE:20250903\r\n" in calendar.read_bytes()
    page = home.root / "mill-7.html"
    said("machine", "show", "mill-7", "--html", str(page), "--language", "de")
    report = re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.S)
    assert re.search("Rechtwinkligkeitsabweichung, XY änderte sich um [-+]", report)
    assert "Die nächste Messung war am 2025-09-03 fällig: alle 30 Tage soll gemessen werden" in report
    assert "Was ihr Zwilling weiß" in report
    assert "die neueste vom 2025-01-06; spätere Messungen, die nicht darin sind: 7" in report
    assert 'lang="en"' not in report.partition("<body>")[2]
    # What was measured stays; a name that was mistyped goes.
    kept = CliRunner().invoke(app, ["machine", "remove", "mill-7"]).exception
    assert isinstance(kept, InputError)
    assert kept.code == "machine.measured"
    said("machine", "add", "mil-7", "--type", "mill")
    said("machine", "remove", "mil-7")
    assert [one["machine"] for one in cast(list[dict[str, Any]], said("machine", "list")["machines"])] == ["mill-7"]
    spoilt = next((home.root / "kept" / "sheets").glob("t03.json"))
    spoilt.write_text("{")
    assert said("machine", "show", "mill-7") == shown


def test_a_test_that_states_what_cannot_be_used_does_not_hide_the_others(home: Home) -> None:
    good, bad = write_tests(home.root / "made", 2, steady(2.0), steady(3.0))
    stated = bad / "campaign.toml"
    text = stated.read_text(encoding="utf-8")
    for setting, code in (
        ("uncertainty_um = -1.0", "sheet.uncertainty"),
        ("tolerances = { Gb = 4.0 }", "sheet.tolerance"),
    ):
        with_it = text.replace("[campaign]", f"[campaign]\ninstrument = {{ {setting} }}", 1)
        stated.write_text(with_it.replace("[campaign.instrument]\n", "[elsewhere]\n"), encoding="utf-8")
        refused = CliRunner().invoke(app, ["check", str(bad)]).exception
        assert isinstance(refused, InputError)
        assert refused.code == code
    for folder in (good, bad):
        ingest(folder, Lake(home.lake))
    tests = machine_history(home, "mill-7")["tests"]
    assert [test["figure"] for test in tests] == ["G(b)", ""]
    shown = said("machine", "show", "mill-7")["tests"]
    assert [test["sheet"] is None for test in cast(list[dict[str, Any]], shown)] == [False, True]


def test_a_kept_history_follows_runs_record_twins_and_amendments(home: Home) -> None:
    for folder in write_tests(home.root / "made", 3, steady(2.0), steady(3.0)):
        ingest(folder, Lake(home.lake))

    def told() -> dict[str, Any]:
        known = machine_history(home, "mill-7")
        assert machine_history(home, "mill-7") == known
        return known

    first = told()
    assert {one["figure"] for one in first["series"]} == {"G(b)"}
    # The same files under another name are no test more, in no chart.
    stated = home.root / "made" / "t00" / "campaign.toml"
    text = stated.read_text(encoding="utf-8")
    stated.write_text(text.replace('"t00"', '"t00-again"', 1), encoding="utf-8")
    ingest(stated.parent, Lake(home.lake))
    assert [test["copy_of"] for test in told()["tests"]] == ["", "t00", "", ""]
    assert [len(one["points"]) for one in told()["series"]] == [len(one["points"]) for one in first["series"]]
    leave_out(Lake(home.lake), "t00-again", [r["run_id"] for r in Lake(home.lake).runs("t00-again")], "twice", out=True)
    said("machine", "add", "mill-7", "--tolerance", "G(b)=4")
    assert {one["high"] for one in told()["series"]} == {4.0}
    Twins(home).fit("t00", ["squareness"], "mill-7")
    squareness = [one for one in told()["series"] if one["title"] == "Squareness, XY"]
    assert (told()["twins"], len(squareness[0]["points"])) == (["mill-7"], 3)
    Twins(home).fit("t00", ["backlash:X"], "mill-7")
    assert not any(one["title"] == "Squareness, XY" for one in told()["series"])
    lake = Lake(home.lake)
    runs = [row["run_id"] for row in lake.runs("t02")]
    leave_out(lake, "t02", runs, "the bar slipped", out=True)
    assert [test["campaign"] for test in told()["tests"]] == ["t00", "t01"]
    amend(lake, "t01", ["machine=mill-8"], "it was the other one", runs=[])
    assert [test["campaign"] for test in told()["tests"]] == ["t00"]
    assert [test["campaign"] for test in machine_history(home, "mill-8")["tests"]] == ["t01"]


def test_an_instrument_that_changes_and_an_event_raise_no_alarm() -> None:
    days = [f"2025-{month:02d}-10T08:00:00+00:00" for month in range(1, 11)]
    values = [5.0, 5.1, 4.9, 5.0, 5.2, 4.9, 8.0, 8.1, 7.9, 8.0]

    def judged(bars: str, *events: Event) -> dict[str, Any]:
        points = zip(days, values, bars, strict=True)
        series = Series("XY R50", "G(b)", "um", tuple(Point("t", d, v, 0.1, bar) for d, v, bar in points), high=9.0)
        (one,) = judged_series([series], MachineRecord("mill", events=events))
        return one

    assert judged("a" * 10)["state"] == "changed"
    other = judged("aaaaaabbbb")
    assert (other["state"], other["changes"][0]["kind"]) == ("steady", "event")
    assert "+2.98 ± 0.18 µm after: measured with b instead of a" in other["changes"][0]["text"]
    repaired = judged("a" * 10, Event(date(2025, 6, 20), "repair", "nut"))
    assert (repaired["state"], repaired["changes"][0]["text"][-4:]) == ("steady", " nut")
    assert "gemessen mit b statt a: Maschine oder Messgerät" in _in_german(other["changes"][0]["text"])
    same_day = judged("a" * 10, Event(date(2025, 7, 10), "repair", "nut"))
    assert [r["first"] for r in same_day["chart"]["regimes"]] == [0, 6]


def _in_german(text: str) -> str:
    said, language = Language("de").read(text)
    assert language == "de", text
    return said


def _charted(values: list[float], high: float | None = None) -> dict[str, Any]:
    days = [f"{2024 + n // 12}-{n % 12 + 1:02d}-10T08:00:00+00:00" for n in range(len(values))]
    points = tuple(Point("t", day, value, 0.1, "a") for day, value in zip(days, values, strict=True))
    (one,) = judged_series([Series("axis X", "A", "um", points, high=high)], MachineRecord("mill"))
    return one


def test_an_alarm_that_later_tests_do_not_bear_out_is_no_change_for_good() -> None:
    told = _charted([5.0, 5.1, 4.9, 4.7, 4.9, 4.7, 7.0, 5.4, 4.9, 4.8, 5.1, 5.1, 5.0, 4.7, 5.0, 5.2])
    assert told["state"] == "steady"
    (change,) = told["changes"]
    assert "A, axis X may have changed between 2024-06-10 and 2024-07-10" in change["text"]
    assert "+0.34 ± 0.59 µm, which may be nothing" in change["text"]
    assert _in_german(change["text"]).startswith(
        "A, Achse X änderte sich vielleicht zwischen 2024-06-10 und 2024-07-10"
    )


def test_a_level_that_goes_over_into_a_trend_is_one_change_and_its_level_the_last() -> None:
    steady = [4.17, 4.59, 4.73, 4.40, 4.20, 4.62, 4.61, 4.58, 4.36, 4.44, 4.55]
    wear = [4.73, 4.99, 5.15, 5.27, 5.38, 5.50, 5.47, 5.78, 5.98, 5.85, 6.10, 6.34, 6.38]
    told = _charted(steady + wear)
    (change,) = told["changes"]
    assert (change["kind"], change["seen"]) == ("trend", "2025-02-10")
    assert (told["state"], told["level"]) == ("trend", "6.390 ± 0.100")
    # A crash before the wear is a change of its own.
    crash = _charted([*steady, *(v + 4.0 for v in wear)])
    assert [c["kind"] for c in crash["changes"]] == ["trend", "step"]


def test_what_leads_to_a_limit_is_not_called_steady() -> None:
    rising = [5.0, 5.0, 5.3, 5.2, 5.1, 5.4, 5.7, 5.7, 5.3, 5.2, 5.4, 5.7, 5.1, 5.7, 5.5, 5.7]
    told = _charted(rising, 10.0)
    assert told["crossing"]["limit"] == 10.0
    assert series_cells({**told, "crossing": None})[-1] == "≤ 10 µm"
    assert told["state"] == "slow trend"
    due = next_test([told], MachineRecord("mill"), "")
    assert _in_german(f"The next test was due on {due['on']}: {due['why']}").endswith("die Grenze überschreiten")
    assert _charted(rising)["state"] == "steady"


def test_a_calendar_file_folds_long_lines() -> None:
    due = {"on": "2026-01-02", "why": "µ, " * 60 + "a\r\nEND:VEVENT"}
    text = calendar_of("mill", due, datetime(2026, 1, 1, tzinfo=UTC))
    assert text.count("\r\nEND:VEVENT") == 1
    assert all(len(line.encode()) <= 75 for line in text.split("\r\n"))
    assert text.replace("\r\n ", "").count("µ\\, ") == 60


def test_tests_of_two_instruments_are_compared(home: Home, tmp_path: Path) -> None:
    # Steps outwards, as of a table that comes late.
    bar, later = write_tests(tmp_path / "bar", 2, steady(-4.0), steady(3.0))
    ingest(bar, Lake(home.lake))
    alone = CliRunner().invoke(app, ["machine", "diagnose", "mill-7"])
    assert alone.exit_code == 1
    assert "there are not two tests to compare" in str(alone.exception)
    laser = write_laser(tmp_path / "laser-x", "mill-7", "X", 0.0, 4.0)
    stated = (laser / "campaign.toml").read_text(encoding="utf-8")
    pitch = stated.replace("[[run]]", "[campaign.machine_geometry]\nscrew_pitch_mm = 7.0\n[[run]]", 1)
    (laser / "campaign.toml").write_text(pitch, encoding="utf-8")
    ingest(laser, Lake(home.lake))
    told = cast(dict[str, Any], said("machine", "diagnose", "mill-7"))
    assert {t["kind"] for t in told["tests"]} == {"circular", "linear"}
    (shared,) = [s for s in told["shared"] if s["cause"] == "backlash"]
    assert shared["value"] == pytest.approx(4.0, abs=0.5)
    assert any(line.startswith("Backlash X: ") and "2 tests that agree" in line for line in told["lines"])
    for words in (("machine", "diagnose", "mill-7", "--campaign", "t0"), ("runs", "t0")):
        slip = CliRunner().invoke(app, list(words))
        assert isinstance(slip.exception, InputError)
        assert (slip.exception.code, slip.exception.meant) == ("campaign.unknown", "t00")
    # The list of machines shows what is worst of all that was not measured again, not what was measured last.
    said("machine", "add", "mill-7", "--tolerance", "A=0.5")
    history = machine_history(home, "mill-7")
    worst = worst_newest(history["tests"])
    assert worst is not None
    assert (history["tests"][-1]["kind"], worst["campaign"], worst["decision"]) == ("circular", "laser-x", "outside")
    again = {**worst, "campaign": "t01", "decision": "inside"}
    assert worst_newest([*history["tests"], again]) is again
    assert worst_newest([*history["tests"], {**again, "moved": ["Y"]}]) == worst
    # One series for each cause, whatever the twin of circles and that of strokes call it.
    ingest(later, Lake(home.lake))
    Twins(home).fit("t00", ["cyclic_error:X"], "circles")
    Twins(home).fit("laser-x", ["screw_error:X"], "axis")
    series = machine_history(home, "mill-7")["series"]
    assert [(s["title"], len(s["points"])) for s in series if "error" in s["title"]] == [
        ("Screw error within a turn, X", 3)
    ]
    other = write_laser(tmp_path / "elsewhere", "mill-8", "X", 0.0, 4.0)
    ingest(other, Lake(home.lake))
    refused = CliRunner().invoke(app, ["machine", "diagnose", "mill-7", "--campaign", "t00", "--campaign", "elsewhere"])
    assert refused.exit_code == 1
    assert "the campaign is of another machine" in str(refused.exception)


def test_what_many_state_at_the_same_moment_is_all_kept(tmp_path: Path) -> None:
    home = Home(tmp_path)
    started = Barrier(8)

    def told(number: int) -> None:
        started.wait(300)
        for n in range(5):
            keep_record(home, "mill", {"axes": {f"A{number}{n}": {"pitch_mm": 5.0}}})
            with_event(home, "mill", "other", "2026-02-01", f"{number} {n}")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(told, range(8)))
    record = read_record(home, "mill")
    assert record is not None
    assert (len(record.axes), len(record.events)) == (40, 40)
