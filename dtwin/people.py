"""Who may do what at the workbench of a home, whose name stands under it, and a record that only grows."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import pwd
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dtwin.atomic import append_line, read_toml, sync, write_toml
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.locks import locked
from dtwin.schema import require_name

ROLES = ("look", "measure", "train", "promote", "stop")
"""What a person may do; everybody with a token may look."""
AUDIT = "audit.jsonl"
"""Name of the record in a home."""
_FILE, _MAX_BYTES, _LONGEST = "people.toml", 200_000, 500
# Four texts whose every character may become twelve, as those beyond 16 bits do in JSON.
_LONGEST_LINE = 12 * 4 * _LONGEST + 1000
_FIRST = "0" * 64
_acting: ContextVar[str] = ContextVar("acting", default="")


@dataclass(frozen=True)
class Person:
    """Somebody with a token of his own. ``token_sha256``: of the token, which is shown once and kept nowhere."""

    name: str
    roles: tuple[str, ...]
    token_sha256: str

    def may(self, role: str) -> bool:
        """Tell whether the person has a role."""
        return role == "look" or role in self.roles


@dataclass(frozen=True)
class _People:
    """Who is known; ``second_person``: whether a champion needs two of them."""

    people: tuple[Person, ...] = ()
    second_person: bool = False

    def of_token(self, token: str) -> Person | None:
        """Return whose token it is."""
        given = hashlib.sha256(token.encode()).hexdigest()
        owners = [person for person in self.people if hmac.compare_digest(person.token_sha256, given)]
        return owners[0] if owners else None


def acting() -> str:
    """Return who acts: the person of a request, else the user of this process."""
    if name := _acting.get():
        return name
    try:
        # Not of the environment: whoever set it could be the second person of his own promotion.
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return f"user {os.getuid()}"


def act_as(name: str) -> None:
    """Let what follows in this context be done by a person."""
    _acting.set(name)


def read_people(home: Home) -> _People:
    """Return who is known; nobody without the file. Raises ``InputError`` when the file is not usable."""
    path = home.root / _FILE
    try:
        stated = read_toml(path, _MAX_BYTES)
        second = stated.pop("second_person", False)
        people = stated.pop("people", {})
        if stated or not isinstance(second, bool) or not isinstance(people, dict):
            raise ValueError("second_person, or a table people.NAME")
        return _People(tuple(_person(name, about) for name, about in people.items()), second)
    except FileNotFoundError:
        return _People()
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            "the list of people is not usable",
            code="people.file",
            where=str(path),
            got=str(error)[:120],
            hint="mend the file or move it away; dtwin people add NAME --role ... then writes a new one",
        ) from error


def add_person(home: Home, name: str, roles: Sequence[str]) -> str:
    """Make a token for a person, in the place of an earlier one, and return it: it is kept nowhere.

    Raises ``InputError`` when a role is not known.
    """
    require_name(name, "the person")
    unknown = sorted(set(roles) - set(ROLES))
    if unknown or not roles:
        raise InputError(
            "the roles are not usable", code="people.role", got=", ".join(unknown) or "none", allowed=", ".join(ROLES)
        )
    token = secrets.token_urlsafe(24)
    person = Person(name, tuple(r for r in ROLES if r in roles), hashlib.sha256(token.encode()).hexdigest())
    with _changing(home) as known:
        _write(home, _People((*(p for p in known.people if p.name != name), person), known.second_person))
    note(home, f"a token for {name}: {', '.join(person.roles)}", "", "done")
    return token


def remove_person(home: Home, name: str) -> None:
    """Take a person's token away; the name stays under what was done.

    Raises ``InputError`` when nobody has the name.
    """
    with _changing(home) as known:
        others = tuple(p for p in known.people if p.name != name)
        if others == known.people:
            names = ", ".join(p.name for p in others) or "nobody yet"
            raise InputError("nobody has this name", code="people.unknown", got=name[:80], allowed=names)
        _write(home, _People(others, known.second_person))
    note(home, f"no token for {name} any more", "", "done")


def require_second_person(home: Home, wanted: bool) -> None:
    """State whether a champion needs two people."""
    with _changing(home) as known:
        _write(home, _People(known.people, wanted))
    note(home, f"a champion needs {'two people' if wanted else 'one person'}", "", "done")


def note(home: Home, what: str, why: str, came: str, who: str = "") -> None:
    """Add a line to the record: when, who, what, why, and what came of it.

    Each line has the hash of the one before: none can be changed or taken out without those after it.

    Raises ``StoreError`` when it cannot be written.
    """
    path = home.made().root / AUDIT
    try:
        with locked(home.root / "locks" / "audit.lock", wait=True):
            path.touch()
            path.chmod(0o600)
            before = _hash_of_last(path)
            about = {
                "when": datetime.now(UTC).isoformat(timespec="seconds"),
                "who": (who or acting())[:100],
                "what": what[:_LONGEST],
                "why": why[:_LONGEST],
                "came": came[:_LONGEST],
                "after": before,
            }
            size = path.stat().st_size
            try:
                append_line(path, json.dumps(about).encode())
                sync(path)
            except OSError:
                # A part of a line would show as changed for ever.
                os.truncate(path, size)
                raise
    except OSError as error:
        raise StoreError(
            "the record of who did what cannot be written", code="store.write", where=str(path), got=str(error)
        ) from error


def damaged_in(record: Iterable[dict[str, Any] | None]) -> list[int]:
    """Return the numbers, from 1, of lines of the record that are damaged."""
    return [number for number, said in enumerate(record, start=1) if said is None]


def audit(home: Home) -> list[dict[str, Any] | None]:
    """Return the record, oldest first; None for a line that is cut, or before which something was changed."""
    path, before = home.root / AUDIT, _FIRST
    record: list[dict[str, Any] | None] = []
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            said = json.loads(line)
            record.append(said if said["after"] == before else None)
        except (ValueError, TypeError, KeyError, RecursionError):
            record.append(None)
        before = hashlib.sha256(line).hexdigest()
    return record


def _hash_of_last(path: Path) -> str:
    """Return the hash of the last line; one that a kill cut short shows as changed."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _LONGEST_LINE, 0))
        content = file.read()
    lines = content.splitlines()
    return hashlib.sha256(lines[-1]).hexdigest() if lines else _FIRST


def _person(name: str, about: Mapping[str, Any]) -> Person:
    roles, digest = about["roles"], about["token_sha256"]
    if set(about) != {"roles", "token_sha256"} or not set(roles) <= set(ROLES) or len(bytes.fromhex(digest)) != 32:
        raise ValueError(f"people.{name}: roles and token_sha256")
    return Person(require_name(name, "the person"), tuple(roles), str(digest))


@contextmanager
def _changing(home: Home) -> Iterator[_People]:
    """Hold the list, so that what two state at one moment is kept of both."""
    with locked(home.made().root / "locks" / "people.lock", wait=True):
        yield read_people(home)


def _write(home: Home, people: _People) -> None:
    content = {
        "second_person": people.second_person,
        "people": {p.name: {"roles": list(p.roles), "token_sha256": p.token_sha256} for p in people.people},
    }
    write_toml(home.made().root / _FILE, content, "the list of people")
