"""Checks of what a campaign file or an amendment states: bad values are told with their place."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import date, datetime
from itertools import takewhile
from typing import Any

from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.local_time import was_set
from dtwin.units import is_number, require_units, shown_number

_DEEPEST = 6
_COLDEST_C = -273.15
_LONGEST = 400
_AXIS = re.compile(r"[a-cu-z]\d?")
_BY_DAY = re.compile(r"\d{4}-\d\d-\d\d")
OF_EVERY_KIND = {
    "instrument": (
        "model serial certificate calibrated_on operator calibrator_temperature_c sample_rate_hz columns tolerances "
        "uncertainty_um uncertainty_arcsec uncertainty_um_per_m uncertainty_percent temperature_uncertainty_k "
        "expansion_um_per_m_k expansion_uncertainty_um_per_m_k"
    ),
    "machine_geometry": "type chain controller tcp_mm virtual hidden truth corrected correction_delay_s",
    "condition": "axis test instrument chain time_h feed_mm_min",
}
"""What is read of tables in which everything may be noted, whatever is measured."""
_OTHER_UNIT = re.compile(r"_(mm|um|m|in|inch|deg|rad|s|ms|hz|rpm|k|c|arcsec|percent|pct|mm_min|h|min)$")
_SHORT = 5
"""Letters below which words that differ in one letter are other words; two that changed places are mistyped in any."""
_CORRECTION = re.compile(r"([0-9a-f]{64}|mixed)?")


def _number(value: object, name: str, where: str) -> float:
    """Return a finite number; truth values and text are none."""
    if is_number(value):
        return float(value)
    raise _refused(name, where, value, "a finite number")


def positive(value: object, name: str, where: str) -> float:
    """Return a number from a millionth to 10 million: of smaller and larger ones nothing could be computed."""
    number = _number(value, name, where)
    if 1e-6 <= number <= 1e7:
        return number
    raise _refused(name, where, value, "a number from 0.000001 to 10 million")


def count(value: object, name: str, where: str) -> int:
    """Return a whole number from 1 to a million."""
    if isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 1_000_000:
        return value
    raise _refused(name, where, value, "a whole number from 1")


def iso_time(value: object, name: str, where: str) -> str:
    """Return a time as ISO 8601 text that begins with its day, empty when none is stated."""
    if value == "":
        return ""
    try:
        told = value if isinstance(value, datetime | date) else datetime.fromisoformat(str(value))
        if was_set(told):
            return str(value) if isinstance(value, str) and _BY_DAY.match(value) else told.isoformat()
    except ValueError:
        pass
    raise _refused(name, where, value, "a time such as 2026-03-02T08:00:00Z, after 1980 and of no far year")


def covariates(value: object, where: str) -> dict[str, float]:
    """Return numbers that were logged once for a run; each name ends with its unit."""
    if not isinstance(value, Mapping):
        raise _refused("covariates", where, value, "a table of numbers")
    require_units(value, where)
    told = {name: _number(v, f"covariates.{name}", where) for name, v in value.items()}
    for name, number in told.items():
        if name.endswith("_c") and number < _COLDEST_C:
            raise _refused(f"covariates.{name}", where, number, f"a temperature in °C, above {_COLDEST_C:g}")
    return told


def condition(value: object, kind: Kind, where: str) -> dict[str, float | str]:
    """Return what was set for a run: numbers and words by name; ``axis = "c"`` is C, with which it is compared."""
    if not isinstance(value, Mapping):
        raise _refused("condition", where, value, "a table of numbers and words")
    _require_as_read(value, "condition", kind, where)
    return {
        name: v.upper()
        if name == "axis" and isinstance(v, str) and _AXIS.fullmatch(v)
        else v
        if isinstance(v, str) and len(v) <= _LONGEST
        else v
        if isinstance(v, int) and not isinstance(v, bool) and abs(v) < 2**53
        else _number(v, f"condition.{name}", where)
        for name, v in value.items()
    }


def correction(value: object, name: str, where: str) -> str:
    """Return the checksum of a model that was served, ``mixed``, or nothing."""
    if isinstance(value, str) and _CORRECTION.fullmatch(value):
        return value
    raise _refused(name, where, value, "64 hexadecimal digits, as dtwin record writes them")


def table(value: object, name: str, kind: Kind, where: str) -> dict[str, Any]:
    """Return a table whose numbers are finite and that is not nested too deep."""
    if not isinstance(value, Mapping):
        raise _refused(name, where, value, "a table")
    _require_as_read(value, name, kind, where)
    for key, part in value.items():
        _plain(part, f"{name}.{key}", where, _DEEPEST)
    return dict(value)


def instrument(value: object, kind: Kind, where: str) -> dict[str, Any]:
    """Return the table of an instrument; its ``columns`` name the house's column for heads of the file."""
    told = table(value, "campaign.instrument", kind, where)
    columns = told.get("columns", {})
    if not isinstance(columns, Mapping) or not all(isinstance(name, str) for name in columns.values()):
        raise _refused("campaign.instrument.columns", where, columns, "a table of names by head")
    if "calibrated_on" in told:
        # It stands on a document that somebody signs.
        told["calibrated_on"] = iso_time(told["calibrated_on"], "campaign.instrument.calibrated_on", where)[:10]
    return told


def _require_as_read(told: Mapping[str, Any], name: str, kind: Kind, where: str) -> None:
    """Refuse a name that is nearly one that is read: it would do nothing; and words where a unit is read. Other names are notes, which are free."""
    table = name.rpartition(".")[2]
    own = (setting.split(".") for setting in kind.settings)
    known = {*OF_EVERY_KIND.get(table, "").split(), *(setting for where_read, setting in own if where_read == table)}
    for key in sorted(set(told) & known):
        if isinstance(told[key], str) and _OTHER_UNIT.search(key):
            raise _refused(f"{name}.{key}", where, told[key], "a number")
    for key in sorted(set(told) - known):
        meant = [
            word
            for word in known
            # What is set for a run may be one thing in one unit and another one in another: speed_rpm, speed_mm_s.
            if (table != "condition" if _stem(key) == _stem(word) else _mistyped(key, word))
        ]
        if meant:
            raise InputError(
                f"unknown setting of {table}, nearly one that is read",
                code="campaign.setting",
                where=f"{where} {name}",
                got=key[:60],
                allowed=", ".join(sorted(known)),
                hint=f"{table}.{min(meant)}; a note of your own needs a name that is less like it",
            )


def _mistyped(key: str, word: str) -> bool:
    """Return whether a name differs from a word by capitals, dashes, one letter, or two that changed places."""
    told = re.sub(r"[-. ]", "_", key.lower())
    if told == word:
        return True
    begin = _alike(told, word)
    end = _alike(told[begin:][::-1], word[begin:][::-1])
    one, other = told[begin : len(told) - end], word[begin : len(word) - end]
    if len(one) == 2 and one == other[::-1]:
        return True
    return max(len(one), len(other)) == 1 and min(len(told), len(word)) >= _SHORT


def _alike(one: str, other: str) -> int:
    """Return how many letters two words begin with alike."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(one, other, strict=False)))


def _stem(name: str) -> str:
    return _OTHER_UNIT.sub("", name)


def _plain(value: object, name: str, where: str, deepest: int) -> None:
    if isinstance(value, float | int) and not isinstance(value, bool):
        _number(value, name, where)
    elif isinstance(value, Mapping | list) and deepest:
        parts = value.items() if isinstance(value, Mapping) else enumerate(value)
        for key, part in parts:
            _plain(part, f"{name}.{key}", where, deepest - 1)
    elif not isinstance(value, str | bool | datetime | date):
        raise _refused(name, where, value, "numbers, words, lists and tables")


def _refused(name: str, where: str, value: object, allowed: str) -> InputError:
    shown = shown_number(value) if isinstance(value, float) and math.isfinite(value) else repr(value)
    return InputError(f"{name} is not usable", code="campaign.value", where=where, got=shown[:60], allowed=allowed)
