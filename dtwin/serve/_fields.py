"""Strict reading of fields of a bundle: nothing is converted silently."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from dtwin.errors import InputError
from dtwin.units import is_number

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)

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


def record(kind: type[T], data: object, where: str, words: Mapping[str, Sequence[str]] | None = None) -> T:
    """Return a dataclass of text and numbers from a mapping that states each of its fields.

    ``words``: what a field of that name may say.
    """
    given = only_fields(data, [field.name for field in dataclasses.fields(kind)], where)
    fields_read: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        value, place = given[field.name], f"{where}.{field.name}"
        if words and field.name in words:
            fields_read[field.name] = one_of(value, words[field.name], place)
        else:
            fields_read[field.name] = _READERS[str(field.type)](value, place)
    return kind(**fields_read)


def number(value: object, where: str) -> float:
    """Return a finite number."""
    if not is_number(value):
        raise _wrong_type(where, value, "a finite number")
    return float(value)


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
    word = text(value, where)
    if word not in allowed:
        raise _wrong_type(where, value, ", ".join(allowed))
    return word


_READERS: Mapping[str, Callable[[object, str], Any]] = {"str": text, "float": number, "int": whole}


def _wrong_type(where: str, value: object, allowed: str) -> InputError:
    return InputError(f"{where} has an unusable value", code="bundle.value", got=repr(value)[:80], allowed=allowed)
