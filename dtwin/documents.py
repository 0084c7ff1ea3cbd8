"""JSON documents that notice when they were changed."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dtwin.atomic import write_text
from dtwin.errors import StoreError

_SEAL = "sha256"
_HINT = "restore the file from a backup, or remove it and fit again"


def write_document(path: Path, document: Mapping[str, Any], what: str) -> None:
    """Write a JSON document with a hash of itself; NaN becomes null. ``what``: what it is, for the error message."""
    # As it will be read back, keys and tuples included.
    content = json.loads(json.dumps(finite(document)))
    sealed = {**content, _SEAL: _digest(content)}
    write_text(path, json.dumps(sealed, indent=1), what)


def read_document(path: Path, hint: str = _HINT) -> dict[str, Any]:
    """Return a stored JSON document, after comparing it with its hash.

    ``hint``: what to do when it is damaged.
    Raises ``StoreError`` when it cannot be read, or is not what was written.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        seal = document.pop(_SEAL, None) if isinstance(document, dict) else None
        if seal is None or seal != _digest(document):
            raise ValueError("it is not what was written")
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(
            "a stored document cannot be read", code="twin.damaged", where=str(path), got=str(error)[:120], hint=hint
        ) from error
    return dict(document)


def unknown_form(what: str, where: str, form: str, got: object) -> StoreError:
    """Return the error of a document that is not of the form that is read here. ``what``: what it should be."""
    return StoreError(
        f"this is not {what}, or another version of dtwin wrote it",
        code="twin.format",
        where=where,
        got=str(got)[:80],
        allowed=f"the form {form}",
        hint="install the newest dtwin; else fit the twin again, under another name",
    )


def _digest(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def finite(value: Any) -> Any:
    """Return the value with NaN as null, which JSON knows."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value
