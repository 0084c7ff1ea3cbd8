"""Tables and numbers for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise, zip_longest
from typing import TYPE_CHECKING, Any

from dtwin.units import shown_number, shown_unit

if TYPE_CHECKING:
    from dtwin.physics.effect import Effect

_NANOMETRES = 0.1
_LISTED = 3
WIDE = 60
"""Letters of a cell of names or sizes, of which there may be many."""
VERDICTS = {
    "missing_effect": "An effect is missing",
    "ambiguous": "Several effects would explain it",
    "unknown_effect": "There is structure that no known effect explains",
    "nothing_missing": "Nothing is missing",
    "need_repeats": "Repeats are needed",
    "variance_effect": "The spread depends on the condition",
}
"""What each verdict of a diagnosis says, for people."""


def table(head: Sequence[str], rows: Sequence[Sequence[object]], widest: int = 0) -> str:
    """Return an aligned table; numbers to the right, floats with up to four significant places.

    ``widest``: letters of a cell, from which on it goes on in the next line after a semicolon; 0 for no limit.
    """
    cells = [list(line) for row in rows for line in zip_longest(*(_lines(_cell(v), widest) for v in row), fillvalue="")]
    widths = [max(len(title), *(len(row[i]) for row in cells)) if cells else len(title) for i, title in enumerate(head)]
    right = [all(isinstance(row[i], int | float) or row[i] is None for row in rows) for i in range(len(head))]

    def line(row: Sequence[str]) -> str:
        padded = (text.rjust(w) if r else text.ljust(w) for text, w, r in zip(row, widths, right, strict=True))
        return "  ".join(padded).rstrip()

    return "\n".join([line(head), line(["-" * w for w in widths]), *map(line, cells)])


def _lines(cell: str, widest: int) -> list[str]:
    """Return a cell as lines that end after a semicolon before they get wider than so many letters; one of a cell without."""
    lines = [""]
    for part in cell.split("; ") if widest else [cell]:
        if lines[-1] and len(lines[-1]) + len(part) > widest:
            lines[-1] += ";"
            lines.append(part)
        else:
            lines[-1] += "; " * bool(lines[-1]) + part
    return lines


def listed(names: Sequence[str], between: str = ", ") -> str:
    """Return names for people: three at most, and how many more there are."""
    more = len(names) - _LISTED
    last = between.replace(", ", " and ").replace("; ", "; and ")
    return between.join(names[:_LISTED]) + f"{last}{more} more" * (more > 0)


def _cell(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "-"
        return shown_number(value, 4) if abs(value) < 1e5 else f"{value:z.3e}"
    # A line end in what somebody wrote would make lines of the table that say something else.
    return " ".join(str(value).splitlines())


def effect_text(effect: Effect) -> str:
    """Return what an effect is, for the terminal."""
    law = effect.law
    exponents = [
        f"feed^{law.feed:g}" if law.feed is not None else "feed: no power law",
        f"radius^{law.radius:g}" if law.radius is not None else "radius: no power law",
        f"{law.direction} in direction",
    ]
    parameters = ", ".join(f"{p.name} ({shown_unit(p.unit)})" for p in effect.parameters)
    shapes = ", ".join(f"{s.name} ({shown_unit(s.unit)})" for s in effect.shapes)
    lines = [
        f"{effect.name}: {effect.title}",
        effect.meaning,
        f"looks like: {effect.looks_like}",
        f"formula: {effect.formula}",
        f"scaling: {', '.join(exponents)}",
        f"parameters: {parameters}" + (f"; shape: {shapes}" if shapes else ""),
        f"one for each: {effect.per.replace('_', ' ')}",
        f"group: {effect.group}" if effect.group else "",
        f"needs: {', '.join(effect.needs)}" if effect.needs else "",
        f"confused with: {', '.join(effect.confusables)}" if effect.confusables else "",
        f"told apart by: {effect.separate_by}",
        f"remedy: {effect.remedy}",
        f"correction: {effect.correctable or 'cannot be corrected by offsets of position'}",
        f"reference: {effect.reference}",
        f"from: {effect.source}" if effect.source != "dtwin" else "",
    ]
    return "\n".join(line for line in lines if line)


def words_of(name: str) -> str:
    """Return a name that commands take as people write it: ``Joint zero`` for ``joint_zero``."""
    return name.replace("_", " ").capitalize()


def counted(number: int, what: str) -> str:
    """Return how many there are: ``1 run``, ``2 runs``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def classes(histogram: Mapping[str, int]) -> list[str]:
    """Return the classes of a histogram as people read them; its names are ``<10``, ``<20`` … and ``>=20`` for the rest."""
    if not all(name.lstrip("<>=").isdecimal() for name in histogram):
        # A log that somebody changed.
        return list(histogram)
    below = [0, *(int(name.removeprefix("<")) for name in histogram if name.startswith("<"))]
    told = [f"{low:,} to {high:,}".replace(",", " ") for low, high in pairwise(below)]
    return [*told, *(f"over {int(name[2:]):,}".replace(",", " ") for name in histogram if name.startswith(">="))]


def micrometres(value: float | None) -> str:
    """Return micrometres for people: two decimals, below a tenth three digits that count."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:z.2f}" if abs(value) >= _NANOMETRES or value == 0.0 else shown_number(value)


def gain_words(gain: float) -> str:
    """Return a relative gain in %; worse than -100 % no number says more."""
    return f"{100.0 * gain:z.1f} %" if gain >= -1.0 else "< -100 %"


def circle_figure(title: str, value: float | None) -> str:
    """Return a figure of a circle to a tenth of a micrometre, or of a mm/min; ``title`` ends with its unit; absent ones as a dash."""
    return "-" if value is None else f"{value:z.{4 if title.endswith(', mm') else 1}f}"


def decimals(uncertainty: float) -> int:
    """Return the digits after the point that show two digits of an uncertainty; two when it is not known."""
    if not math.isfinite(uncertainty) or uncertainty <= 0:
        return 2
    return min(max(1 - math.floor(math.log10(uncertainty)), 0), 4)


_BOUNDS = {"low": "≥", "high": "≤"}


def series_cells(one: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a figure of a machine over time: name, state, level, noise floor, since when, its limit, and when that is reached."""
    crossing, unit = one["crossing"], one["unit"]
    bounds = [f"{sign} {shown_number(one[side], 6)}" for side, sign in _BOUNDS.items() if one[side] is not None]
    ahead = f"{', '.join(bounds)} {unit}" if bounds else "-"
    if crossing:
        limit = f"{shown_number(crossing['limit'], 6)} {unit}"
        ahead = f"reaches {limit} between {crossing['earliest']} and {crossing['latest']}"
    floor = f"{one['floor']} {unit}" if one["floor"] else "not known"
    return one["name"], one["state"], f"{one['level']} {unit}", floor, one["since"], ahead
