"""The error budget of a twin, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from dtwin.physics.budget import Budget, Share
from dtwin.report.faults import AS_ZERO, with_k2
from dtwin.report.html import Table
from dtwin.report.text import micrometres, table

SURE = (
    "± is k = 2: of a cause from the uncertainties of its parameters, taken as uncorrelated; of what is left also from what "
    "repeats differ by (unit of replication: the run). P-V has none: it is the largest of many differences, and noise makes it larger."
)
"""What the uncertainties of a budget are of."""


class _Spread(Protocol):
    """How sure the figures are, k = 2, as ``BudgetSpread`` has it."""

    @property
    def parts(self) -> Mapping[str, Mapping[str, float]]: ...
    @property
    def left(self) -> Mapping[str, float]: ...
    @property
    def error(self) -> float: ...
    @property
    def left_of_all(self) -> float: ...


def budget_table(budget: Budget, spread: _Spread, *, in_words: bool = True) -> Table:
    """Return every cause, the largest first, and what is left without all of them; causes ``in_words``, or as commands take them."""
    planes = list(budget.shares[0].rms_um)[1:] if budget.shares else []
    several = planes if len(planes) > 1 else []
    head = ["cause", "its own RMS, µm", *(f"{p}, µm" for p in several), "left without it, µm", "largest P-V, µm"]
    rows = [[share.title if in_words else share.label, *_row(share, spread, several)] for share in budget.shares]
    nothing = ["-"] * len(several)
    rows.append(["as measured", "-", *nothing, _sure(budget.error_um, spread.error), micrometres(budget.largest_um)])
    left = [_sure(budget.left_um, spread.left_of_all), micrometres(budget.left_largest_um)]
    return Table(head, [*rows, ["without all of them", "-", *nothing, *left]])


def unexplained_line(budget: Budget) -> str:
    """Return how much of what is left without all causes is none of noise."""
    return (
        f"Of what is left without all of them, repeats agree on {micrometres(budget.unexplained_um)} µm RMS: "
        "the twin does not know it."
    )


def remedies(budget: Budget, *, in_words: bool = True) -> list[tuple[str, str]]:
    """Return what to do about each cause; what may be nothing at all is not mended. Causes as in :func:`budget_table`."""
    return [
        (
            share.title if in_words else share.label,
            AS_ZERO if share.rms_um[""] <= share.uncertainty_um else share.remedy,
        )
        for share in budget.shares
    ]


def budget_text(budget: Budget, spread: _Spread) -> str:
    """Return the budget for the terminal."""
    told = [f"{label}: {remedy}" for label, remedy in remedies(budget, in_words=False)]
    shown = budget_table(budget, spread, in_words=False)
    return "\n".join([table(shown.head, shown.rows), unexplained_line(budget), SURE, "", *told])


def _row(share: Share, spread: _Spread, planes: list[str]) -> list[str]:
    each = [_sure(share.rms_um[plane], spread.parts[share.label][plane]) for plane in planes]
    own, left = _sure(share.rms_um[""], share.uncertainty_um), _sure(share.left_um, spread.left[share.label])
    return [own, *each, left, micrometres(share.largest_um)]


def _sure(value_um: float, k2_um: float) -> str:
    return with_k2(value_um, k2_um, "um").removesuffix(" µm")
