"""What ``serve`` reads: one small file per machine that names the promoted bundle."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.schema import require_name
from dtwin.serve.bundle_file import MAX_BYTES, read_json, write_json
from dtwin.serve.fields import one_of, only_fields, text, whole

STATES = ("champion", "trial", "candidate", "barred")
_SERVED_LIVE = ("champion", "trial")
_POINTER = "champion.json"
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
        ``champion``, ``trial``, ``candidate`` or ``barred``.
    """

    path: Path
    sha256: str
    version: int
    state: str

    def describe(self) -> str:
        """Return one line for the terminal."""
        return f"{self.path.name}: version {self.version} ({self.state}), {self.sha256[:12]}"


def machine_folder(machine: str, home: Home) -> Path:
    """Return the folder of a machine's bundles.

    Raises
    ------
    InputError
        When the machine's name could leave the folder.
    """
    return home.bundles / require_name(machine, "the machine")


def write_pointer(
    machine: str, home: Home, bundle: Path, version: int,
    state: Literal["champion", "trial", "candidate", "barred"],
) -> Path:  # fmt: skip
    """Point to a bundle, atomically, and return the pointer's path.

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
    pointer = folder / _POINTER
    write_json(pointer, content)
    return pointer


def only_machine(home: Home) -> str:
    """Return the machine that has a pointer, when there is exactly one.

    Raises
    ------
    InputError
        When there is none, or several.
    """
    found = sorted(p.parent.name for p in home.bundles.glob(f"*/{_POINTER}"))
    if len(found) == 1:
        return found[0]
    raise InputError(
        "no model has been promoted" if not found else "several machines have a promoted model",
        code="serve.machine",
        where=str(home.bundles),
        got=", ".join(found)[:200] or None,
        hint="dtwin promote" if not found else "name one with --machine",
    )


def resolve(model: str, machine: str | None, home: Home, *, harmless: bool = False) -> Resolved:
    """Return what ``latest`` stands for, verified.

    Parameters
    ----------
    model : str
        ``"latest"``.
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
    if model != "latest":
        raise InputError(
            "unknown model", code="serve.model", got=model[:80], allowed="latest",
            hint="dtwin promote moves the pointer that latest follows",
        )  # fmt: skip
    name = machine if machine is not None else only_machine(home)
    folder = machine_folder(name, home)
    pointer = folder / _POINTER
    fields = only_fields(read_json(pointer, _MAX_POINTER_BYTES), _FIELDS, str(pointer))
    path = _inside(folder, text(fields["bundle"], "bundle"))
    state = one_of(fields["state"], STATES, "state")
    version = whole(fields["version"], "version")
    sha256 = text(fields["sha256"], "sha256")
    if _file_sha256(path) != sha256:
        raise GateRefusal(
            "the bundle is not the one that was promoted",
            code="pointer.checksum",
            where=str(path),
            hint="dtwin promote writes bundle and pointer together",
        )
    if state not in _SERVED_LIVE and not harmless:
        raise GateRefusal(
            f"version {version} is {state} and may not correct a machine",
            code="serve.not_passed",
            where=str(pointer),
            got=state,
            allowed=", ".join(_SERVED_LIVE),
            hint="dtwin promote it, or look at it with --shadow or --dry-run",
        )
    return Resolved(path, sha256, version, state)


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
