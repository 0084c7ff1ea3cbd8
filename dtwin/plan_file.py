"""A plan file, read once whatever kind of campaign it plans."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dtwin.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Plan = TypeVar("_Plan", bound="DataclassInstance")

PLANNED_KINDS = ("circular", "linear", "sinusoidal", "volumetric")


def read_plan_file(path: Path) -> dict[str, Any]:
    """Return the content of a plan file.

    Parameters
    ----------
    path : Path
        TOML with a table ``[plan]``; its ``kind`` says what else is in it.

    Raises
    ------
    InputError
        When it cannot be read, or is no TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            "the plan cannot be read", code="plan.file", where=str(path), got=error.strerror
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            "the plan is not valid TOML", code="plan.toml", where=str(path), got=str(error)
        ) from error


def plan_kind(document: dict[str, Any]) -> str:
    """Return the kind of campaign that a plan asks for; circular tests need not say theirs.

    Raises
    ------
    InputError
        When there is no plan for such a kind.
    """
    head = document.get("plan")
    kind = head.get("kind", "circular") if isinstance(head, dict) else "circular"
    if kind not in PLANNED_KINDS:
        raise InputError(
            "no plan is known for this kind", code="plan.kind", where="plan.kind",
            got=str(kind)[:40], allowed=", ".join(PLANNED_KINDS),
        )  # fmt: skip
    return str(kind)


def plan_settings(path: Path) -> dict[str, Any]:
    """Return the settings of a plan file's table ``[plan]`` without its kind.

    Raises
    ------
    InputError
        When it cannot be read, or has no such table.
    """
    table = read_plan_file(path).get("plan")
    if not isinstance(table, dict):
        raise InputError("the plan needs a [plan] table", code="plan.table", where=str(path))
    return {name: value for name, value in table.items() if name != "kind"}


def filled(plan: type[_Plan], stated: Mapping[str, Any], where: str) -> _Plan:
    """Return a plan of settings, each known, given where it has no default, and of the right type.

    Parameters
    ----------
    plan : type
        A dataclass of text, whole numbers, numbers and tuples of numbers.
    stated : mapping
        Its attributes.
    where : str
        Where they come from, for error messages.

    Raises
    ------
    InputError
        When a setting is unknown, missing or of the wrong type.
    """
    known = {f.name: str(f.type) for f in fields(plan)}
    unknown = sorted(set(stated) - set(known))
    if unknown:
        raise InputError(
            "unknown setting of a plan", code="plan.setting", where=where,
            got=", ".join(unknown[:5]), allowed=", ".join(known),
        )  # fmt: skip
    missing = [f.name for f in fields(plan) if f.name not in stated and f.default is MISSING]
    if missing:
        raise InputError(
            "the plan lacks settings", code="plan.setting", where=where, got=", ".join(missing)
        )
    return plan(**{name: _typed(name, known[name], stated[name], where) for name in stated})


def broken_rule(name: str, what: str, where: str, got: object, allowed: str) -> InputError:
    """Return what is said of a setting that breaks a rule."""
    return InputError(
        what, code=f"plan.{name}", where=f"{where} plan.{name}", got=str(got)[:60], allowed=allowed
    )


def _typed(name: str, kind: str, value: Any, where: str) -> Any:
    if kind == "tuple[float, ...]":
        if isinstance(value, list | tuple) and value and all(_is_number(v) for v in value):
            return tuple(float(v) for v in value)
        wanted = "a list of numbers"
    else:
        right, wanted = {
            "str": (isinstance(value, str), "text"),
            "int": (isinstance(value, int) and not isinstance(value, bool), "a whole number"),
            "float": (_is_number(value), "a number"),
        }[kind]
        if right:
            return float(value) if kind == "float" else value
    raise InputError(
        f"{name} is of the wrong kind", code="plan.setting", where=f"{where} plan.{name}",
        got=repr(value)[:60], allowed=wanted,
    )  # fmt: skip


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
