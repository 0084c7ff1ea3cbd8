"""One figure of a source beside ours, and the answer to whether it comes out here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, get_args

Answer = Literal["follows", "does not", "easier here", "calibrated", "not judged"]
ANSWERS: tuple[Answer, ...] = get_args(Answer)
# What is left (of an error, of a variance) agrees when it lies within this factor of theirs.
FACTOR = 1.5
_WORST_FIRST: tuple[Answer, ...] = ("does not", "follows", "easier here")


@dataclass(frozen=True)
class Line:
    """One comparison.

    ``what``, ``paper``, ``ours``: the figure, theirs, ours.
    ``answer``, follows or does not or easier here or calibrated or not judged: ``easier here``: better than theirs by
    more than the tolerance. ``calibrated``: agrees, and constants were set so that it does. ``not judged``: not the
    same quantity, or too little was computed.
    ``target``: number in the acceptance list, empty for what is no target.
    """

    what: str
    paper: str
    ours: str
    answer: Answer
    target: str = ""


def yes_or_no(agrees: object) -> Answer:
    """Return the answer to a claim that is either met or not."""
    return "follows" if agrees else "does not"


def calibrated(agrees: object) -> Answer:
    """Return the answer for a figure that constants were set by."""
    return "calibrated" if agrees else "does not"


def by_what_is_left(ours: float, theirs: float) -> Answer:
    """Return the answer for a figure of which less is better.

    ``ours``, ``theirs``: what is left of an error or of a variance, in the same unit; ``theirs`` positive.
    """
    if ours > FACTOR * theirs:
        return "does not"
    return "follows" if FACTOR * ours >= theirs else "easier here"


def worst(answers: Iterable[Answer]) -> Answer:
    """Return the answer for a line of several judged figures: that of the worst of them."""
    return min(answers, key=_WORST_FIRST.index)


def left_open(lines: Iterable[Line], targets: Iterable[str] | None = None) -> list[Line]:
    """Return lines with those not judged for which too little was computed.

    ``lines``: comparisons.
    ``targets``: numbers of those lines; all without.
    """
    open_ = None if targets is None else set(targets)
    return [replace(line, answer="not judged") if open_ is None or line.target in open_ else line for line in lines]
