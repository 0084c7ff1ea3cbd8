"""Slides of an outside examiner, who saw no source of dtwin: what is named of them, and what is named falsely?

A slide, a stage or a fast tool is told tones of three to eight frequencies and one to four amplitudes, two to five times. It is followed in
time (``outside/tone_session.py``), shares no code and no formula with dtwin, and is wrong in ways that the examiner
thought of (``outside/tone_faults.py``). Four rows of machines, each diagnosed once, from nothing:

- null: no fault; as in all rows the gain wanders a little, and in half of the machines the zero drifts, by up to four times the noise
- single: one fault
- triple: three faults
- unknown: one or two faults and one thing that no effect describes: a graduation, a bent probe, a cable, a bellows, a piezo that
  remembers, or a drive at its limit

A fault shows when it makes, alone, at least the noise (RMS). It is named when one of its names is in a group of at most four effects:
at one amplitude, or few frequencies, no more is to be told. A name is false when no member of its group is a fault of the slide or a
consequence of one: a mode far above is a delay and a compliance, friction that winds a part up is lost motion. What no effect
describes has no name, and is not asked for; nor is the zero of the probe, which belongs to the set-up. Unit of replication: the machine.

Two further tables tell, of all rows together, how often each mechanism was named, and which names were false.

Run: python benchmarks/outside_tone.py [--cases N] [--first NUMBER] [--rows null,single,triple,unknown] [--each]
     [--short] [--json]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "outside"))

from exam import Case, Exam, effect_of, printed
from tone_session import slide

from dtwin.physics.diagnosis import Suspect

ROWS = ("null", "single", "triple", "unknown")
_MOST_EFFECTS = 4


def machine(row: str, number: int) -> Case:
    """Return a machine of a row."""
    found = slide(row, number)
    return Case(found.campaign, found.runs, found.faults, found.makes_um, found.noise_um)


def _is_small(row: str, group: Sequence[Suspect]) -> bool:
    return len({suspect.effect for suspect in group}) <= _MOST_EFFECTS


def main() -> None:
    """Print the tables."""
    printed(Exam(machine, _is_small, label=effect_of), __doc__, ROWS, short=("null", "single"))


if __name__ == "__main__":
    main()
