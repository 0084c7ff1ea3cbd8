"""What changed from one test of a machine to the next, as tables and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.report._recorded import events_words
from dtwin.report.sheet import number_of
from dtwin.report.text import decimals
from dtwin.units import shown_unit


def change_table(changes: Mapping[str, Any]) -> tuple[Sequence[str], list[list[str]]]:
    """Return head and rows of the figures side by side, ``changes`` as ``sheet_changes`` returns it."""
    unit = shown_unit(changes["unit"])
    head = ("figure", "condition", f"before, {unit}", f"now, {unit}", f"difference, {unit} (k = 2)", "said")
    return head, [
        [c["symbol"], c["condition"], *c["shown"], _difference_words(c), c["said"]] for c in changes["figures"]
    ]


def changes_title(changes: Mapping[str, Any]) -> str:
    """Return what is compared, and how much of it changed."""
    counts = ", ".join(f"{number} {said}" for said, number in changes["counts"].items()) or "no figure in common"
    days = " and ".join(day or "no day" for day in changes["days"])
    return f"{changes['campaign']} beside {changes['earlier']} ({days}): {counts}"


def changes_text(changes: Mapping[str, Any]) -> list[str]:
    """Return sentences that stand above the table."""
    lines = [changes_title(changes)]
    if all(changes["days"]):
        between = " and ".join(sorted(changes["days"]))
        lines.append(f"recorded between {between}: {events_words(changes['events']) or 'nothing'}")
    was, now = changes["instruments"]
    if was != now and was and now:
        lines.append(f"measured with {now} instead of {was}: what changed may be the instrument, not the machine")
    elif was != now:
        which = "earlier" if now else "newer"
        lines.append(
            f"measured with {was or now}; the instrument of the {which} test is not stated, and may be another"
        )
    assumed = sorted({source for one in changes["figures"] for source in one["assumed"]})
    if assumed:
        lines.append(
            f"assumed, for nobody stated it: {', '.join(assumed)}; it counts twice before a change is claimed, and nothing is said of a zero that was assumed"
        )
    if changes["alone"]:
        more = f" and {len(changes['alone']) - 6} more" if len(changes["alone"]) > 6 else ""
        lines.append(f"in one of them only: {'; '.join(changes['alone'][:6])}{more}")
    return lines


def _difference_words(figure: Mapping[str, Any]) -> str:
    """Return the difference of a figure with its uncertainty."""
    k2, difference = number_of(figure, "difference_k2"), number_of(figure, "difference")
    if k2 is None:
        return f"{difference:+z.2f}"
    digits = decimals(k2)
    return f"{difference:+z.{digits}f} ± {k2:z.{digits}f}"
