"""Times with a zone and without stand in one order, and have the day of this computer."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from dtwin.lake.rows import amended, differences, run_row
from dtwin.local_time import local_time
from dtwin.schema import Campaign, Run, RunMeta


@pytest.fixture
def shanghai(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Shanghai")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("shanghai")
def test_a_recorded_run_stands_after_a_file_that_tells_local_time_before_it() -> None:
    recorded = "2026-11-26T17:00:00.000+00:00"
    rows = [
        run_row(
            Campaign(name, "m", kind="linear"),
            Run(RunMeta("r", started=started, sample_rate_hz=1.0), {"t_s": np.zeros(1)}),
        )
        for name, started in (("recorded", recorded), ("file", "2026-11-26T23:00:00"), ("unknown", ""))
    ]
    told = {row["campaign"]: row["started"] for row in amended(rows, [])}
    assert told == {"recorded": "2026-11-27T01:00:00+08:00", "file": "2026-11-26T23:00:00", "unknown": ""}
    assert differences(amended(rows, [])[0], rows[0]) == []
    # What was stored, and its hash, do not depend on where it is read.
    assert rows[0]["started"] == recorded


@pytest.mark.usefixtures("shanghai")
@pytest.mark.parametrize(
    "text",
    ["", "2026-11-26", "2026-11-26T23:00:00", "2026-11-26T23:00:00+08:00", "no time", "0001-01-01T00:00:00+14:00"],
)
def test_what_tells_no_other_zone_stays_as_it_is(text: str) -> None:
    assert local_time(text) == text
