"""Numbers as people type them, with a German or an English decimal sign."""

from __future__ import annotations

import math
import re

from dtwin.errors import InputError

_PLAIN = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d{1,3})?")
_GROUPED = re.compile(r"[+-]?\d{1,3}((,\d{3})+(\.\d*)?|(\.\d{3})+(,\d*)?)")
_MOST_CHARACTERS = 40


def decimal(text: str, what: str) -> float:
    """Return the number that a text means; ``0,5`` and ``0.5`` are the same.

    A single comma or point is the decimal sign. When both occur, the last one is, and the
    other one groups thousands, as the same sign twice does.
    """
    plain = re.sub(r"[\s\u00a0\u202f'\u2019]", "", text[: _MOST_CHARACTERS + 1]).replace("\u2212", "-")
    value = math.nan
    if len(plain) <= _MOST_CHARACTERS:
        if _PLAIN.fullmatch(plain):
            value = float(plain.replace(",", "."))
        elif grouped := _GROUPED.fullmatch(plain):
            groups = "," if grouped.group(2) else "."
            value = float(plain.replace(groups, "").replace(",", "."))
    if math.isfinite(value):
        return value
    raise InputError(
        f"{what} is not a number", code="number.invalid", got=text[:_MOST_CHARACTERS], allowed="for example 0.5 or 0,5"
    )
