"""A plan file, read once whatever kind of campaign it plans."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from dtwin.errors import InputError


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


def is_linear(document: dict[str, Any]) -> bool:
    """Tell whether a plan asks for a positioning test; circular tests need not say their kind."""
    head = document.get("plan")
    return isinstance(head, dict) and head.get("kind") == "linear"
