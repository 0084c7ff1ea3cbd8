"""Readings of a positioning test by target, direction and run; directions that a table does not name, by the order of its targets."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.linear import linear_figures
from dtwin.positioning.ways import LENGTHS, Scale
from dtwin.schema import Floats, Run
from dtwin.units import is_number

TARGET_MM = 1e-3
"""Positions closer than this, mm or degrees, are one target."""


@dataclass(frozen=True)
class LinearTest:
    """Readings of a bidirectional test in matrices; of an axis that turns in degrees and seconds of arc, as ``scale`` says.

    ``position_mm`` (targets,): targets that were read in both directions in every run, ascending.
    ``forward_um``, ``reverse_um`` (targets, runs): errors.
    ``left_out``: targets that some run missed.
    ``pitch_mm``: travel in one turn of the screw; 0 on an axis with a linear scale, None where it is not stated.
    ``first``: direction that each run began with; empty where the clock is assumed, or there is none.
    ``ways``: directions of both matrices; twice the same of runs that have one only.
    ``repeats``: what the runs are called; empty where they are counted.
    """

    position_mm: Floats
    forward_um: Floats
    reverse_um: Floats
    left_out: int
    pitch_mm: float | None
    axis: str = "Z"
    first: str = "forward"
    ways: tuple[str, str] = ("forward", "reverse")
    repeats: tuple[int, ...] = ()
    scale: Scale = LENGTHS

    def cycle(self, index: int) -> int:
        """Return the number of a cycle, from 0, as people know it: its repeat, also where others were left out."""
        return self.repeats[index] if self.repeats else index + 1


def linear_test(
    runs: Sequence[Run], ways: tuple[str, str] = ("forward", "reverse"), scale: Scale = LENGTHS
) -> LinearTest:
    """Put the readings of runs into matrices, in the order of the runs' times and repeats.

    ``ways``: of both matrices; twice the same of runs in one direction only.
    """
    runs = in_order(runs)
    columns = [_by_target(run, way, scale) for way in ways for run in runs]
    anywhere, times = np.unique(np.concatenate([numbers for numbers, _ in columns]), return_counts=True)
    targets = anywhere[times == len(columns)]
    matrix = np.stack([errors[np.isin(numbers, targets, assume_unique=True)] for numbers, errors in columns], axis=1)
    pitch = runs[0].meta.condition.get("screw_pitch_mm")
    repeats = tuple(run.meta.repeat for run in runs)
    return LinearTest(
        position_mm=targets * TARGET_MM,
        forward_um=matrix[:, : len(runs)],
        reverse_um=matrix[:, len(runs) :],
        left_out=len(anywhere) - len(targets),
        pitch_mm=float(pitch) if is_number(pitch) else None,
        axis=str(runs[0].meta.condition.get("axis", "Z")),
        first=_first(runs),
        ways=ways,
        repeats=repeats if len(set(repeats)) == len(repeats) else (),
        scale=scale,
    )


def in_order(runs: Sequence[Run]) -> list[Run]:
    """Return runs in the order of their times and repeats; by their names the tenth comes before the second."""
    return sorted(runs, key=lambda run: (run.meta.started or "", run.meta.setup, run.meta.repeat))


def clock_is_assumed(runs: Sequence[Run]) -> bool:
    """Return whether the times of readings are not those at which they were taken."""
    return any(finding.code == "clock.assumed" for run in runs for finding in run.findings)


def _first(runs: Sequence[Run]) -> str:
    if clock_is_assumed(runs) or any("t_s" not in run.samples for run in runs):
        return ""
    begun = {str(run.samples["direction"][np.argmin(run.samples["t_s"])]) for run in runs if run.samples["t_s"].size}
    return begun.pop() if len(begun) == 1 else ""


def _by_target(run: Run, way: str, scale: Scale) -> tuple[Floats, Floats]:
    """Return the whole numbers of targets, ascending, and the last error that was read at each."""
    chosen = run.samples["direction"] == way
    # Of a position that no machine has, there is no integer; no zero is below zero.
    numbers = np.round(run.samples[scale.position][chosen].astype(float) / TARGET_MM) + 0.0
    unique, last = np.unique(numbers[::-1], return_index=True)
    return unique, np.asarray(run.samples[scale.error][chosen][::-1][last], dtype=float)


def other_formulas_um(forward_um: Floats, reverse_um: Floats) -> dict[str, float]:
    """Return R and E, µm, by formulas that some reports use instead of the standard's.

    R as the larger of R↑ and R↓; E of the means' span above the higher of both minima.
    """
    told = linear_figures(forward_um, reverse_um)
    up, down = forward_um.mean(axis=1), reverse_um.mean(axis=1)
    return {
        "R": max(told.repeatability_forward_um, told.repeatability_backward_um),
        "E": float(max(up.max(), down.max()) - max(up.min(), down.min())),
    }


_FEWEST = 2
"""Readings of a sweep."""
_SENSE = re.compile(r"(?<![^\W_])c?cw(?![^\W\d_])|(counter|anti)?-?clockwise|(im|gegen(\s+den)?)\s+uhrzeigersinn", re.I)


def ways_in_order(target_mm: Sequence[float]) -> list[str] | None:
    """Return the direction of each reading; None where the order does not tell it.

    Targets that begin anew after the last one were all approached from one side: the way back was not read.
    """
    if len(set(target_mm)) < _FEWEST:
        return None
    pieces = sweeps(np.array(target_mm, dtype=float))
    long = {sign for piece, sign in pieces if piece.stop - piece.start >= _FEWEST}
    begun_anew = [sign for piece, sign in pieces if piece.stop - piece.start < _FEWEST]
    if len(long) == 1 and len(set(target_mm)) > _FEWEST and set(begun_anew) <= {-sign for sign in long}:
        # Each single reading is the first of the sweep after it.
        one = "forward" if long == {1} else "reverse"
        last = pieces[-1][0]
        return None if begun_anew and last.stop - last.start < _FEWEST else [one] * len(target_mm)
    if begun_anew:
        return None
    return ["forward" if sign > 0 else "reverse" for piece, sign in pieces for _ in range(piece.start, piece.stop)]


def names_sense(cell: str) -> bool:
    """Return whether a head or a cell names a sense of turning, which is no direction: CW, CCW."""
    return _SENSE.search(cell) is not None


def no_direction(path: Path, got: str, allowed: str) -> InputError:
    """Return the refusal of a table whose directions nothing tells."""
    sense = "; which of CW and CCW is positive depends on from where one looks, and nothing tells that"
    return InputError(
        "the table does not say from which side its targets were approached" + sense * names_sense(got),
        code="position_table.direction",
        where=str(path),
        got=got[:80],
        allowed=allowed,
        hint="docs/how-to/positioning-table.md",
    )


def sweeps(position: Floats) -> list[tuple[slice, int]]:
    """Part successive targets into sweeps of one direction.

    At a turn the same target is read twice, from one side and from the other; where one of the
    two is missing, the other belongs to the sweep before.

    ``position``, (n,): targets in the order of measurement.
    Rows of each sweep, and +1 or -1 for its direction.
    """
    pieces: list[tuple[slice, int]] = []
    begun, sign = 0, 0
    for i, step in enumerate(np.sign(np.diff(position)).astype(int).tolist()):
        if step == 0 or (sign and step != sign):
            pieces.append((slice(begun, i + 1), sign or _other(pieces)))
            begun, sign = i + 1, step
        else:
            sign = step
    pieces.append((slice(begun, len(position)), sign or _other(pieces)))
    return pieces


def _other(pieces: list[tuple[slice, int]]) -> int:
    return -pieces[-1][1] if pieces else 1
