"""Strict reading of fields of a bundle: nothing is converted silently."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from dtwin.errors import InputError

_MAX_TEXT = 4000


def only_fields(data: object, names: Sequence[str], where: str) -> dict[str, Any]:
    """Return a mapping that has exactly these fields.

    Raises ``InputError`` when fields are missing or unknown, or it is no mapping.
    """
    if not isinstance(data, dict):
        raise InputError(f"{where} is not a mapping", code="bundle.type", got=type(data).__name__)
    differs = set(map(str, data)) ^ set(names)
    if differs:
        raise InputError(
            f"{where} has missing or unknown fields",
            code="bundle.fields",
            got=", ".join(sorted(differs))[:200],
            allowed=", ".join(names),
        )
    return data


def number(value: object, where: str) -> float:
    """Return a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong_type(where, value, "a number")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise _wrong_type(where, value, "a finite number")
    return result


def whole(value: object, where: str) -> int:
    """Return a whole number."""
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) > 2**53:
        raise _wrong_type(where, value, "a whole number")
    return value


def text(value: object, where: str) -> str:
    """Return text of bounded length."""
    if not isinstance(value, str) or len(value) > _MAX_TEXT:
        raise _wrong_type(where, value, f"text of at most {_MAX_TEXT} characters")
    return value


def one_of(value: object, allowed: Sequence[str], where: str) -> str:
    """Return text that is one of a few."""
    found = text(value, where)
    if found not in allowed:
        raise _wrong_type(where, value, ", ".join(allowed))
    return found


def _wrong_type(where: str, value: object, allowed: str) -> InputError:
    return InputError(f"{where} has an unusable value", code="bundle.value", got=repr(value)[:80], allowed=allowed)
