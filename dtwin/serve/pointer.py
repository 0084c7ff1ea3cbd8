"""What ``serve`` reads: small files per machine that name the bundles it may use.

``champion.json`` names the promoted bundle, ``trial.json`` the one on trial, ``machine.json``
what serving must know of the machine itself. A trial never touches the champion's pointer. All lie
under one seal, together with the list of withdrawn versions: see :mod:`dtwin.serve.sealed`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.schema import require_name
from dtwin.serve._fields import one_of, only_fields, text, whole
from dtwin.serve._machine_file import MachineGeometry, machine_folder, read_machine, write_machine
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import MAX_BYTES, parse_json, read_bytes, replaced
from dtwin.serve.interface import mapping
from dtwin.serve.sealed import CHAMPION, TRIAL, locked, read_sealed, write_sealed
from dtwin.serve.withdrawn import named_today, withdrawn_why

__all__ = [
    "MachineGeometry",
    "Resolved",
    "clear_trial",
    "machine_folder",
    "on_trial",
    "read_machine",
    "renew_proof",
    "resolve",
    "write_machine",
    "write_pointer",
]

_STATES = ("champion", "trial", "candidate", "withdrawn")
_UNPROMOTED = "unpromoted"
_SERVED_LIVE = ("champion", "trial")
_POINTERS = {"latest": CHAMPION, "trial": TRIAL}
NAMES = ("latest", "champion", "trial")
"""Models that are no file; ``champion`` is ``latest`` under the name that ``dtwin campaign --with`` has."""
_FIELDS = ("bundle", "sha256", "version", "state", "proved")


@dataclass(frozen=True)
class Resolved:
    """A bundle that a name stood for.

    Attributes:
        path: The bundle's file, below the machine's folder.
        sha256: Checksum of that file's bytes.
        model_sha256: ``Bundle.model_sha256``: what is shown, and what runs and journal name.
        version: Version in the registry, as the bundle itself says.
        state: ``champion``, ``trial``, ``candidate`` or ``withdrawn``; ``unpromoted`` for a file that no pointer names.
        proved: ISO time at which it was last shown in a closed loop that it helps; empty when it never was.
    """

    path: Path
    sha256: str
    model_sha256: str
    version: int
    state: str
    machine: str
    proved: str = ""

    def describe(self) -> str:
        """Return one line for the terminal."""
        return (
            f"{self.machine}: version {self.version} ({self.state}), {self.path.name}, model {self.model_sha256[:12]}"
        )


def write_pointer(
    machine: str,
    home: Home,
    bundle: Path,
    version: int,
    state: Literal["champion", "trial", "candidate", "withdrawn"],
    proved: str = "",
) -> Path:
    """Point to a bundle, atomically, and return the pointer's path.

    A trial goes to ``trial.json``, every other state to ``champion.json``.

    Args:
        bundle: Bundle's file; it must lie directly in the machine's folder.
        state: What the version may be used for. One of "champion", "trial", "candidate", "withdrawn".
        proved: As in ``Resolved``.

    Raises:
        InputError: When the bundle is missing, lies elsewhere or is of another version.
        StoreError: When the pointer cannot be written.
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
    raw = read_bytes(path, MAX_BYTES)
    told = mapping(parse_json(raw, path), str(path)).get("model_version")
    if told != version:
        raise InputError(
            "the bundle is of another version",
            code="pointer.version",
            where=str(path),
            got=str(told)[:40],
            allowed=str(version),
        )
    content = {
        "bundle": path.name,
        "sha256": hashlib.sha256(raw).hexdigest(),
        "version": version,
        "state": one_of(state, _STATES, "state"),
        "proved": proved,
    }
    pointer = write_sealed(folder, _POINTERS["trial" if state == "trial" else "latest"], content)
    forget_replaced(folder)
    return pointer


def renew_proof(machine: str, home: Home, version: int, proved: str) -> None:
    """Note that a champion was shown anew to help; nothing happens when it is no more.

    Args:
        proved: ISO time.
    """
    folder = machine_folder(machine, home)
    with locked(folder):
        content = read_sealed(folder, CHAMPION)
        if content is None:
            return
        fields = only_fields(content, _FIELDS, CHAMPION)
        if (fields["version"], fields["state"]) == (version, "champion"):
            write_sealed(folder, CHAMPION, fields | {"proved": proved})


def on_trial(machine: str, home: Home) -> int | None:
    """Return the version that is on trial, None when there is none."""
    sealed = read_sealed(machine_folder(machine, home), TRIAL)
    return None if sealed is None else whole(only_fields(sealed, _FIELDS, TRIAL)["version"], "version")


def clear_trial(machine: str, home: Home) -> None:
    """Take the trial's pointer away, after its promotion or its failure; none is no mistake.

    Raises ``StoreError`` when the folder cannot be written.
    """
    if (machine_folder(machine, home) / TRIAL).exists():
        write_sealed(machine_folder(machine, home), TRIAL, None)
        forget_replaced(machine_folder(machine, home))


def named_file(folder: Path, name: str, sha256: str) -> Path:
    """Return the file of a bundle that a pointer names: what was kept of it when a kill came between bundle and pointer.

    Its checksum is still to be compared.
    """
    path = _inside(folder, name)
    kept = _inside(folder, replaced(path, sha256).name)
    moved = kept.is_file() and hashlib.sha256(read_bytes(path, MAX_BYTES)).hexdigest() != sha256
    return kept if moved else path


def forget_replaced(folder: Path) -> None:
    """Remove bundles that were written anew, and that no pointer of the machine names any more."""
    with locked(folder), contextlib.suppress(InputError, GateRefusal):
        sealed = [read_sealed(folder, name) for name in _POINTERS.values()]
        named = {named_file(folder, str(told["bundle"]), str(told["sha256"])) for told in sealed if told is not None}
        for kept in set(folder.resolve().glob(f"*.{'[0-9a-f]' * 12}.json")) - named:
            kept.unlink(missing_ok=True)


def _only_machine(home: Home, model: str = "latest") -> str:
    """Return the machine that has a pointer, when there is exactly one.

    Args:
        model: ``latest`` or ``trial``.

    Raises:
        InputError: When there is none, or several.
    """
    machines = sorted(p.parent.name for p in home.bundles.glob(f"*/{_POINTERS[model]}"))
    if len(machines) == 1:
        return machines[0]
    what = "promoted model" if model == "latest" else "model on trial"
    none = "no model has been promoted" if model == "latest" else "no model is on trial"
    raise InputError(
        f"several machines have a {what}" if machines else none,
        code="serve.machine",
        where=str(home.bundles),
        got=", ".join(machines)[:200] or None,
        hint="name one with --machine" if machines else _absent_hint(model, None, home),
    )


def served_version(machine: str, home: Home) -> int | None:
    """Return the version that is served as the champion of a machine, None when none is."""
    try:
        resolved = resolve("latest", machine, home, harmless=True)
    except (InputError, GateRefusal):
        return None
    return resolved.version if resolved.state == "champion" else None


def resolve(model: str, machine: str | None, home: Home, *, harmless: bool = False) -> Resolved:
    """Return what a model's name stands for, verified.

    Args:
        model: ``latest`` or ``champion``, which are one, ``trial``, or the path of a bundle's file (ending in ``.json``).
        machine: Machine; None when there is only one.
        harmless: Whether nothing will be moved (shadow or dry run), so that any state may be looked at.

    Raises:
        InputError: When there is no pointer, or it is malformed, or its bundle is missing.
        GateRefusal: When the bundle was changed, or its version may not correct a machine.
    """
    model = "latest" if model == "champion" else model
    if model.endswith(".json"):
        resolved = _resolve_file(Path(model), machine, home)
    elif model in _POINTERS:
        resolved = _follow(model, _only_machine(home, model) if machine is None else machine, home)
    else:
        raise InputError(
            "unknown model",
            code="serve.model",
            got=model[:80],
            allowed=f"{', '.join(NAMES)}, or the path of a bundle's .json file",
            hint="dtwin promote moves the pointer that latest follows",
        )
    why = withdrawn_why(resolved.machine, home, resolved.version)
    if why and resolved.state in _SERVED_LIVE:
        resolved = dataclasses.replace(resolved, state="withdrawn")
    if resolved.state not in _SERVED_LIVE and not harmless:
        raise GateRefusal(
            f"version {resolved.version} is {resolved.state} and may not correct a machine",
            code="serve.not_passed",
            where=str(resolved.path),
            got=f"{resolved.state}: {why}" if why else resolved.state,
            allowed=", ".join(_SERVED_LIVE),
            hint="dtwin promote it, or look at it with --shadow or --dry-run",
        )
    return resolved


def proven_states(machine: str, said: Mapping[int, str], home: Home) -> dict[int, str]:
    """Return the states of registered versions: champion or on trial only where the pointer that serving follows names one.

    ``said``: version and its state by the registry's tags, which whoever reaches its server can write.
    """
    named: dict[int, str] = {}
    unnamed = f"{_UNPROMOTED}, whatever its tags say"
    for model in _POINTERS:
        try:
            resolved = _follow(model, machine, home)
            # Of both, the champion comes first.
            named.setdefault(resolved.version, resolved.state)
        except (InputError, GateRefusal) as error:
            if error.code == "bundle.version":
                unnamed = "not to be read here: another version of dtwin wrote it"

    def state(version: int, tagged: str) -> str:
        if withdrawn_why(machine, home, version):
            return "withdrawn"
        return named.get(version, unnamed if tagged in _SERVED_LIVE else tagged)

    return {version: state(version, tagged) for version, tagged in said.items()}


def _follow(model: str, machine: str, home: Home) -> Resolved:
    """Return what a machine's pointer names, after comparing checksums."""
    folder = machine_folder(machine, home)
    pointer = folder / _POINTERS[model]
    if not pointer.exists() or (sealed := read_sealed(folder, pointer.name)) is None:
        known = sorted(path.parent.name for path in home.bundles.glob(f"*/{pointer.name}"))
        raise InputError(
            f"{machine} has no {'promoted model' if model == 'latest' else 'model on trial'}",
            code="serve.no_pointer",
            where=str(pointer),
            got=machine,
            allowed=", ".join(known)[:200] or None,
            hint=_absent_hint(model, machine, home),
        )
    fields = only_fields(sealed, _FIELDS, str(pointer))
    path = named_file(folder, text(fields["bundle"], "bundle"), text(fields["sha256"], "sha256"))
    states = tuple(state for state in _STATES if (state == "trial") == (model == "trial"))
    state = one_of(named_today(text(fields["state"], "state")), states, "state")
    version = whole(fields["version"], "version")
    sha256 = text(fields["sha256"], "sha256")
    if hashlib.sha256(read_bytes(path, MAX_BYTES)).hexdigest() != sha256:
        raise GateRefusal(
            "the bundle is not the one that was promoted",
            code="pointer.checksum",
            where=str(path),
            hint="dtwin promote writes bundle and pointer together",
        )
    bundle, _ = _read_bundle(path)
    if bundle.model_version != version:
        raise GateRefusal(
            "the pointer names another version than its bundle does",
            code="pointer.version",
            where=str(pointer),
            got=str(version),
            allowed=str(bundle.model_version),
            hint="dtwin promote writes bundle and pointer together",
        )
    proved = text(fields["proved"], "proved")
    return Resolved(path, sha256, bundle.model_sha256, bundle.model_version, state, machine, proved)


def _resolve_file(path: Path, machine: str | None, home: Home) -> Resolved:
    """Return a bundle's file, with the state that a pointer of its machine gives it."""
    bundle, sha256 = _read_bundle(path)
    name = bundle.machine if machine is None else machine
    for model, pointer in _POINTERS.items():
        if (machine_folder(name, home) / pointer).exists():
            named = _follow(model, name, home)
            if named.sha256 == sha256:
                return named
    return Resolved(path, sha256, bundle.model_sha256, bundle.model_version, _UNPROMOTED, name)


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
        raise InputError("the bundle's file leaves its folder", code="pointer.outside", got=name[:120])
    return path


def _read_bundle(path: Path) -> tuple[Bundle, str]:
    """Return a bundle, and the checksum of its file."""
    raw = read_bytes(path, MAX_BYTES)
    return Bundle.from_dict(parse_json(raw, path)), hashlib.sha256(raw).hexdigest()
