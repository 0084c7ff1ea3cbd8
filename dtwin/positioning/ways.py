"""Directions of positioning runs, and which figures of ISO 230-2 a test tells that has less than both, or than two runs;
units and words of axes that move along and of axes that turn.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import ALONG_KIND, Run
from dtwin.units import LENGTHS_MM, UM_PER_MM

IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]*?)\s*[\])]")
_WORDS = {
    "forward": {
        "fwd",
        "forward",
        "forwards",
        "f",
        "up",
        "pos",
        "positive",
        "positiv",
        "plus",
        "vor",
        "vorwärts",
        "hin",
        "hinfahrt",
        "hinweg",
        "aufwärts",
        "steigend",
    }
    | {"aller", "andata", "ida", "positiva", "positivo", "正向", "往路", "正方向", "正転"},
    "reverse": {
        "bwd",
        "backward",
        "backwards",
        "b",
        "rev",
        "reverse",
        "r",
        "down",
        "dn",
        "neg",
        "negative",
        "negativ",
        "minus",
    }
    | {"rück", "rückwärts", "zurück", "her", "rückfahrt", "rückweg", "abwärts", "fallend", "bk", "back", "return"}
    | {"retour", "ritorno", "vuelta", "negativa", "negativo", "反向", "復路", "負方向", "逆転"},
}
_FROM = re.compile(r"(?:^|(?<![^\W_])from[\s_]+)(below|above)(?![^\W_])|(?<![^\W_])von[\s_]+(unten|oben)(?![^\W_])")
"""A side; a sensor may be above and below, too, and ``nach unten`` is the other direction."""
FROM_SIGN = re.compile(
    r"(?<![^\W_])(from|von|aus|da|de|desde|depuis)[\s_]+(the[\s_]+|der[\s_]+)?([+\-\u2212]|(plus|minus|pos\w*|neg\w*)(?![^\W_]))(?!.*(→|->|\bto\b))",
    re.I,
)
"""The side from which a target was approached, or the direction: nobody knows which."""
SIGNS = {"+": "forward", "↑": "forward", "-": "reverse", "\u2212": "reverse", "↓": "reverse"}
_DIGITS = re.compile(r"[+\-\u2212]?[\d.,]+")


def way_of(text: str, *, ones: bool = False) -> str | None:
    """Return the direction that a head or a cell names, by a word or a sign; None when it names none, or both.

    ``ones``: a bare 1 is forward, as beside -1.
    """
    told = "+1" if ones and re.fullmatch(r"1([.,]0+)?", text.strip()) else text.strip().lower()
    if _DIGITS.fullmatch(told):
        # Of a table on its side most heads are numbers.
        return SIGNS.get(told[:1])
    if FROM_SIGN.search(text):
        return None
    words = set(re.findall(r"[^\W\d_]+", told))
    named = {way for way, known in _WORDS.items() if words & known}
    sides = {"forward" if side in ("below", "unten") else "reverse" for side in map("".join, _FROM.findall(told))}
    sure = bool(sides) or any(len(word) > 1 and word in known for word in words for known in _WORDS.values())
    # A unit may stand behind the sign.
    told = IN_BRACKETS.sub(lambda inside: inside[1] if inside[1] in SIGNS else "", told).strip()
    signs = {SIGNS[mark] for mark in (told[:1], told[-1:]) if mark in SIGNS}
    # R of ``R1+`` is a run or a repeat.
    named = named | sides if sure else signs or named
    return named.pop() if len(named) == 1 else None


Ways = tuple[str, str]
BOTH: Ways = ("forward", "reverse")
_NO_SCATTER = "EBM"


def ways_of(run: Run) -> Ways:
    """Return the directions of a run; twice the same of one that has one only."""
    there = sorted(set(map(str, run.samples["direction"])))
    return (there[0], there[-1])


def can_be_told(symbol: str, ways: Ways, runs: int) -> bool:
    """Tell whether runs in these directions have a figure: one run has no repeatability, one direction no reversal."""
    if ways != BOTH and not symbol.endswith("↑" if ways[0] == "forward" else "↓"):
        return False
    return runs > 1 or symbol[0] in _NO_SCATTER


def with_ways(run: Run) -> Run:
    """Return a run whose directions are called ``forward`` and ``reverse``; refuse others."""
    ways = {d: way_of(str(d), ones=True) for d in set(run.samples["direction"])}
    unknown = sorted(str(d) for d, way in ways.items() if way is None)
    if unknown:
        raise InputError(
            "a reading does not say from which side its target was approached",
            code=f"{run.meta.kind}.direction",
            where=f"{run.source} direction",
            got=", ".join(unknown)[:80],
            allowed=", ".join(BOTH),
        )
    if any(d != way for d, way in ways.items()):
        told = np.array([ways[d] for d in run.samples["direction"]], dtype=object)
        run = replace(run, samples={**run.samples, "direction": told})
    return run


@dataclass(frozen=True)
class Scale:
    """In which units targets and deviations of an axis are told.

    ``kind``: kind of the runs; codes of findings begin with it.
    ``position``, ``error``, ``read``: columns of samples: targets, deviations, and what was read where that was a
    position.
    ``unit``, ``fine``: units of targets and of deviations, as people read them.
    ``figure``: unit of deviations, as names of columns end.
    ``per``: how many of ``fine`` one of ``unit`` is.
    ``units``: how many of ``unit`` each unit of a table is.
    ``largest``, ``longest``: beyond which a deviation (``fine``), or a travel (``unit``), is in another unit than it
    seems to be.
    ``allowed``, ``elsewhere``: units that are usual in tables; what to do with a table that is in others.
    ``turn``: after how many of ``unit`` the axis is at the same place again; 0 where it is not.
    ``stretch``: what a machine that is one kelvin warmer stretches by, ``fine`` in 1000 of ``unit``; 0 where heat
    stretches nothing.
    """

    kind: str
    position: str
    error: str
    read: str
    unit: str
    fine: str
    figure: str
    per: float
    units: Mapping[str, float]
    largest: float
    longest: float
    allowed: str
    elsewhere: str
    turn: float = 0.0
    stretch: float = 0.0

    def factor(self, unit: str) -> float:
        """Return how many of ``unit`` a unit of a table is: 1 where it is empty, NaN where it is not known."""
        return self.units.get(unit, float("nan")) if unit else 1.0


LENGTHS = Scale(
    kind=ALONG_KIND,
    position="position_mm",
    error="error_um",
    read="read_mm",
    unit="mm",
    fine="µm",
    figure="um",
    per=UM_PER_MM,
    units=LENGTHS_MM,
    largest=5_000.0,
    longest=1e5,
    allowed="mm, µm, nm, m, cm, in, mil, µin",
    elsewhere="a table of angles is one of a rotary axis: --kind rotary --axis C; where the axis is a linear one of this name, write [mm] into the heads; pitch and yaw of one are not read",
    stretch=11.5,
)
