"""A plant over a year: every machine is tested once a month, and each month ends with a night of the fleet.

Of twenty machines one is hit in the seventh month (its backlash grows by 4 um), one wears by 0.5 um a month, one is tested no more from
the fifth month on; nothing happens to the others. Tests are made by formulas of their own (``tests/machine_years.py``), and arrive as
folders; in the third month a spoilt file arrives with them. Told is what each night took, what it listed, and whether what is listed is true.

Run: python benchmarks/plant_year.py [--machines N] [--months M] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from machine_years import FIRST_DAY, steady, stepping, wearing, write_tests

from dtwin.config import Home, quiet_environment
from dtwin.fleet.nightly import nightly
from dtwin.lake.store import Lake
from dtwin.machine_record import keep_record
from dtwin.report.text import table

MONTH_DAYS = 30
HIT, UNTESTED, SPOILT = 6, 4, 2
STORIES = ("hit", "wears", "untested")
EVERY = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--months", type=int, default=12)
    parser.add_argument("--short", action="store_true", help="three machines, seven months")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    quiet_environment()
    with tempfile.TemporaryDirectory() as scratch:
        found = year(Path(scratch), *((3, 7) if given.short else (given.machines, given.months)))
    if given.json:
        print(json.dumps(found))
        return
    head = ("month", "taken in", "diagnosed", "processor, s", "open", "of these new")
    print(table(head, [[str(cell) for cell in night.values()] for night in found["nights"]]))
    print(f"{found['told']}\nfalse: {found['false'] or 'none'}; campaigns {found['campaigns']}")


def year(folder: Path, machines: int, months: int) -> dict[str, Any]:
    """Return what each night did, in which month each story was told, and what was told falsely."""
    home = Home(folder / "home")
    names = [f"mill-{number:03d}" for number in range(machines)]
    story = {name: _story(number) for number, name in enumerate(names)}
    for name in names:
        keep_record(home, name, {"type": "3-axis mill", "test_every_days": 1.5 * MONTH_DAYS})
    arriving = folder / "arriving"
    arriving.mkdir()
    nights, seen = [], set[str]()
    told: dict[str, int] = {}
    false: list[str] = []
    for month in range(months):
        for number, name in enumerate(names):
            if story[name] != "untested" or month < UNTESTED:
                _tested(arriving, name, story[name], number, month)
        if month == SPOILT:
            (arriving / "spoilt.b5r").write_text("<no>", encoding="utf-8")
        began = time.process_time()
        today = (FIRST_DAY + timedelta(days=MONTH_DAYS * month + 1)).date()
        night = nightly(home, folder=arriving, workers=1, today=today, settle_s=0.0)
        now = {alert.key for alert in night.alerts}
        nights.append(
            {
                "month": month + 1,
                "taken_in": sum(event.outcome == "ingested" for event in night.arrived),
                "diagnosed": len(night.diagnosed.done),
                "processor_s": round(time.process_time() - began, 1),
                "open": len(now),
                "new": len(now - seen),
            }
        )
        for alert in night.alerts:
            name = alert.about.split()[0]
            if _is_true(alert.sort, story.get(name, ""), month) or (alert.sort == "failed" and name == "spoilt.b5r"):
                told.setdefault(f"{name} {alert.sort}", month + 1)
            elif alert.key not in seen:
                false.append(f"month {month + 1}: {alert.sort} {alert.about}: {alert.text}"[:160])
        seen |= now
    kept = Counter(row["campaign"] for row in Lake(home.lake).runs())
    return {"nights": nights, "told": told, "false": false, "campaigns": len(kept), "runs": sum(kept.values())}


def _story(number: int) -> str:
    return STORIES[number % EVERY] if number % EVERY < len(STORIES) else ""


def _tested(arriving: Path, name: str, story: str, number: int, month: int) -> None:
    lost: Callable[[int], float] = steady(3.0)
    if story == "hit":
        lost = stepping(3.0, HIT, 7.0)
    elif story == "wears":
        lost = wearing(3.0, 0.5)
    seed = 1000 * number + month
    write_tests(
        arriving, 1, lost, steady(2.0), every_days=MONTH_DAYS, seed=seed, machine=name, first=month, named=f"{name}-m"
    )


def _is_true(sort: str, story: str, month: int) -> bool:
    """Tell whether an alert belongs to what happened to a machine by then."""
    return {
        "hit": sort == "changed" and month >= HIT,
        "wears": sort in ("changed", "limit"),
        "untested": sort == "overdue" and month > UNTESTED,
    }.get(story, False)


if __name__ == "__main__":
    main()
