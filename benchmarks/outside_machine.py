"""Machines of an outside examiner, who saw no source of dtwin: what is named of them, and what is named falsely?

Axes are simulated in time (``outside/drives.py``), share no code and no formula with dtwin, and are wrong in ways that
the examiner thought of (``outside/faults.py``). Four rows of machines, each diagnosed once, from nothing:

- full: three to eight faults; one plane or three, two or three radii, three feeds, two repeats
- everyday: three to six faults; one radius and one feed, two or three repeats
- null: nothing wrong
- unknown: three faults and one thing that no effect describes: a door, a hose, a cable chain or a cover

A fault shows when it makes, beside all others, at least the noise (RMS). It is named when it is in a group of at most three
effects with their axes; in everyday tests of four effects, axes not counted. A name is false when no member of its group
is a fault of the machine or a consequence of one: the tilt of a bent guideway is a squareness, the wind-up of friction is a
backlash, the guideway that holds a nut with play rubs, a warm axis has a scale and drifts, a mode far above is a
lag. What no effect describes has no name, and is not asked for. Unit of replication: the machine.

Run: python benchmarks/outside_machine.py [--cases N] [--first SEED] [--rows full,everyday,null,unknown] [--each] [--short] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "outside"))

from faults import UNKNOWN, Design, Fault, drawn
from session import Machine, left_out_um, measured

from dtwin.physics.diagnose import diagnose
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.report.text import table

LIBRARY = Library()
ROWS = ("full", "everyday", "null", "unknown")
MOST_IN_GROUP, MOST_EVERYDAY = 3, 4
_SEED = 77
_FEEDS = (500.0, 1500.0, 4000.0)
_ONE_PLANE = Design(("XY",), (50.0, 100.0, 150.0), _FEEDS, 2)
_EVERYDAY = ("backlash", "friction", "cyclic", "scale", "squareness", "kv_mismatch", "straightness", "lateral")
KINDS: Mapping[str, tuple[str, ...]] = {
    "full": (*_EVERYDAY, "servo_lag", "mode", "heat", "drift"),
    "everyday": _EVERYDAY,
    "null": (),
    "unknown": ("backlash", "friction", "squareness", "scale", "cyclic", "kv_mismatch", "straightness"),
}
# How many faults the machines have, in turn.
COUNTS: Mapping[str, tuple[int, ...]] = {
    "full": (3, 4, 5, 5, 6, 6, 7, 8),
    "everyday": (3, 3, 4, 4, 5, 5, 6, 6),
    "null": (0,),
    "unknown": (3,),
}
_RUBBING_N, _RUBBING_NULL_N = 4.0, 1.0


@dataclass(frozen=True)
class Mark:
    """What was said of one machine.

    Attributes
    ----------
    shown, missed : tuple of str
        Faults that show, and those of them that have no name.
    false : tuple of tuple of str
        Groups of names none of which is true.
    spent_s, simulated_s : float
        Processor time of the diagnosis and of the machine.
    """

    shown: tuple[str, ...]
    missed: tuple[str, ...]
    false: tuple[tuple[str, ...], ...]
    unresolved: bool
    spent_s: float
    simulated_s: float


def marked(row: str, number: int) -> Mark:
    """Return what is said of one machine, and whether it is right."""
    began = time.process_time()
    rng = np.random.default_rng([number, ROWS.index(row), _SEED])
    noise_um = float(rng.choice([0.1, 0.2, 0.3, 0.5]))
    design = _design(row, number, rng)
    centre_mm = {letter: float(rng.uniform(-150.0, 150.0)) for letter in "XYZ"}
    count = COUNTS[row][number % len(COUNTS[row])]
    every = drawn(KINDS[row], count, design, centre_mm, noise_um, rng)
    if row == "unknown":
        every.append(UNKNOWN[number % len(UNKNOWN)](rng.uniform(5.0, 9.0)))
    machine = Machine(centre_mm, _RUBBING_NULL_N if row == "null" else _RUBBING_N, tuple(every))
    campaign, runs = measured(machine, design, noise_um, f"{row}-{number}", rng)
    makes_um = left_out_um(machine, design)
    simulated = time.process_time()
    found = diagnose(observe(campaign, runs), [], LIBRARY, seed=0)
    spent_s = time.process_time() - simulated
    groups = [tuple(suspect.label for suspect in group) for group in found.found]
    shown = [f for f, um in zip(every, makes_um, strict=True) if um >= noise_um and f.names]
    small = {label for group in groups if _is_small(group, row) for label in group}
    true = frozenset().union(*(fault.names | fault.consequences for fault in every))
    return Mark(
        tuple(_said(f) for f in shown),
        tuple(_said(f) for f in shown if not f.names & small),
        tuple(group for group in groups if not true & set(group)),
        found.unresolved is not None,
        spent_s,
        simulated - began,
    )


def _design(row: str, number: int, rng: np.random.Generator) -> Design:
    if row == "everyday":
        radius, feed = float(rng.choice([100.0, 150.0])), float(rng.choice([1000.0, 1500.0, 2500.0]))
        return Design(("XY",), (radius,), (feed,), int(rng.choice([2, 3])))
    if row == "null":
        three = Design(("XY", "YZ", "ZX"), (100.0, 150.0), _FEEDS, 2)
        return (_ONE_PLANE, three, _ONE_PLANE, Design(("XY",), (150.0,), (1000.0,), 3))[number % 4]
    if row == "full" and number % 3 == 0:
        radii = (100.0, 150.0) if number % 2 else (50.0, 100.0, 150.0)
        return Design(("XY", "YZ", "ZX"), radii, _FEEDS, 2)
    return _ONE_PLANE


def _is_small(group: Sequence[str], row: str) -> bool:
    if row == "everyday":
        return len({label.split()[0] for label in group}) <= MOST_EVERYDAY
    return len(group) <= MOST_IN_GROUP


def _said(fault: Fault) -> str:
    return f"{fault.kind} {fault.axis}".rstrip()


def summed(row: str, marks: Sequence[Mark]) -> dict[str, Any]:
    """Return one row of the table."""
    shown = sum(len(mark.shown) for mark in marks)
    return {
        "row": row,
        "machines": len(marks),
        "faults that show": shown,
        "named": shown - sum(len(mark.missed) for mark in marks),
        "false names per machine": sum(len(mark.false) for mark in marks) / len(marks),
        "something unresolved": sum(mark.unresolved for mark in marks),
        "median s": median(mark.spent_s for mark in marks),
        "median s of simulation": median(mark.simulated_s for mark in marks),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12, help="machines of each row")
    parser.add_argument("--first", type=int, default=0, help="number of the first machine, which is its seed")
    parser.add_argument("--rows", default=",".join(ROWS), help="separated by commas")
    parser.add_argument("--each", action="store_true", help="tell each machine on standard error")
    parser.add_argument("--short", action="store_true", help="one everyday and one null machine")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    wanted = ["everyday", "null"] if asked.short else asked.rows.split(",")
    if not set(wanted) <= set(ROWS):
        parser.error(f"--rows: only {', '.join(ROWS)}")
    rows = []
    for row in wanted:
        marks = []
        for number in range(asked.first, asked.first + (1 if asked.short else asked.cases)):
            marks.append(marked(row, number))
            if asked.each:
                print(row, number, marks[-1], file=sys.stderr, flush=True)
        rows.append(summed(row, marks))
    if asked.json:
        print(json.dumps(rows))
        return
    print(table(list(rows[0]), [list(r.values()) for r in rows]))


if __name__ == "__main__":
    main()
