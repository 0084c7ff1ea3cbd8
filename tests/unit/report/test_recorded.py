"""Contradictions beside what was recorded of the machine."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import pytest

from dtwin.config import Home
from dtwin.machine_record import Event, with_event
from dtwin.physics.contradictions import Contradiction, _What
from dtwin.physics.library import Library
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin, ValidityBox
from dtwin.report.machine_tests import joint_lines
from dtwin.report.twin_of_campaigns import contradiction_lines
from dtwin.twins._kept_diagnosis import with_record

DAYS = {"a": "2026-05-01", "b": "2026-05-06", "c": "2026-05-09"}


def told(home: Home, mine: str, others: str, what: _What, days: dict[str, str] = DAYS) -> str:
    """Return the line of a twin of three tests, of which one side contradicts the other."""

    def twin(campaign: str) -> Twin:
        box = ValidityBox(("XY",), ("CCW",), (100.0, 100.0), (1000.0, 1000.0))
        return Twin("t", 1, "mill-7", campaign, "fit", (), (), (), box, {}, (), (), {}, {})

    figures = dict.fromkeys(("rms_before_um", "rms_after_um", "systematic_rms_um", "noise_floor_um"), 1.0)
    parts = tuple(Twin(**{**vars(twin(name)), "figures": figures}) for name in "abc")
    about = tuple(
        {"kind": "circular", "started": f"{days[n]}T08:00:00Z" if days[n] else "", "weight": 1.0} for n in "abc"
    )
    apart = Contradiction(tuple(mine), tuple(others), "backlash", "X", "lost_motion", "um", 3.0, 0.5, 1e-6, "", what)
    whole = SeveralTwin(
        **{**vars(twin("a, b, c")), "figures": figures}, parts=parts, about=about, contradictions=(apart,)
    )
    document = with_record(home, whole).as_dict()
    (line,) = contradiction_lines(document)
    return line


@pytest.mark.parametrize(
    ("day", "what", "mine", "others", "said"),
    [
        ("2026-05-03", "change", "bc", "a", "since the crash of 2026-05-03 (vice), which is recorded between"),
        ("2026-05-01", "change", "bc", "a", "since the crash of 2026-05-01"),
        ("2026-05-06", "change", "a", "bc", "since the crash of 2026-05-06"),
        ("2026-05-07", "change", "bc", "a", "nothing is recorded between 2026-05-01 and 2026-05-06: a change that was"),
        (
            "2026-04-30",
            "change or mistake",
            "c",
            "ab",
            "nothing is recorded between 2026-05-06 and 2026-05-09: a mistake",
        ),
        ("2026-05-08", "change or mistake", "c", "ab", "since the crash of 2026-05-08"),
        ("2026-05-12", "mistake", "b", "ac", "mistaken; nothing is recorded between 2026-05-01 and 2026-05-09"),
        ("2026-05-02", "mistake", "b", "ac", "mistaken, though the crash of 2026-05-02 (vice) is recorded before it"),
        ("2026-05-08", "mistake", "b", "ac", "mistaken, though the crash of 2026-05-08 (vice) is recorded after it"),
    ],
)
def test_an_event_counts_when_it_lies_between(
    tmp_path: Path, day: str, what: _What, mine: str, others: str, said: str
) -> None:
    home = Home(tmp_path)
    with_event(home, "mill-7", "crash", day, "vice")
    with_event(home, "mill-8", "repair", "2026-05-05", "another machine")
    line = told(home, mine, others, what)
    assert said in line
    assert "is 3.00 ± 0.50 µm above that of" in line
    assert "repair" not in line


def test_a_crash_and_its_repair_around_one_test_are_a_change_that_was_undone(tmp_path: Path) -> None:
    home = Home(tmp_path)
    with_event(home, "mill-7", "crash", "2026-05-03", "")
    with_event(home, "mill-7", "repair", "2026-05-07", "")
    assert "a change that was undone" in told(home, "b", "ac", "mistake")


def test_tests_without_days_or_mixed_in_time_are_told_as_before(tmp_path: Path) -> None:
    home = Home(tmp_path)
    with_event(home, "mill-7", "crash", "2026-05-03", "")
    line = told(home, "b", "ac", "change or mistake", {**DAYS, "a": ""})
    assert line.endswith("the machine changed, or one of them is mistaken")
    assert "crash" not in told(home, "ac", "b", "change or mistake")


@pytest.mark.parametrize(
    ("on", "said"),
    [
        (date(2026, 5, 3), "since the move of 2026-05-03"),
        (date(2026, 5, 8), "nothing is recorded between 2026-05-01 and"),
    ],
)
def test_tests_that_are_compared_one_by_one_are_told_the_same(on: date, said: str) -> None:
    sizes = [
        {"campaign": name, "started": DAYS[name], "label": "backlash X", "value": value, "uncertainty": 0.2}
        for name, value in (("a", 3.0), ("b", 6.0), ("c", 4.5))
    ]
    apart = [["a", "b", 3.0, 0.28], ["a", "c", 1.5, 0.28]]
    shared = {"cause": "backlash", "axis": "X", "unit": "um", "sizes": sizes, "value": None, "uncertainty": None}
    (line,) = joint_lines({"shared": [{**shared, "apart": apart}], "settled": []}, {}, [Event(on, "moved")])
    assert said in line
    assert "Between a and b lie 3.00 ± 0.28 µm" in line
    assert "opposite" not in line
    sizes[1]["value"] = -2.9
    apart[0][2] = -5.9
    (line,) = joint_lines({"shared": [{**shared, "apart": apart}], "settled": []}, {}, [Event(on, "moved")])
    assert line.endswith("Equal and opposite: directions, or signs, may be exchanged in one of the files.")


@pytest.mark.parametrize("on", [date(2026, 5, 3), date(2026, 5, 8)])
def test_a_name_that_another_day_settles_may_be_a_change(on: date) -> None:
    size = {"campaign": "a", "started": DAYS["a"], "label": "backlash X", "value": 3.0, "uncertainty": 0.1}
    judged = [{"label": "backlash X", "said": "is a part", "here": {**size, "value": 6.0}, "there": size}]
    settled = {"campaign": "b", "group": ["backlash X", "friction X"], "judged": judged, "left": ["friction X"]}
    tests = [{"campaign": name, "started": day} for name, day in DAYS.items()]
    found = {"shared": [], "settled": [settled], "tests": tests}
    (line,) = joint_lines(found, Library(), [Event(on, "crash")])
    assert ("Or the machine changed: crash of 2026-05-03 lies between these tests." in line) == (on.day == 3)
