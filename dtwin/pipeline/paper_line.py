"""One figure of a source beside ours."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Line:
    """One comparison.

    Attributes
    ----------
    target : str
        Number in the acceptance list, empty for what is no target.
    what, paper, ours : str
        The figure, theirs, ours.
    follows : bool or None
        None when it cannot be judged.
    """

    target: str
    what: str
    paper: str
    ours: str
    follows: bool | None
