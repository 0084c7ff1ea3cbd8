"""Robot arms and logs of drift of an outside examiner: what is named of them, from nothing, and what is named falsely?

The generators (``outside/arm.py``, ``outside/drift_log.py``) were first written from mechanism, before their author saw how dtwin
models these tests. Each machine is a campaign folder as a user would write it: it is ingested, a twin without effects is fitted,
and ``discover`` finds the rest. Rows:

- arm-null, drift-null: nothing wrong
- arm-single, drift-single: one cause
- arm-full, drift-full: three to five causes
- arm-unknown: one or two causes and a base that tips, a cable, a flank that changes with the load, or teeth of a gear
- drift-unknown: one or two causes and a body without a sensor, a joint that sticks or has play, or a mount that settles
- drift-slip: two causes, and the sensor of one of them slips by 1.5 to 5 K

A cause shows when it makes, alone, at least the noise (RMS). It is named when one of its names is in the twin, or in a group of at
most three that was told with one, and not as doubtful; on an arm, also by a name that says the same to 0.8 of the squares beside frame and tool. A name is
false when neither it nor its group is a cause or a consequence of one: a lag may be told as one of two stages, or as followed at
once; ``time alone`` is true of what settles and of a body without a sensor; a tipping base and a changed flank are a sag, a cable is
a wave of its joint. Unit of replication: the machine.

Two further tables tell, of all rows together, how often each mechanism was named, and which names were false.

Run: python benchmarks/outside_home.py [--cases N] [--first NUMBER] [--rows arm-full,drift-full,...] [--each] [--short] [--json]
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent / "outside"))

import arm
import drift_log
from exam import MOST_IN_GROUP, Exam, Mark, printed, summed

import dtwin
from dtwin.kinds.registry import kind_named

_KINDS = {"arm": arm.folder, "drift": drift_log.folder}
ROWS = (*(f"{kind}-{row}" for kind in _KINDS for row in ("null", "single", "full", "unknown")), "drift-slip")


class _HomeExam(Exam):
    """An exam by the verbs of a home."""

    def marked(self, row: str, number: int) -> Mark:
        """Return what is said of one machine, and whether it is right."""
        kind, _, stream = row.partition("-")
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            began = time.process_time()
            where = Path(folder) / "campaign"
            where.mkdir()
            name, causes, noise_um = _KINDS[kind](stream, number, where)
            simulated = time.process_time()
            home = dtwin.open_home(Path(folder) / "home")
            warned = set(home.ingest(where).findings.code)
            twins = kind_named(home.runs(name).kind[0]).twins(home.home, None)
            twins.logs = False
            twins.fit(name, [], "t")
            _, told, said = twins.discover("t")
            doubtful = said.as_dict().get("doubtful", [])
            groups = [group for group in _groups(twins.newest("t").labels, told) if group[0] not in doubtful]
            spent = time.process_time() - simulated
        small = {label for group in groups if len(group) <= MOST_IN_GROUP for label in group}
        shown = [cause for cause in causes if cause.um >= noise_um and cause.names]
        true = frozenset().union(*(cause.names | cause.consequences for cause in causes))
        return Mark(
            tuple(map(str, shown)),
            tuple(str(cause) for cause in shown if not cause.names & small),
            tuple(tuple(group) for group in groups if not true & set(group)),
            said.verdict == "unknown_effect",
            ("slip",) * (stream == "slip"),
            ("slip",) * ("drift.sensor_steps" in warned),
            spent,
            simulated - began,
        )


def _groups(labels: Sequence[str], told: Sequence[Sequence[str]]) -> Iterator[list[str]]:
    """Yield the effects of a twin, each with the other effects that were told to explain the same when it was added."""
    for label in labels:
        of = next((group for group in reversed(told) if label in _each(group[0])), [label])
        others = {one.partition("@")[0]: one for family in of[1:] for one in _each(family)}
        others.pop(label.partition("@")[0], None)
        yield [label, *others.values()]


def _each(label: str) -> list[str]:
    """Return the effects of a family: of ``joint_zero@J2+J3`` two."""
    effect, at, where = label.partition("@")
    return [f"{effect}{at}{one}" for one in where.split("+")]


def _summed(row: str, marks: Sequence[Mark]) -> dict[str, Any]:
    """Return one row of the first table: the common one, and slips that were told."""
    return summed(row, marks) | {"slips told": sum(len(mark.left_out) for mark in marks)}


def main() -> None:
    """Print the tables."""
    printed(_HomeExam(lambda *_: None), __doc__, ROWS, ("arm-single", "drift-single"), _summed)


if __name__ == "__main__":
    main()
