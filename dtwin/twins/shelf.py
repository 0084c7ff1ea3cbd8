"""Versions of twins on disk, whatever kind of campaign they are of."""

from __future__ import annotations

import os
import uuid
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from dtwin.config import Home
from dtwin.documents import read_document, write_document
from dtwin.errors import InputError, StoreError
from dtwin.locks import locked
from dtwin.progress import tell
from dtwin.schema import DEFAULT_KIND, require_name
from dtwin.shared_documents import follow_shared
from dtwin.twins.diagnosing_code import MADE_BY, diagnosing_code
from dtwin.twins.registration import diagnosis_path, log_soon, place_of, version_name, version_number, version_paths

PATHS = "paths"
"""Kind of a twin that names none: it is of tests of a path."""
_CAMPAIGNS = {PATHS: "a twin of circular, linear or sinusoidal campaigns"}


def require_same_machine(name: str, machine: str, campaign: str, its_machine: str) -> None:
    """Refuse to compare a twin with measurements of another machine."""
    if its_machine != machine:
        raise InputError(
            "the twin is of another machine",
            code="twin.machine",
            where=f"twin {name}, machine {machine}",
            got=f"campaign {campaign}, machine {its_machine}",
            hint="fit a twin to that campaign",
        )


class _Versioned(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def labels(self) -> Sequence[str]: ...


def effect_there(twin: _Versioned, effect: str, hint: str | None = None) -> InputError:
    """Return the refusal to add what a twin has."""
    return InputError(
        "the twin has this effect already",
        code="twin.has_effect",
        where=f"twin {twin.name} version {twin.version}",
        got=effect,
        hint=hint,
    )


def effect_absent(twin: _Versioned, effect: str) -> InputError:
    """Return the refusal to take out what a twin does not have."""
    return InputError(
        "the twin does not have this effect",
        code="twin.no_effect",
        where=f"twin {twin.name} version {twin.version}",
        got=effect,
        allowed=", ".join(twin.labels) or "it has none",
    )


class TwinShelf:
    """Where the twins of a home are kept: one folder each, one file for a version.

    ``kind``: twins of this kind are found, others are refused: ``paths`` or ``volumetric``.
    ``logs``: whether what is stored is logged in MLflow by a process that follows.
    ``unkept``: the last diagnosis, as it would be stored, when it could not be; empty otherwise.
    """

    logs = True

    def __init__(self, home: Home, kind: str) -> None:
        self.home, self.kind = home, kind
        self.unkept: Mapping[str, Any] = {}
        self._why_unkept: StoreError | None = None

    @property
    def root(self) -> Path:
        """Folder of all twins."""
        return self.home.root / "twins"

    def names(self, among: Collection[str] | None = None) -> list[str]:
        """Return the twins of this kind; with ``among``, those of these names."""
        folders = [p for p in self.root.glob("*") if among is None or p.name in among]
        return sorted(p.name for p in folders if self._is_ours(p))

    def newest_document(self, name: str, version: int | None = None) -> tuple[dict[str, Any], Path]:
        """Return a version as it was stored, the newest one without a number, and its file.

        Raises ``InputError`` when there is no such twin or version, or it is of another kind.
        Raises ``StoreError`` when its file is damaged.
        """
        folder = self.folder(name)
        there = version_paths(folder)
        paths = there if version is None else [p for p in there if p.stem == version_name(version)]
        if not paths:
            raise InputError(
                "no such version of the twin",
                code="twin.version",
                where=f"twin {name}",
                got=str(version),
                allowed=", ".join(str(version_number(path)) for path in there),
                hint=f"dtwin twin history {name}",
            )
        document = read_document(paths[-1])
        self._require_ours(name, document)
        return document, paths[-1]

    def folder(self, name: str) -> Path:
        """Return the folder of a twin. Raises ``InputError`` when there is none."""
        require_name(name, "the twin")
        folder = self.root / name
        # A first fit that could not be written leaves an empty one.
        if not version_paths(folder):
            raise InputError(
                "no such twin",
                code="twin.unknown",
                got=name,
                allowed=", ".join(sorted(p.name for p in self.root.glob("*") if version_paths(p))) or "none yet",
                hint="dtwin twin fit CAMPAIGN --effects ... --name NAME makes one",
            )
        return folder

    def next_version(self, name: str, machine: str, base: int | None = None) -> int:
        """Return the number of the version to come.

        ``base``: version whose effects it goes on from.
        Raises ``InputError`` when the twin is of another kind or machine, or has a newer version than ``base``.
        """
        numbers = self._numbers(name)
        if base is not None and max(numbers, default=0) > base:
            raise _meanwhile(name, max(numbers))
        its = self.newest_document(name)[0]["machine"] if numbers else machine
        if its != machine:
            raise InputError(
                "a twin of this name is of another machine",
                code="twin.machine",
                where=f"twin {name}, machine {its}",
                got=f"measurements of machine {machine}",
                hint="another name",
            )
        return max(numbers, default=0) + 1

    def store(self, document: Mapping[str, Any], *, ahead: bool = False) -> None:
        """Write the file of a version, and have it logged in MLflow.

        ``document``: ``as_dict`` of the twin.
        ``ahead``: have it diagnosed in the background.
        Raises ``InputError`` when another process made this version meanwhile.
        """
        name, version, at_once = document["twin"], document["version"], self.home.mlflow_at_once
        # No two files are alike: by that MLflow tells a version from one of another home or of a
        # twin that was removed.
        unique = {**document, "id": uuid.uuid4().hex}
        with locked(self.home.root / "locks" / f"twin-{name}.lock", wait=True):
            if version in self._numbers(name):
                raise _meanwhile(name, version)
            write_document(self._file(document), unique, "the twin")
        tell(f"{name} version {version}: {document['action']}")
        self._tell(name, at_once=at_once, ahead=ahead)

    def store_diagnosis(self, document: Mapping[str, Any]) -> None:
        """Write a diagnosis beside its version, and have its verdict noted in MLflow.

        One that cannot be kept is ``unkept``, for it may have taken minutes; in a home that can only be read none is.
        """
        self.unkept, self._why_unkept = {}, None
        if not os.access(self.folder(document["twin"]), os.W_OK):
            self.unkept = document
            return
        at_once = self.home.mlflow_at_once
        try:
            kept = {**document, MADE_BY: diagnosing_code()}
            write_document(diagnosis_path(self._file(document)), kept, "the diagnosis")
            self._tell(document["twin"], at_once=at_once)
        except StoreError as error:
            self.unkept, self._why_unkept = document, error

    def require_kept(self) -> None:
        """Raise the ``StoreError`` of a diagnosis that was lost to a full disk, a lost registry or store."""
        if self._why_unkept is not None:
            raise self._why_unkept

    def kept_diagnosis(self, name: str, version: int) -> dict[str, Any] | None:
        """Return the diagnosis that is kept beside a version; None without."""
        path = diagnosis_path(self.folder(name) / f"{version_name(version)}.json")
        return read_document(path) if path.exists() else None

    def history(self, name: str) -> list[dict[str, Any]]:
        """Return every rung of a twin, oldest first.

        ``group``: what its diagnosis names first; ``found``: all that it names, what cannot be told apart together.
        """
        folder = self.folder(name)
        out = []
        for path in version_paths(folder):
            document = read_document(path)
            diagnosis = diagnosis_path(path)
            verdict = read_document(diagnosis) if diagnosis.exists() else {}
            group = [_label(c) for c in verdict.get("candidates", []) if c["in_group"]]
            out.append(
                {
                    "version": document["version"],
                    "action": document["action"],
                    "campaign": document["campaign"],
                    **(
                        {"campaigns": [c["campaign"] for c in document["campaigns"]]} if "campaigns" in document else {}
                    ),
                    **document["figures"],
                    "verdict": verdict.get("verdict"),
                    "group": group,
                    "found": [[_label(c) for c in one] for one in verdict.get("found", [])] or [[one] for one in group],
                    "lack_of_fit_p": verdict.get("lack_of_fit_p"),
                    "mlflow": place_of(path, document),
                }
            )
        return out

    def _is_ours(self, folder: Path) -> bool:
        paths = version_paths(folder)
        return bool(paths) and read_document(paths[-1]).get("kind", PATHS) == self.kind

    def _require_ours(self, name: str, document: Mapping[str, Any]) -> None:
        kind = document.get("kind", PATHS)
        if kind != self.kind:
            raise InputError(
                "the twin is of another kind of campaign",
                code="twin.kind",
                where=f"twin {name}",
                got=str(kind)[:40],
                allowed=_CAMPAIGNS.get(self.kind, f"a twin of {self.kind} campaigns"),
                hint="dtwin twin fit, compare, diagnose, add, remove, restore, discover, confirm, history "
                "and show take every kind",
            )

    def _numbers(self, name: str) -> Sequence[int]:
        return [version_number(p) for p in version_paths(self.root / name)]

    def _file(self, document: Mapping[str, Any]) -> Path:
        return self.root / document["twin"] / f"{version_name(document['version'])}.json"

    def _tell(self, name: str, *, at_once: bool, ahead: bool = False) -> None:
        # Before MLflow is told: another computer may have made the same version.
        follow_shared(self.home)
        if self.logs:
            log_soon(self.home, name, at_once=at_once, ahead=ahead)


_P = ParamSpec("_P")
_T = TypeVar("_T")
_S = TypeVar("_S", bound=TwinShelf)


def logged_together(verb: Callable[Concatenate[_S, str, _P], _T]) -> Callable[Concatenate[_S, str, _P], _T]:
    """Have the versions that a verb stores logged when it has ended: a process for each would take the processor from the verb."""

    @wraps(verb)
    def together(self: _S, name: str, /, *args: _P.args, **others: _P.kwargs) -> _T:
        logs, self.logs, at_once = self.logs, False, False
        try:
            out = verb(self, name, *args, **others)
            # Only of a verb that has ended, or a refusal of MLflow would hide what it raised.
            at_once = self.home.mlflow_at_once
            return out
        finally:
            self.logs = logs
            if logs:
                log_soon(self.home, name, at_once=at_once)

    return together


def _meanwhile(name: str, version: int) -> InputError:
    return InputError(
        "another process changed the twin meanwhile",
        code="twin.meanwhile",
        where=f"twin {name} version {version}",
        hint="run this again: it takes the new version as its base",
    )


def kind_of(home: Home, name: str) -> str:
    """Return the kind of campaign of a twin; of a path, and of none, the default one."""
    require_name(name, "the twin")
    paths = version_paths(home.root / "twins" / name)
    return str(read_document(paths[-1]).get("kind", DEFAULT_KIND)) if paths else DEFAULT_KIND


def _label(candidate: Mapping[str, Any]) -> str:
    return str(candidate.get("label") or f"{candidate['effect']} {candidate['axis']}".strip())
