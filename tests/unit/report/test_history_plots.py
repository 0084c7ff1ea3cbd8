"""Pictures of a machine's history."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import pytest

from dtwin.report.history_plots import series_figure


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


def test_tests_of_several_days_take_the_room_they_need() -> None:
    assert series_figure(series(["2026-03-02T08:00:00", "2026-05-02T08:00:00"]), []).layout.xaxis.range is None
