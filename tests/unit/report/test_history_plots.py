"""Pictures of a machine's history and of the versions of a twin."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import pytest

from dtwin.machine_record import MachineRecord
from dtwin.pipeline.machine_series import Point, Series, judged_series
from dtwin.report.history_plots import series_figure
from dtwin.report.text import gain_words
from dtwin.report.twin_plots import waterfall_figure


def series(days: list[str]) -> dict[str, Any]:
    points = [{"started": day, "value": 5.0, "expanded": 1.0, "campaign": f"t{i}"} for i, day in enumerate(days)]
    return {
        "name": "G(b)",
        "unit": "µm",
        "points": points,
        "low": None,
        "high": 10.0,
        "chart": {"alarms": [], "regimes": []},
    }


@pytest.mark.parametrize("days", [["2026-03-02T08:00:00"], ["2026-03-02T08:00:00+00:00", "2026-03-02T15:00:00"]])
def test_tests_of_one_day_stand_between_the_days_beside_it(days: list[str]) -> None:
    first, last = map(datetime.fromisoformat, series_figure(series(days), []).layout.xaxis.range)
    assert last - first >= timedelta(days=2)
    assert first < datetime.fromisoformat(days[0]).replace(tzinfo=None) < last


def test_tests_of_several_days_take_the_room_they_need_and_months_are_numbers() -> None:
    axis = series_figure(series(["2026-03-02T08:00:00", "2026-05-02T08:00:00"]), []).layout.xaxis
    assert axis.range is None
    # Names of months would be English in a German report.
    assert axis.tickformatstops
    assert not [stop.value for stop in axis.tickformatstops if "%b" in stop.value]


def test_events_of_one_day_stand_above_each_other() -> None:
    events = [{"on": "2026-03-04", "what": what} for what in ("crash", "repair")]
    named = series_figure(series(["2026-03-02T08:00:00"]), events).layout.annotations
    assert sorted({note.yshift for note in named if note.text in ("crash", "repair")}) == [0, 16]


def test_the_noise_floor_of_tests_is_drawn_about_each_level_and_named_once() -> None:
    days = [f"2025-{month:02d}-10T08:00:00+00:00" for month in range(1, 13)]
    values = [5.0, 5.2, 4.9, 5.1, 5.0, 4.8, 8.0, 8.1, 7.9, 8.0, 8.2, 8.1]
    points = tuple(Point(f"t{i}", day, value, 0.1) for i, (day, value) in enumerate(zip(days, values, strict=True)))
    (told,) = judged_series([Series("XY R50", "G(b)", "um", points)], MachineRecord("mill"))
    figure = series_figure(told, [])
    bands = [trace for trace in figure.data if str(trace.name).startswith("noise floor")]
    assert [trace.showlegend for trace in bands] == [True, False]
    regime = told["chart"]["regimes"][-1]
    assert max(bands[-1].y) == pytest.approx(regime["mean"] + regime["floor"])
    # One more test lies further off than the mean of all may.
    assert regime["floor"] == pytest.approx(regime["expanded"] * 7**0.5)
    assert told["floor"] == f"± {regime['floor']:.2f}"
    assert "test that raised an alarm" in [trace.name for trace in figure.data]


@pytest.mark.parametrize("action", ["add scale_mismatch XY", "add link_geometry@J1, link_geometry@J2"])
def test_long_steps_of_a_twin_leave_room_for_their_bars(action: str) -> None:
    rungs = [{"version": 1, "action": action, "rms_before_um": 2.0, "rms_after_um": 1.0, "noise_floor_um": 0.5}]
    (bars,) = waterfall_figure(rungs).data
    assert bars.x[1] == ("v1" if "@" in action else "v1 add Scale mismatch XY")
    assert bars.hovertext[1].startswith("v1 add ")


def test_a_gain_that_no_number_tells_is_no_number() -> None:
    assert [gain_words(gain) for gain in (0.127, -0.096, -14.8)] == ["12.7 %", "-9.6 %", "< -100 %"]
