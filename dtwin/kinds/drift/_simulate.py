"""Logs of the virtual column."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import numpy as np

from dtwin.acquire.campaign_file import write_campaign_file
from dtwin.acquire.virtual import EPOCH
from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.kinds.machine import require_no_campaign
from dtwin.machines.warm_column import STEP_S, ColumnParameters, Day, WarmColumn
from dtwin.progress import Progress
from dtwin.schema import Floats

MACHINE = "virtual-warm-column"
TYPE = "warm_column"
AXIS = "Z"
TRUTHS = {
    "surface": ColumnParameters(),
    "pockets": ColumnParameters(sunk=True),
    "thermistor": ColumnParameters(sunk=True, curve_per_k=0.02),
}
PROBED_S = 60.0
AGAIN = 2
_LOGS, _HOURS, _QUICK_HOURS = 3, 10.0, 8.0


def column_of(truth: str) -> WarmColumn:
    """Return the virtual column by where its sensors sit; raises ``InputError`` when there is none such."""
    if truth not in TRUTHS:
        raise InputError("no such column", code="simulate.truth", got=truth[:40], allowed=", ".join(TRUTHS))
    return WarmColumn(TRUTHS[truth])


def probed(day: Day) -> Floats:
    """Return the numbers of the steps at which the probe reads, each as often as it reads there."""
    every = np.arange(0, day.t_s.size, round(PROBED_S / STEP_S))
    return np.repeat(every, AGAIN)


def simulate_drift(
    folder: Path, progress: Progress, *, truth: str = "surface", seed: int = 0, quick: bool = False
) -> int:
    """Log the virtual column on days of many jobs and write a campaign folder; return how many logs.

    ``quick``: one log of one shift. Raises ``InputError`` when the folder holds a campaign, or there is no such column.
    """
    require_no_campaign(folder)
    column = column_of(truth)
    folder.mkdir(parents=True, exist_ok=True)
    logs, hours = (1, _QUICK_HOURS) if quick else (_LOGS, _HOURS)
    runs = []
    for number in range(logs):
        drawn = 1000 * seed + number
        day = column.day(column.drawn_program_w(hours, drawn), drawn)
        write_text(folder / f"day-{number + 1}.csv", _log(column, day, drawn), "the log")
        started = (EPOCH + timedelta(days=number)).isoformat()
        runs.append(
            {
                "id": f"day-{number + 1}",
                "file": f"day-{number + 1}.csv",
                "condition": {"axis": AXIS},
                "started": started,
            }
        )
        progress(number + 1, logs, f"day {number + 1}")
    head = {
        "name": f"warm-column-{truth}",
        "machine": MACHINE,
        "kind": "drift",
        "machine_geometry": {"type": TYPE, "virtual": True, "truth": truth},
        "instrument": {"model": "virtual probe and thermometers"},
    }
    write_campaign_file(folder, head, runs)
    return logs


def _log(column: WarmColumn, day: Day, seed: int) -> str:
    at = probed(day)
    sample = np.repeat(np.arange(at.size // AGAIN), AGAIN)
    read = column.probed_um(day.moved_um[at], seed)
    lines = [",".join(["t_s", "sample", "displacement_um", *(f"temperature_{name}_c" for name in day.read_c)])]
    for n, (i, of, um) in enumerate(zip(at.tolist(), sample.tolist(), read.tolist(), strict=True)):
        cells = [
            f"{day.t_s[i] + n % AGAIN:z.0f}",
            str(of),
            f"{um:z.3f}",
            *(f"{c[i]:z.2f}" for c in day.read_c.values()),
        ]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"
