"""The stream file: which agent or broker is recorded, and what of it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dtwin.acquire.instrument import Instrument
from dtwin.acquire.xmlsafe import read_bounded
from dtwin.errors import InputError
from dtwin.units import is_number

_MAX_BYTES = 1_000_000
_TIMES = {"rate_hz": (0.001, 1000.0), "poll_s": (0.01, 60.0), "timeout_s": (0.1, 300.0), "patience_s": (0.0, 86_400.0)}
_TEXTS = ("url", "device", "broker", "clock", "time", "user", "password_from")
_KNOWN: Mapping[str, tuple[str, ...]] = {
    "mtconnect": ("url", "device", "rate_hz", "poll_s", "timeout_s", "patience_s", "count"),
    "mqtt": (
        *("broker", "rate_hz", "clock", "time", "tls", "user", "password_from", "timeout_s", "patience_s"),
        *("columns", "events", "alarms"),
    ),
}
_REQUIRED = {"mtconnect": ("url",), "mqtt": ("broker", "columns")}


def read_streams_file(path: Path) -> list[Instrument]:
    """Return the closed instruments of a stream file, one for each table.

    Raises ``InputError`` with the place of the first thing that is wrong.
    """
    from dtwin.acquire.instruments import instrument

    try:
        document = tomllib.loads(read_bounded(path, _MAX_BYTES).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            "the stream file is not readable", code="stream.file", where=str(path), got=str(error)[:200]
        ) from error
    if not document or not set(document) <= set(_KNOWN):
        raise InputError(
            "a stream file has a table [mtconnect], [mqtt], or both",
            code="stream.file",
            where=str(path),
            got=", ".join(document)[:80] or "nothing",
            allowed=", ".join(_KNOWN),
        )
    return [instrument(name, **_settings(name, table, f"{path} [{name}]")) for name, table in document.items()]


def _settings(name: str, table: Any, where: str) -> dict[str, Any]:
    known = _KNOWN[name]
    if not isinstance(table, dict) or not set(table) <= set(known) or not set(_REQUIRED[name]) <= set(table):
        got = ", ".join(sorted(set(table) - set(known))) if isinstance(table, dict) else "no table"
        missing = ", ".join(n for n in _REQUIRED[name] if not isinstance(table, dict) or n not in table)
        raise InputError(
            "unknown setting, or one is missing",
            code="stream.setting",
            where=where,
            got=(got or f"no {missing}")[:120],
            allowed=", ".join(known),
        )
    for key, value in table.items():
        if not _fits(key, value):
            raise InputError(
                f"{key} is not usable", code="stream.value", where=where, got=repr(value)[:80], allowed=_wanted(key)
            )
    return {key: tuple(value) if key == "alarms" else value for key, value in table.items()}


def _fits(key: str, value: Any) -> bool:
    if key in _TIMES:
        low, high = _TIMES[key]
        return is_number(value) and low <= value <= high
    if key in _TEXTS:
        return isinstance(value, str)
    if key == "tls":
        return isinstance(value, bool)
    if key == "count":
        return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= 100_000
    if key == "alarms":
        return isinstance(value, list) and all(isinstance(v, str) for v in value)
    return isinstance(value, dict) and all(isinstance(v, str) and v for v in value.values()) and len(value) <= 500


def _wanted(key: str) -> str:
    if key in _TIMES:
        return "a number from {:g} to {:g}".format(*_TIMES[key])
    if key in _TEXTS:
        return "text"
    return {"tls": "true, false", "count": "a whole number from 1 to 100000", "alarms": "a list of topics"}.get(
        key, '"topic" = "name", at most 500'
    )
