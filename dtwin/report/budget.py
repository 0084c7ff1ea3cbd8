"""The error budget of a twin, for people."""

from __future__ import annotations

from dtwin.physics.budget import Budget, Share
from dtwin.report.faults import with_k2
from dtwin.report.html import Table
from dtwin.report.text import micrometres, table


def budget_table(found: Budget, *, in_words: bool = True) -> Table:
    """Return every cause, the largest first, and what is left without all of them; causes ``in_words``, or as commands take them."""
    planes = list(found.shares[0].rms_um)[1:] if found.shares else []
    several = planes if len(planes) > 1 else []
    head = [
        "cause",
        "its own RMS, µm (k = 2)",
        *(f"{p}, µm" for p in several),
        "left without it, µm",
        "largest P-V, µm",
    ]
    rows = [[share.title if in_words else share.label, *_row(share, several)] for share in found.shares]
    nothing = ["-"] * len(several)
    rows.append(["as measured", "-", *nothing, micrometres(found.error_um), micrometres(found.largest_um)])
    left = [micrometres(found.left_um), micrometres(found.left_largest_um)]
    return Table(head, [*rows, ["without all of them", "-", *nothing, *left]])


def unexplained_line(found: Budget) -> str:
    """Return how much of what is left without all causes is none of noise."""
    return (
        f"Of what is left without all of them, repeats agree on {micrometres(found.unexplained_um)} µm RMS: "
        "the twin does not know it."
    )


def budget_text(found: Budget) -> str:
    """Return the budget for the terminal."""
    remedies = [f"{share.label}: {share.remedy}" for share in found.shares]
    shown = budget_table(found, in_words=False)
    return "\n".join([table(shown.head, shown.rows), unexplained_line(found), "", *remedies])


def _row(share: Share, planes: list[str]) -> list[str]:
    own = with_k2(share.rms_um[""], share.uncertainty_um, "um").removesuffix(" µm")
    each = [micrometres(share.rms_um[plane]) for plane in planes]
    return [own, *each, micrometres(share.left_um), micrometres(share.largest_um)]
