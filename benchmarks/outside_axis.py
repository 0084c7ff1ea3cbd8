"""Axes of an outside examiner, who saw no source of dtwin: what is named of them, and what is named falsely?

Positioning tests with a laser share no code and no formula with dtwin (``outside/axis_session.py``), and axes are
wrong in ways that the examiner thought of (``outside/axis_faults.py``). There are 11 to 50 targets, moved aside at
random or even, in five runs there and back; in some designs in three runs, or read one way only. The pitch of the
screw is stated in 0.7 of the machines, and a temperature is logged in half of them. Four rows of machines, each
diagnosed once, from nothing:

- full: two to five faults
- null: nothing wrong
- unknown: two faults and one thing that no effect describes: a dent, a door or a hose
- spoilt: two faults, and one run that is spoilt

A fault shows when it makes, alone, at least the noise (RMS about its mean). It is named when one of its names is in a
group of at most three. A name is false when no member of its group is a fault of the axis or a consequence of one: a
worn stretch is play and a pitch error, an axis that warms has a scale error, and its zero drifts. What no effect
describes has no name, and is not asked for; nor is a graduation of the scale that is finer than any target resolves.
Unit of replication: the machine.

Two further tables tell, of all rows together, how often each mechanism was named, and which names were false.

Run: python benchmarks/outside_axis.py [--cases N] [--first NUMBER] [--rows full,null,unknown,spoilt] [--each]
     [--short] [--json]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "outside"))

from axis_session import axis, measured, spoilt_runs
from exam import Case, Exam, Mark, effect_of, printed, summed

ROWS = ("full", "null", "unknown", "spoilt")


def machine(row: str, number: int) -> Case:
    """Return a machine of a row."""
    whole = axis(row, number)
    campaign, runs = measured(whole)
    makes_um = [fault.rms_um for fault in whole.faults]
    return Case(campaign, runs, whole.faults, makes_um, whole.noise_um, spoilt_runs(whole.faults))


def _summed(row: str, marks: Sequence[Mark]) -> dict[str, Any]:
    """Return one row of the first table: the common one, and what was left out."""
    return summed(row, marks) | {
        "spoilt runs": sum(len(mark.spoilt) for mark in marks),
        "left out": sum(len(set(mark.spoilt) & set(mark.left_out)) for mark in marks),
        "good runs left out": sum(len(set(mark.left_out) - set(mark.spoilt)) for mark in marks),
    }


def main() -> None:
    """Print the tables."""
    printed(Exam(machine, label=effect_of), __doc__, ROWS, ("full", "null"), _summed)


if __name__ == "__main__":
    main()
