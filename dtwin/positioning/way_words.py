"""Words and signs that name the side from which a target was approached."""

from __future__ import annotations

import re

IN_BRACKETS = re.compile(r"[\[(]\s*([^\[\]()]*?)\s*[\])]")
_WORDS = {
    "forward": {"fwd", "forward", "forwards", "f", "up", "pos", "positive", "positiv", "plus", "vor", "vorwärts", "hin"}
    | {"aller", "andata", "ida", "正向", "往路", "正方向", "正転"},
    "reverse": {
        "bwd",
        "backward",
        "backwards",
        "b",
        "rev",
        "reverse",
        "r",
        "down",
        "neg",
        "negative",
        "negativ",
        "minus",
    }
    | {"rück", "rückwärts", "zurück", "her"}
    | {"retour", "ritorno", "vuelta", "反向", "復路", "負方向", "逆転"},
}
_FROM = re.compile(r"(?:^|(?<![^\W_])from[\s_]+)(below|above)(?![^\W_])|(?<![^\W_])von[\s_]+(unten|oben)(?![^\W_])")
"""A side; a sensor may be above and below, too, and ``nach unten`` is the other direction."""
SIGNS = {"+": "forward", "↑": "forward", "-": "reverse", "\u2212": "reverse", "↓": "reverse"}


def way_of(text: str, *, ones: bool = False) -> str | None:
    """Return the direction that a head or a cell names, by a word or a sign; None when it names none, or both.

    ``ones``: a bare 1 is forward, as beside -1.
    """
    told = "+1" if ones and text.strip() == "1" else text.strip().lower()
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
