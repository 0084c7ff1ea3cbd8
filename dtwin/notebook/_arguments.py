"""What a notebook tells a verb: names, paths and numbers, or a refusal in words."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path

from dtwin.errors import InputError


def require_seed(seed: object) -> None:
    """Refuse a seed that is no whole number from 0."""
    if not isinstance(seed, Integral) or int(seed) < 0:
        raise InputError("not a seed", code="notebook.seed", got=str(seed)[:40], allowed="a whole number from 0")


def require_flag(value: object, what: str) -> None:
    """Refuse what is neither true nor false: any text would count as true."""
    if not isinstance(value, bool):
        raise InputError(f"{what} is true or false", code="notebook.flag", got=repr(value)[:60], allowed="True, False")


def require_text(value: object, what: str) -> None:
    """Refuse a name that is no text. ``what``: of what it is, with its article."""
    if not isinstance(value, str):
        raise InputError(
            f"{what} is named by its text",
            code="notebook.name",
            got=repr(value)[:60],
            hint="home.runs() lists the names of campaigns and runs",
        )


def version_of(number: object) -> int | None:
    """Return the number of a version, None for the newest; refuse another thing."""
    if number is None:
        return None
    if isinstance(number, Integral):
        return int(number)
    raise InputError("not a version", code="notebook.version", got=repr(number)[:60], allowed="a whole number from 1")


def plain(told: Mapping[str, object]) -> dict[str, object]:
    """Return what is told of a table, numbers of numpy as those of Python; refuse what is neither a text nor a number."""
    foreign = next(
        (name for name, value in told.items() if value is not None and not isinstance(value, str | Real)), ""
    )
    if foreign:
        raise InputError(
            "what is told of a table is a text or a number",
            code="ingest.told",
            where=foreign,
            got=repr(told[foreign])[:60],
        )
    return {name: _number(value) if not isinstance(value, str | bool | None) else value for name, value in told.items()}


def _number(value: object) -> object:
    return int(value) if isinstance(value, Integral) else float(value) if isinstance(value, Real) else value


def path_of(value: object, what: str) -> Path:
    """Return a path; an empty text is none, and not the current folder."""
    if isinstance(value, Path) or (isinstance(value, str) and value.strip()):
        with contextlib.suppress(OSError, ValueError):
            # Names of more than 255 characters cannot be looked at.
            Path(value).exists()
            return Path(value)
    raise InputError(f"{what} is a path", code="notebook.path", got=repr(value)[:60], allowed="a folder or a file")


def texts_of(value: object, what: str) -> list[str]:
    """Return one text, or several, as a list; a path counts as its text."""
    several = [value] if isinstance(value, str | Path) else value
    if isinstance(several, Iterable):
        texts = [str(one) if isinstance(one, Path) else one for one in several]
        if all(isinstance(one, str) for one in texts):
            return texts
    raise InputError(
        f"{what} are named by their texts",
        code="notebook.names",
        got=repr(value)[:60],
        allowed="a text, or a list of them",
    )
