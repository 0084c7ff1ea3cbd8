"""Two years of tests of a machine, many times: how often a history raises an alarm falsely, and how late and where rightly.

A machine is tested every 30 days. Its figures scatter from test to test by 0.3 um (set-up, temperature), independently, and
are drawn here, not by dtwin. Stories: nothing happens; a nut wears by 0.1 um a month from the eighth month on; a crash moves a
figure by 1.5 um in the 13th; the same with a repair in the 17th that was noted; an adjustment nobody noted; a ball bar that is
replaced by one that reads 1 um more, with both serial numbers stated. Six figures are watched, the story happens to one.

Run: python benchmarks/machine_years.py [--years N] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import numpy as np

from dtwin.machine_record import Event, MachineRecord
from dtwin.pipeline.machine_series import Point, Series, judged_series
from dtwin.report.text import table

TESTS, FIGURES, SCATTER_UM = 24, 6, 0.3
START = datetime(2025, 1, 6, 8, tzinfo=UTC)
MONTH = np.arange(TESTS)
Story = tuple[Callable[[], Any], int, str, tuple[Event, ...], int]


def _day(test: int) -> date:
    return (START + timedelta(days=30 * test)).date()


def stories() -> dict[str, Story]:
    """Return of each story what it adds in µm, the test where it begins, what is to be found, events, and the test from
    which another instrument is used.
    """
    repair = (Event(_day(17) - timedelta(days=10), "repair", "nut"),)
    nowhere = TESTS
    return {
        "nothing": (lambda: 0.0 * MONTH, nowhere, "", (), nowhere),
        "wear, 0.1 µm a month": (lambda: 0.1 * np.maximum(0, MONTH - 8), 8, "any", (), nowhere),
        "crash, 1.5 µm": (lambda: 1.5 * (MONTH >= 13), 13, "step", (), nowhere),
        "crash, then a noted repair": (lambda: 1.5 * ((MONTH >= 13) & (MONTH < 17)), 13, "step", repair, nowhere),
        "an adjustment nobody noted, -1.5 µm": (lambda: -1.5 * (MONTH >= 15), 15, "step", (), nowhere),
        "another instrument, +1 µm": (lambda: 1.0 * (MONTH >= 12), nowhere, "", (), 12),
    }


def told(story: Story, rng: np.random.Generator) -> dict[str, Any]:
    """Return what the history of one machine says of one story."""
    adds, begins, wanted, events, other = story
    series = []
    for number in range(FIGURES):
        values = 5.0 + rng.normal(0.0, SCATTER_UM, TESTS) + (adds() if number == 0 else 0.0)
        bars = ["bar 1" if test < other else "bar 2" for test in range(TESTS)]
        days = [(START + timedelta(days=30 * test)).isoformat() for test in range(TESTS)]
        points = [
            Point(f"t{i}", day, float(v), 0.2, bar)
            for i, (day, v, bar) in enumerate(zip(days, values, bars, strict=True))
        ]
        series.append(Series("XY R150 F1000", f"figure {number}", "um", tuple(points)))
    judged = {one["figure"]: one for one in judged_series(series, MachineRecord("mill", events=events))}
    alarms = {name: [c for c in one["changes"] if c["kind"] != "event"] for name, one in judged.items()}
    mine = [c for c in alarms["figure 0"] if c["at"] >= begins]
    false = sum(map(len, alarms.values())) - len(mine)
    first = min((c["at"] for c in mine), default=None)
    return {
        "false": false,
        "found": first is not None,
        "delay": None if first is None else first - begins,
        "placed": any(abs(c["first"] - begins) <= 1 for c in mine if c["kind"] == "step") if wanted == "step" else None,
    }


def measured(years: int, seed: int) -> list[dict[str, Any]]:
    """Return a row for each story."""
    rows = []
    for number, (name, story) in enumerate(stories().items()):
        rng = np.random.default_rng([seed, number])
        answers = [told(story, rng) for _ in range(years)]
        found = [a for a in answers if a["found"]]
        placed = [a["placed"] for a in found if a["placed"] is not None]
        rows.append(
            {
                "story": name,
                "machines": years,
                "false_alarms_per_200_tests": sum(a["false"] for a in answers) / years * 200 / TESTS,
                "found": len(found) / years if story[2] else None,
                "median_delay_tests": float(np.median([a["delay"] for a in found])) if story[2] and found else None,
                "at_the_right_test": float(np.mean(placed)) if placed else None,
            }
        )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--years", type=int, default=400, help="machines of each story, two years of each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--short", action="store_true", help="20 machines of each story")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    rows = measured(20 if chosen.short else chosen.years, chosen.seed)
    if chosen.json:
        print(json.dumps(rows))
        return
    head = ("story", "machines", "false alarms in 200 tests", "found", "delay, tests", "at the right test ± 1")
    print(
        table(
            head,
            [[("-" if v is None else round(v, 2) if isinstance(v, float) else v) for v in r.values()] for r in rows],
        )
    )


if __name__ == "__main__":
    main()
