"""Machines of an outside examiner, who saw no source of dtwin: what is named of them, and what is named falsely?

Axes are simulated in time (``outside/drives.py``), share no code and no formula with dtwin, and are wrong in ways that
the examiner thought of (``outside/faults.py``). Five rows of machines, each diagnosed once, from nothing:

- full: three to eight faults; one plane or three, two or three radii, three feeds, two repeats
- everyday: three to six faults; one radius and one feed, two or three repeats
- planes: four to seven of the same faults; three planes, one radius and one feed, two or three repeats
- null: nothing wrong
- unknown: three faults and one thing that no effect describes: a door, a hose, a cable chain or a cover

A fault shows when it makes, beside all others, at least the noise (RMS). It is named when it is in a group of at most three
effects with their axes; in everyday tests, of one plane or three, of four effects, axes not counted. A name is false when no member of its group
is a fault of the machine or a consequence of one: the tilt of a bent guideway is a squareness, the wind-up of friction is a
backlash, the guideway that holds a nut with play rubs, a warm axis has a scale and drifts, a mode far above is a
lag. What no effect describes has no name, and is not asked for. Unit of replication: the machine.

Two further tables tell, of all rows together, how often each mechanism was named, and which names were false.

Run: python benchmarks/outside_machine.py [--cases N] [--first SEED] [--rows full,everyday,null,unknown,planes] [--each] [--short] [--json]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "outside"))

from exam import Case, Exam, at_most_three, printed
from faults import UNKNOWN, Design, drawn
from session import Machine, left_out_um, measured

from dtwin.physics.diagnosis import Suspect

ROWS = ("full", "everyday", "null", "unknown", "planes")
_ONE_SPEED = ("everyday", "planes")
MOST_EVERYDAY = 4
_SEED = 77
_FEEDS = (500.0, 1500.0, 4000.0)
_ONE_PLANE = Design(("XY",), (50.0, 100.0, 150.0), _FEEDS, 2)
_EVERYDAY = ("backlash", "friction", "cyclic", "scale", "squareness", "kv_mismatch", "straightness", "lateral")
KINDS: Mapping[str, tuple[str, ...]] = {
    "full": (*_EVERYDAY, "servo_lag", "mode", "heat", "drift"),
    "everyday": _EVERYDAY,
    "planes": _EVERYDAY,
    "null": (),
    "unknown": ("backlash", "friction", "squareness", "scale", "cyclic", "kv_mismatch", "straightness"),
}
# How many faults the machines have, in turn.
COUNTS: Mapping[str, tuple[int, ...]] = {
    "full": (3, 4, 5, 5, 6, 6, 7, 8),
    "everyday": (3, 3, 4, 4, 5, 5, 6, 6),
    "planes": (4, 5, 6, 7),
    "null": (0,),
    "unknown": (3,),
}
_RUBBING_N, _RUBBING_NULL_N = 4.0, 1.0


def machine(row: str, number: int) -> Case:
    """Return a machine of a row."""
    rng = np.random.default_rng([number, ROWS.index(row), _SEED])
    noise_um = float(rng.choice([0.1, 0.2, 0.3, 0.5]))
    design = _design(row, number, rng)
    centre_mm = {letter: float(rng.uniform(-150.0, 150.0)) for letter in "XYZ"}
    count = COUNTS[row][number % len(COUNTS[row])]
    every = drawn(KINDS[row], count, design, centre_mm, noise_um, rng)
    if row == "unknown":
        every.append(UNKNOWN[number % len(UNKNOWN)](rng.uniform(5.0, 9.0)))
    whole = Machine(centre_mm, _RUBBING_NULL_N if row == "null" else _RUBBING_N, tuple(every))
    campaign, runs = measured(whole, design, noise_um, f"{row}-{number}", rng)
    return Case(campaign, runs, every, left_out_um(whole, design), noise_um)


def _design(row: str, number: int, rng: np.random.Generator) -> Design:
    if row in _ONE_SPEED:
        radius, feed = float(rng.choice([100.0, 150.0])), float(rng.choice([1000.0, 1500.0, 2500.0]))
        planes = ("XY",) if row == "everyday" else ("XY", "YZ", "ZX")
        return Design(planes, (radius,), (feed,), int(rng.choice([2, 3])))
    if row == "null":
        three = Design(("XY", "YZ", "ZX"), (100.0, 150.0), _FEEDS, 2)
        return (_ONE_PLANE, three, _ONE_PLANE, Design(("XY",), (150.0,), (1000.0,), 3))[number % 4]
    if row == "full" and number % 3 == 0:
        radii = (100.0, 150.0) if number % 2 else (50.0, 100.0, 150.0)
        return Design(("XY", "YZ", "ZX"), radii, _FEEDS, 2)
    return _ONE_PLANE


def _is_small(row: str, group: Sequence[Suspect]) -> bool:
    if row in _ONE_SPEED:
        return len({suspect.effect for suspect in group}) <= MOST_EVERYDAY
    return at_most_three(row, group)


def main() -> None:
    """Print the tables."""
    printed(Exam(machine, _is_small), __doc__, ROWS, short=("everyday", "null"))


if __name__ == "__main__":
    main()
