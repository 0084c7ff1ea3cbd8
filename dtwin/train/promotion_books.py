"""What is written of promotions: the registry's aliases and tags, and a history beside the bundles.

Serving follows the pointer alone. It is moved first, so that a kill leaves books that are behind, never ahead.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dtwin.atomic import append_line
from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.people import acting, note
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import MAX_BYTES, read_json
from dtwin.serve.pointer import machine_folder, resolve

if TYPE_CHECKING:
    # Importing MLflow takes seconds, and a host that only serves has none.
    from dtwin.train.gates import Verdict
    from dtwin.train.registry import RegisteredVersion, Registry

HISTORY = "promotions.jsonl"
"""Name of the history in the folder of a machine's bundles."""
_ENTRY = {"time", "version", "action", "comment", "failed"}
LONGEST_COMMENT = 1000
"""Characters of why something is promoted or rolled back: a table of the history shows it."""
_Action = Literal["trial", "proposed", "champion", "refused", "rollback"]


def bundle_path(home: Home, version: RegisteredVersion) -> Path:
    """Return where the bundle of a version that may be served lies."""
    return machine_folder(version.machine, home) / f"v{int(version.version):04d}.json"


def require_comment(comment: str) -> None:
    """Raise ``InputError`` for a comment that no table of the history can show."""
    if len(comment) > LONGEST_COMMENT:
        raise InputError(
            "the comment is too long",
            code="promote.comment",
            got=f"{len(comment)} characters",
            allowed=f"up to {LONGEST_COMMENT}",
        )


def was_champion(home: Home, version: RegisteredVersion) -> bool:
    """Return whether a version was promoted: its bundle states the evidence. Aliases and tags can be set by anybody."""
    try:
        return Bundle.from_dict(read_json(bundle_path(home, version), MAX_BYTES)).provenance.evidence != "none"
    except (InputError, GateRefusal, StoreError):
        return False


def by_pointer(registry: Registry, home: Home, machine: str) -> RegisteredVersion | None:
    """Return the champion. Serving follows the pointer: a promotion that a kill cut off after it is entered in the books."""
    present = registry.champion(machine, by_alias=True)
    try:
        served = resolve("latest", machine, home, harmless=True)
        version = registry.version(machine, str(served.version))
        kind = Bundle.from_dict(read_json(served.path, MAX_BYTES)).provenance.evidence
    except (InputError, GateRefusal):
        return present
    same = present is not None and present.version == version.version
    # Of a rollback that was cut off the books say the same as before it: it is done again.
    if served.state != "champion" or same or "previous" in version.aliases:
        return present
    enter(registry, present if present and was_champion(home, present) else None, version, kind, served.proved)
    remember(home, version, "champion", "entered later: the promotion was cut off", [])
    return registry.champion(machine, by_alias=True)


def enter(
    registry: Registry, previous: RegisteredVersion | None, version: RegisteredVersion, kind: str, proved: str
) -> None:
    """Enter a champion in the books, and the one before it."""
    if previous is not None and previous.version != version.version:
        registry.mark(previous, {"state": "previous"}, alias="previous")
    registry.mark(version, {"state": "champion", "evidence": kind, "proved": proved}, alias="champion")


def history(home: Home, machine: str) -> list[dict[str, Any]]:
    """Return everything that was promoted, refused or rolled back, oldest first; a line that a kill cut short says nothing."""
    return [entry for entry in _entries(home, machine) if entry is not None]


def damaged_in_history(home: Home, machine: str) -> list[int]:
    """Return the numbers, from 1, of lines of the history that say nothing."""
    return [number for number, entry in enumerate(_entries(home, machine), start=1) if entry is None]


def _entries(home: Home, machine: str) -> Iterator[dict[str, Any] | None]:
    path = machine_folder(machine, home) / HISTORY
    for line in path.read_bytes().splitlines() if path.is_file() else []:
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            entry = None
        yield entry if isinstance(entry, dict) and entry.keys() >= _ENTRY else None


def remember(
    home: Home,
    version: RegisteredVersion,
    action: _Action,
    comment: str,
    verdicts: Sequence[Verdict],
    despite: Sequence[str] = (),
) -> None:
    """Append an entry to the history of a machine."""
    path = machine_folder(version.machine, home) / HISTORY
    entry = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version.version,
        "action": action,
        "who": acting(),
        "comment": comment,
        "failed": [v.gate for v in verdicts if not v.passed],
    } | ({"despite": list(despite)} if despite else {})
    try:
        append_line(path, json.dumps(entry).encode())
        note(home, f"{action}: version {version.version} of {version.machine}", comment, "done")
    except OSError as error:
        raise StoreError(
            "the promotion history cannot be written", code="store.write", where=str(path), got=str(error)
        ) from error
