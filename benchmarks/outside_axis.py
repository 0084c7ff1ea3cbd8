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

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "outside"))

from axis_session import axis, measured, spoilt_runs
from exam import Case, Exam, Mark, arguments, in_columns, summed

from dtwin.physics.diagnosis import Suspect

ROWS = ("full", "null", "unknown", "spoilt")


def machine(row: str, number: int) -> Case:
    """Return a machine of a row."""
    whole = axis(row, number)
    campaign, runs = measured(whole)
    makes_um = [fault.rms_um for fault in whole.faults]
    return Case(campaign, runs, whole.faults, makes_um, whole.noise_um, spoilt_runs(whole.faults))


def _effect(suspect: Suspect) -> str:
    return suspect.effect


def _summed(row: str, marks: Sequence[Mark]) -> dict[str, Any]:
    """Return one row of the first table: the common one, and what was left out."""
    return summed(row, marks) | {
        "spoilt runs": sum(len(mark.spoilt) for mark in marks),
        "left out": sum(len(set(mark.spoilt) & set(mark.left_out)) for mark in marks),
        "good runs left out": sum(len(set(mark.left_out) - set(mark.spoilt)) for mark in marks),
    }


def _by_mechanism(marks: Mapping[str, Sequence[Mark]]) -> list[dict[str, Any]]:
    every = [mark for of_row in marks.values() for mark in of_row]
    shown = Counter(kind for mark in every for kind in mark.shown)
    missed = Counter(kind for mark in every for kind in mark.missed)
    return [{"mechanism": kind, "shows": n, "named": n - missed[kind]} for kind, n in sorted(shown.items())]


def _false_names(marks: Mapping[str, Sequence[Mark]]) -> list[dict[str, Any]]:
    false = [(row, group) for row, of_row in marks.items() for mark in of_row for group in mark.false]
    groups = Counter((row, " / ".join(group)) for row, group in false)
    return [{"row": row, "false name": names, "times": n} for (row, names), n in groups.most_common()]


def main() -> None:
    """Print the tables."""
    asked = arguments(__doc__, ROWS, short=("full", "null"))
    marks = Exam(machine, label=_effect).held(asked)
    tables = {
        "rows": [_summed(row, of_row) for row, of_row in marks.items()],
        "mechanisms": _by_mechanism(marks),
        "false names": _false_names(marks),
    }
    said = [in_columns(rows) for rows in tables.values() if rows]
    print(json.dumps(tables) if asked.json else "\n\n".join(said))


if __name__ == "__main__":
    main()
