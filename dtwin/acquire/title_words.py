"""What the titles above a table tell of all that is below: another sign, and a unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dtwin.errors import InputError
from dtwin.units import with_shares

_INWARD = r"inwards?|inside|smaller( radius)?|(nach )?innen|kleiner\w*( radius)?"
# Beside words alone it may be what a title is about: machine - laser test.
_SHOWN_LESS_MEASURED = r"(machine|controller|encoder|scale|dro|display|maschine|steuerung|geber|ma(ß|ss)stab)\s*([-\u2212\u2013]|minus)\s*(laser|interferomet\w+|reference|referenz)"
REVERSED = re.compile(
    r"(nominale?|target|command(ed)?|cmd|demand(ed)?|set ?point|soll\w*|ziel|cible|consigne|objetivo|obiettivo|theor\w+|指令|目標)\s*([-\u2212\u2013]|minus|moins|meno|menos)\s*(act(ual)?\b|meas(ured)?\b|ist|mesur|misur|medid|real|réel|reading|laser|interferomet|測定|実測)(?!\w*[\s-]*(vergleich|abgleich|compar))"
    rf"|[=:(]\s*{_SHOWN_LESS_MEASURED}|(?<![^\W_]){_SHOWN_LESS_MEASURED}[^\[(]*[\[(]\s*([num\u00b5\u03bc]?m|mil|in(ch(es)?)?)\s*[\])]"
    rf"|({_INWARD})\W*(is|are|ist|=)?\W*positiv|positiv\w*\W*(is|means|ist|bedeutet|=)?\W*({_INWARD})"
    r"|\b(sign|vorzeichen)(?![^\W_])\W*(convention\W*)?(is |ist )?(invert|revers|negat|opposite|flipped|umgekehrt|gedreht)|(?<![^\W_])(inverted|invertiert|negated)(?![^\W_])",
    re.I,
)
"""Title or head of errors whose sign is the opposite of everywhere else."""
_UNIT_ABOVE = re.compile(r"(?:units?|einheit(?:en)?|unités?|unità|unidad(?:es)?|単位|单位)\W*(\S+)", re.I)
_UNIT_NAMED = re.compile(
    r"\b(inch(es)?|zoll|pouces?|pollici|pulgadas?|imperial|(tenth|hundredth)mm|gon|radians?|radiant|bogenminuten|(?<=\bin )met(er|re)s)\b|(?<=[(\[])in(?=[)\]])",
    re.I,
)
"""Of a title that tells the unit of a table beside other words."""


def unit_of_titles(rows: Sequence[Sequence[str]]) -> str:
    """Return the unit that a title such as ``Unit: inch`` tells of what is below; empty where none does."""
    told = (_UNIT_ABOVE.fullmatch(" ".join(cell.strip() for cell in row if cell.strip())) for row in rows)
    return next((match[1] for match in told if match is not None), "")


def named_unit(rows: Sequence[Sequence[str]]) -> str:
    """Return the unit that titles tell, also beside other words, as ``all values in inches``; empty where none does."""
    titles = (" ".join(row) for row in rows if sum(map(bool, row)) <= 2)
    named = (_UNIT_NAMED.search(with_shares(title)) for title in titles)
    return unit_of_titles(rows) or next((match[0] for match in named if match), "")


def require_usual_sign(rows: Sequence[Sequence[str]], path: Path) -> None:
    """Refuse titles and heads which say that errors are nominal minus actual."""
    opposite = next((text for row in rows if REVERSED.search(text := " ".join(row).strip())), "")
    if opposite:
        raise InputError(
            "errors are target minus actual: their sign is the opposite of everywhere else",
            code="table.sign",
            where=str(path),
            got=opposite[:60],
            allowed="actual minus target",
            hint="change the sign of the errors, and say so in the title",
        )
