"""Puts machines of an outside examiner to dtwin, marks what is said of them, and prints the table."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Protocol

from dtwin.physics.diagnose import diagnose
from dtwin.physics.diagnosis import Suspect
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.report.text import table
from dtwin.schema import Campaign, Run

MOST_IN_GROUP = 3
_LIBRARY = Library()


class Fault(Protocol):
    """One thing that is wrong; its text says what, and where."""

    @property
    def names(self) -> frozenset[str]:
        """What dtwin may call it; nothing when no effect describes it."""

    @property
    def consequences(self) -> frozenset[str]:
        """What is true of the machine because of it."""


@dataclass(frozen=True)
class Cause:
    """A fault of a machine that is measured in a folder; ``um``: what it makes alone, RMS."""

    kind: str
    names: frozenset[str]
    consequences: frozenset[str]
    um: float

    def __str__(self) -> str:
        return self.kind


def written_table(where: Path, columns: Mapping[str, Any], *, german: bool = False) -> None:
    """Write columns of numbers as a table: with commas, or as a German spreadsheet writes it."""
    apart, point = (";", ",") if german else (",", ".")
    rows = [
        apart.join(f"{value:.9g}".replace(".", point) for value in row) for row in zip(*columns.values(), strict=True)
    ]
    where.write_text("\n".join([apart.join(columns), *rows]) + "\n")


@dataclass(frozen=True)
class Case:
    """A measured machine, and what is true of it.

    Attributes:
        makes_um: What each fault makes, RMS.
        spoilt: Runs that are to be left out.
    """

    campaign: Campaign
    runs: Sequence[Run]
    faults: Sequence[Fault]
    makes_um: Sequence[float]
    noise_um: float
    spoilt: tuple[str, ...] = ()


@dataclass(frozen=True)
class Mark:
    """What was said of one machine.

    Attributes:
        shown, missed: Faults that show, and those of them that have no name.
        false: Groups of names none of which is true.
        spoilt, left_out: Runs that are to be left out, and those that were.
        spent_s, simulated_s: Processor time of the diagnosis and of the machine.
    """

    shown: tuple[str, ...]
    missed: tuple[str, ...]
    false: tuple[tuple[str, ...], ...]
    unresolved: bool
    spoilt: tuple[str, ...]
    left_out: tuple[str, ...]
    spent_s: float
    simulated_s: float


def at_most_three(row: str, group: Sequence[Suspect]) -> bool:
    """Return whether a group is small enough to name something."""
    return len(group) <= MOST_IN_GROUP


def effect_of(suspect: Suspect) -> str:
    """Return what a suspect is called where all of a machine is about one axis."""
    return suspect.effect


def _label(suspect: Suspect) -> str:
    return suspect.label


@dataclass(frozen=True)
class Exam:
    """An exam of some rows of machines.

    Attributes:
        drawn: Returns the machine of a row with a number.
        is_small: Returns whether a group of a row names something.
        label: Returns what faults call a suspect.
    """

    drawn: Callable[[str, int], Case]
    is_small: Callable[[str, Sequence[Suspect]], bool] = at_most_three
    label: Callable[[Suspect], str] = _label

    def marked(self, row: str, number: int) -> Mark:
        """Return what is said of one machine, and whether it is right."""
        began = time.process_time()
        case = self.drawn(row, number)
        simulated = time.process_time()
        found = diagnose(observe(case.campaign, case.runs), [], _LIBRARY, seed=0)
        spent_s = time.process_time() - simulated
        groups = [tuple(map(self.label, group)) for group in found.found]
        small = {self.label(suspect) for group in found.found if self.is_small(row, group) for suspect in group}
        shown = [f for f, um in zip(case.faults, case.makes_um, strict=True) if um >= case.noise_um and f.names]
        true = frozenset().union(*(fault.names | fault.consequences for fault in case.faults))
        return Mark(
            tuple(map(str, shown)),
            tuple(str(fault) for fault in shown if not fault.names & small),
            tuple(group for group in groups if not true & set(group)),
            found.unresolved is not None,
            case.spoilt,
            found.outlier_runs,
            spent_s,
            simulated - began,
        )

    def held(self, asked: argparse.Namespace) -> dict[str, list[Mark]]:
        """Return the marks of each row that was asked for."""
        out: dict[str, list[Mark]] = {}
        for row in asked.rows:
            out[row] = []
            for number in range(asked.first, asked.first + asked.cases):
                out[row].append(self.marked(row, number))
                if asked.each:
                    print(row, number, out[row][-1], file=sys.stderr, flush=True)
        return out


def _arguments(about: str | None, rows: Sequence[str], short: Sequence[str]) -> argparse.Namespace:
    """Return what was asked for; in short one machine of each of the rows ``short``."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12, help="machines of each row")
    parser.add_argument("--first", type=int, default=0, help="number of the first machine, which is its seed")
    parser.add_argument("--rows", default=",".join(rows), help="separated by commas")
    parser.add_argument("--each", action="store_true", help="tell each machine on standard error")
    parser.add_argument("--short", action="store_true", help=f"one machine of {' and '.join(short)} each")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    asked.rows = list(short) if asked.short else asked.rows.split(",")
    if asked.short:
        asked.cases = 1
    if not set(asked.rows) <= set(rows):
        parser.error(f"--rows: only {', '.join(rows)}")
    return asked


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


def _in_columns(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as a table; the keys are its head."""
    return table(list(rows[0]), [list(row.values()) for row in rows])


def printed(
    exam: Exam,
    about: str | None,
    rows: Sequence[str],
    short: Sequence[str],
    of_row: Callable[[str, Sequence[Mark]], dict[str, Any]] = summed,
) -> None:
    """Hold an exam as asked for, and print a table of its rows, of its mechanisms, and of the names that were false."""
    asked = _arguments(about, rows, short)
    marks = exam.held(asked)
    tables = {
        "rows": [of_row(row, found) for row, found in marks.items()],
        "mechanisms": _by_mechanism(marks),
        "false names": _false_names(marks),
    }
    said = [_in_columns(table) for table in tables.values() if table]
    print(json.dumps(tables) if asked.json else "\n\n".join(said))


def _by_mechanism(marks: Mapping[str, Sequence[Mark]]) -> list[dict[str, Any]]:
    every = [mark for of_row in marks.values() for mark in of_row]
    shown = Counter(kind for mark in every for kind in mark.shown)
    missed = Counter(kind for mark in every for kind in mark.missed)
    return [{"mechanism": kind, "shows": n, "named": n - missed[kind]} for kind, n in sorted(shown.items())]


def _false_names(marks: Mapping[str, Sequence[Mark]]) -> list[dict[str, Any]]:
    false = [(row, group) for row, of_row in marks.items() for mark in of_row for group in mark.false]
    groups = Counter((row, " / ".join(group)) for row, group in false)
    return [{"row": row, "false name": names, "times": n} for (row, names), n in groups.most_common()]
