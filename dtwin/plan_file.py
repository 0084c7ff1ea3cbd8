"""A plan file, read once whatever kind of campaign it plans."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dtwin.atomic import read_toml
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind, Planned
from dtwin.kinds.registry import kind_named, kind_names, kinds
from dtwin.schema import DEFAULT_KIND, require_name
from dtwin.units import is_number

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Plan = TypeVar("_Plan", bound="DataclassInstance")

_MAX_BYTES = 4 * 1024**2


def read_plan_file(path: Path) -> dict[str, Any]:
    """Return the content of a plan file.

    ``path``: TOML with a table ``[plan]``; its ``kind`` says what else is in it.
    Raises ``InputError`` when it cannot be read, or is no TOML.
    """
    try:
        return read_toml(path, _MAX_BYTES)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(
            "the plan is not valid TOML", code="plan.toml", where=str(path), got=str(error)[:200]
        ) from error
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", "") or str(error)
        raise InputError(
            "the plan cannot be read",
            code="plan.file",
            where=str(path),
            got=said,
            hint="check the path; dtwin machine next MACHINE --out FILE writes a plan",
        ) from error


def planned_campaign(path: Path, unstated: str = DEFAULT_KIND) -> Planned:
    """Return the campaign that a plan file plans.

    ``path``: as for :func:`read_plan_file`.
    ``unstated``: kind of a plan that does not say its own.
    Raises ``InputError`` when the file cannot be read, its kind is unknown, or a rule of the kind is broken.
    """
    return planned_document(read_plan_file(path), str(path), unstated)


def planned_document(document: Mapping[str, Any], where: str, unstated: str = DEFAULT_KIND) -> Planned:
    """Return the campaign that the content of a plan file plans; ``where`` is its name, for error messages."""
    return _plan_kind(document, unstated).plan(document, where)


def _plan_kind(document: Mapping[str, Any], unstated: str) -> Kind:
    """Return the kind of campaign that a plan asks for; ``unstated`` where it does not say."""
    head = document.get("plan")
    name = head.get("kind", unstated) if isinstance(head, dict) else unstated
    if name not in kind_names():
        raise InputError(
            "no plan is known for this kind",
            code="plan.kind",
            where="plan.kind",
            got=str(name)[:40],
            allowed=", ".join(k.name for k in kinds() if k.offers("plan")),
        )
    kind = kind_named(name)
    kind.require("plan")
    return kind


def plan_settings(document: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the settings of a plan file's table ``[plan]`` without its kind.

    Raises ``InputError`` when it has no such table, or another one, which would not be read.
    """
    table = document.get("plan")
    if not isinstance(table, dict) or len(document) > 1:
        raise InputError(
            "a plan of this kind is a table [plan], and nothing else",
            code="plan.table",
            where=where,
            got=", ".join(document)[:80],
        )
    return {name: value for name, value in table.items() if name != "kind"}


def filled(plan: type[_Plan], stated: Mapping[str, Any], where: str) -> _Plan:
    """Return a plan of settings, each known, given where it has no default, and of the right type.

    ``plan``: a dataclass of text, whole numbers, numbers and tuples of numbers.
    ``where``: where they come from, for error messages.
    Raises ``InputError`` when a setting is unknown, missing or of the wrong type.
    """
    known = {f.name: str(f.type) for f in fields(plan)}
    unknown = sorted(set(stated) - set(known))
    if unknown:
        raise InputError(
            "unknown setting of a plan",
            code="plan.setting",
            where=where,
            got=", ".join(unknown[:5]),
            allowed=", ".join(known),
        )
    missing = [f.name for f in fields(plan) if f.name not in stated and f.default is MISSING]
    if missing:
        raise InputError("the plan lacks settings", code="plan.setting", where=where, got=", ".join(missing))
    return plan(**{name: _typed(name, known[name], stated[name], where) for name in stated})


def obeying(plan: _Plan, rules: Iterable[tuple[str, bool, object, str]], where: str) -> _Plan:
    """Return a plan whose names are usable and whose settings obey rules.

    ``plan``: with ``name`` and ``machine``.
    ``rules``, of (str, bool, object, str): setting, whether its rule is kept, what was given, and what is allowed.
    ``where``: where it comes from, for error messages.
    Raises ``InputError`` with the first rule that is broken.
    """
    for name in ("name", "machine"):
        require_name(getattr(plan, name), f"plan.{name}")
    for name, kept, got, allowed in rules:
        if not kept:
            raise broken_rule(name, f"{name} cannot be", where, got, allowed)
    return plan


def broken_rule(name: str, what: str, where: str, got: object, allowed: str) -> InputError:
    """Return what is said of a setting that breaks a rule."""
    return InputError(what, code=f"plan.{name}", where=f"{where} plan.{name}", got=str(got)[:60], allowed=allowed)


def _typed(name: str, kind: str, value: Any, where: str) -> Any:
    if kind == "tuple[float, ...]":
        if isinstance(value, list | tuple) and value and all(is_number(v) for v in value):
            return tuple(float(v) for v in value)
        wanted = "a list of numbers"
    else:
        right, wanted = {
            "str": (isinstance(value, str), "text"),
            "int": (isinstance(value, int) and is_number(value), "a whole number"),
            "float": (is_number(value), "a number"),
        }[kind]
        if right:
            return float(value) if kind == "float" else value
    raise InputError(
        f"{name} is of the wrong kind",
        code="plan.setting",
        where=f"{where} plan.{name}",
        got=repr(value)[:60],
        allowed=wanted,
    )
