"""What is known of a twin's correction before it has moved anything."""

from __future__ import annotations

from dataclasses import dataclass

from dtwin.train.results import Candidate

NAME = "twin-correction"


@dataclass(frozen=True)
class Judged:
    """A twin's bundle with the figures that its gates read.

    ``candidate``: with scores on what was left out.
    ``noise_floor_um``: what repeats disagree by.
    ``conditions``: what was measured: a name or plane, and two numbers.
    """

    candidate: Candidate
    noise_floor_um: float
    rms_before_um: float
    conditions: tuple[tuple[str, float, float], ...]
