"""What was answered for an imported table, kept by its heads for the next one."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtwin.acquire.xmlsafe import read_bounded
from dtwin.config import Home
from dtwin.errors import InputError


def recipe_path(home: Home, heads: Sequence[str]) -> Path:
    """Return where the answers for a file with these heads are kept."""
    key = hashlib.sha256(json.dumps(list(heads)).encode()).hexdigest()[:16]
    return home.root / "recipes" / f"{key}.toml"


def recipe_of(home: Home, heads: Sequence[str]) -> dict[str, Any]:
    """Return what was answered for a file with this header; empty without one, or when it cannot be read."""
    place = recipe_path(home, heads)
    if not place.is_file():
        return {}
    try:
        recipe = tomllib.loads(read_bounded(place).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            "the recipe for this header cannot be read", code="import.recipe", where=str(place), hint="delete the file"
        ) from error
    columns, told = recipe.get("columns", {}), recipe.get("told", {})
    return recipe if isinstance(columns, dict) and isinstance(told, dict) else {}
