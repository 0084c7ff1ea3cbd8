"""What ``serve`` reads: small files per machine that name the bundles it may use.

``champion.json`` names the promoted bundle, ``trial.json`` the one on trial, ``machine.json``
what serving must know of the machine itself. A trial never touches the champion's pointer.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError, StoreError
from dtwin.schema import require_name
from dtwin.serve.barred import barred_why
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import MAX_BYTES, read_json, write_json
from dtwin.serve.fields import one_of, only_fields, text, whole
from dtwin.serve.machine_file import MachineGeometry, machine_folder, read_machine, write_machine

__all__ = [
    "MachineGeometry",
    "Resolved",
    "clear_trial",
    "machine_folder",
    "on_trial",
    "only_machine",
    "read_machine",
    "resolve",
    "write_machine",
    "write_pointer",
]

STATES = ("champion", "trial", "candidate", "barred")
UNPROMOTED = "unpromoted"
_SERVED_LIVE = ("champion", "trial")
_POINTERS = {"latest": "champion.json", "trial": "trial.json"}
_FIELDS = ("bundle", "sha256", "version", "state")
_MAX_POINTER_BYTES = 10_000


@dataclass(frozen=True)
class Resolved:
    """A bundle that a name stood for.

    Attributes
    ----------
    path : Path
        The bundle's file, below the machine's folder.
    sha256 : str
        Checksum of that file's bytes.
    version : int
        Version in the registry.
    state : str
        ``champion``, ``trial``, ``candidate`` or ``barred``; ``unpromoted`` for a file that
        no pointer names.
    machine : str
        Machine that it is served to.
    """

    path: Path
    sha256: str
    version: int
    state: str
    machine: str

    def describe(self) -> str:
        """Return one line for the terminal."""
        return (
            f"{self.machine}: version {self.version} ({self.state}), "
            f"{self.path.name}, sha256 {self.sha256[:12]}"
        )


def write_pointer(
    machine: str, home: Home, bundle: Path, version: int,
    state: Literal["champion", "trial", "candidate", "barred"],
) -> Path:  # fmt: skip
    """Point to a bundle, atomically, and return the pointer's path.

    A trial goes to ``trial.json``, every other state to ``champion.json``.

    Parameters
    ----------
    machine : str
        Machine that will be served.
    home : Home
        Where state lives.
    bundle : Path
        Bundle's file; it must lie directly in the machine's folder.
    version : int
        Version in the registry.
    state : {"champion", "trial", "candidate", "barred"}
        What the version may be used for.

    Raises
    ------
    InputError
        When the bundle is missing or lies elsewhere.
    StoreError
        When the pointer cannot be written.
    """
    folder = machine_folder(machine, home)
    path = _inside(folder, bundle.name)
    if path != bundle.resolve():
        raise InputError(
            "the bundle does not lie in the machine's folder",
            code="pointer.elsewhere",
            got=str(bundle),
            allowed=str(folder),
        )
    content = {
        "bundle": path.name,
        "sha256": _file_sha256(path),
        "version": version,
        "state": one_of(state, STATES, "state"),
    }
    pointer = folder / _POINTERS["trial" if state == "trial" else "latest"]
    write_json(pointer, content)
    return pointer


def on_trial(machine: str, home: Home) -> int | None:
    """Return the version that is on trial, None when there is none.

    Parameters
    ----------
    machine : str
        Machine.
    home : Home
        Where state lives.
    """
    pointer = machine_folder(machine, home) / _POINTERS["trial"]
    if not pointer.exists():
        return None
    fields = only_fields(read_json(pointer, _MAX_POINTER_BYTES), _FIELDS, str(pointer))
    return whole(fields["version"], "version")


def clear_trial(machine: str, home: Home) -> None:
    """Take the trial's pointer away, after its promotion or its failure; none is no mistake.

    Raises
    ------
    StoreError
        When the folder cannot be written.
    """
    pointer = machine_folder(machine, home) / _POINTERS["trial"]
    try:
        pointer.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(
            "the trial's pointer cannot be removed",
            code="pointer.write",
            where=str(pointer),
            got=error.strerror or str(error),
        ) from error


def only_machine(home: Home, model: str = "latest") -> str:
    """Return the machine that has a pointer, when there is exactly one.

    Parameters
    ----------
    home : Home
        Where state lives.
    model : str
        ``latest`` or ``trial``.

    Raises
    ------
    InputError
        When there is none, or several.
    """
    found = sorted(p.parent.name for p in home.bundles.glob(f"*/{_POINTERS[model]}"))
    if len(found) == 1:
        return found[0]
    what = "promoted model" if model == "latest" else "model on trial"
    none = "no model has been promoted" if model == "latest" else "no model is on trial"
    raise InputError(
        f"several machines have a {what}" if found else none,
        code="serve.machine",
        where=str(home.bundles),
        got=", ".join(found)[:200] or None,
        hint="name one with --machine" if found else _absent_hint(model, None, home),
    )


def resolve(model: str, machine: str | None, home: Home, *, harmless: bool = False) -> Resolved:
    """Return what a model's name stands for, verified.

    Parameters
    ----------
    model : str
        ``latest``, ``trial``, or the path of a bundle's file (ending in ``.json``).
    machine : str or None
        Machine; None when there is only one.
    home : Home
        Where state lives.
    harmless : bool
        Whether nothing will be moved (shadow or dry run), so that any state may be looked at.

    Raises
    ------
    InputError
        When there is no pointer, or it is malformed, or its bundle is missing.
    GateRefusal
        When the bundle was changed, or its version may not correct a machine.
    """
    if model.endswith(".json"):
        found = _resolve_file(Path(model), machine, home)
    elif model in _POINTERS:
        found = _follow(model, only_machine(home, model) if machine is None else machine, home)
    else:
        raise InputError(
            "unknown model", code="serve.model", got=model[:80],
            allowed="latest, trial, or the path of a bundle's .json file",
            hint="dtwin promote moves the pointer that latest follows",
        )  # fmt: skip
    why = barred_why(found.machine, home, found.version)
    if why and found.state in _SERVED_LIVE:
        found = dataclasses.replace(found, state="barred")
    if found.state not in _SERVED_LIVE and not harmless:
        raise GateRefusal(
            f"version {found.version} is {found.state} and may not correct a machine",
            code="serve.not_passed",
            where=str(found.path),
            got=f"{found.state}: {why}" if why else found.state,
            allowed=", ".join(_SERVED_LIVE),
            hint="dtwin promote it, or look at it with --shadow or --dry-run",
        )
    return found


def _follow(model: str, machine: str, home: Home) -> Resolved:
    """Return what a machine's pointer names, after comparing checksums."""
    folder = machine_folder(machine, home)
    pointer = folder / _POINTERS[model]
    if folder.is_dir() and not pointer.exists():
        raise InputError(
            f"{machine} has no {'promoted model' if model == 'latest' else 'model on trial'}",
            code="serve.no_pointer",
            where=str(pointer),
            hint=_absent_hint(model, machine, home),
        )
    fields = only_fields(read_json(pointer, _MAX_POINTER_BYTES), _FIELDS, str(pointer))
    path = _inside(folder, text(fields["bundle"], "bundle"))
    states = tuple(state for state in STATES if (state == "trial") == (model == "trial"))
    state = one_of(fields["state"], states, "state")
    version = whole(fields["version"], "version")
    sha256 = text(fields["sha256"], "sha256")
    if _file_sha256(path) != sha256:
        raise GateRefusal(
            "the bundle is not the one that was promoted",
            code="pointer.checksum",
            where=str(path),
            hint="dtwin promote writes bundle and pointer together",
        )
    return Resolved(path, sha256, version, state, machine)


def _resolve_file(path: Path, machine: str | None, home: Home) -> Resolved:
    """Return a bundle's file, with the state that a pointer of its machine gives it."""
    sha256 = _file_sha256(path)
    bundle = Bundle.from_dict(read_json(path, MAX_BYTES))
    name = bundle.machine if machine is None else machine
    for model, pointer in _POINTERS.items():
        if (machine_folder(name, home) / pointer).exists():
            named = _follow(model, name, home)
            if named.sha256 == sha256:
                return named
    return Resolved(path, sha256, bundle.model_version, UNPROMOTED, name)


def _absent_hint(model: str, machine: str | None, home: Home) -> str:
    if model == "trial":
        return "dtwin promote --trial"
    folder = "*" if machine is None else machine_folder(machine, home).name
    on_trial = any(home.bundles.glob(f"{folder}/{_POINTERS['trial']}"))
    return "a version is on trial: serve it with --model trial" if on_trial else "dtwin promote"


def _inside(folder: Path, name: str) -> Path:
    require_name(name, "the bundle's file")
    root = folder.resolve()
    path = (root / name).resolve()
    if path.parent != root:
        raise InputError(
            "the bundle's file leaves its folder", code="pointer.outside", got=name[:120]
        )
    return path


def _file_sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            "the bundle cannot be read",
            code="bundle.missing",
            where=str(path),
            got=error.strerror or str(error),
            hint="dtwin promote writes it",
        ) from error
    return hashlib.sha256(raw).hexdigest()
