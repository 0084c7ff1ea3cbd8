"""A machine's bundles and pointers for a host that reaches neither lake nor registry, under one key of both.

The host asks with a number that it never used before, and the answer is signed together with it: nobody without the
key learns or changes anything, and an answer of yesterday is none of today.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any

from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import DtwinError, GateRefusal, InputError
from dtwin.schema import require_name
from dtwin.serve._fields import only_fields, text
from dtwin.serve._machine_file import machine_folder
from dtwin.serve.bundle_file import MAX_BYTES, load_bundle, parse_json, read_bytes, replace_bundle
from dtwin.serve.interface import mapping
from dtwin.serve.pointer import forget_replaced, named_file, resolve
from dtwin.serve.sealed import CHAMPION, MACHINE, TRIAL, WITHDRAWN, locked, read_sealed, write_sealed

KEY_FILE = "delivery-key"
NONCE, MAC = "X-Dtwin-Nonce", "X-Dtwin-Mac"
LARGEST = 4 * MAX_BYTES
_KEY_BYTES, _LONGEST = 32, 128
# What is withdrawn comes first, and pointers after the bundles that they name.
_IN_ORDER = (WITHDRAWN, MACHINE, CHAMPION, TRIAL)
_POINTERS = {CHAMPION: "latest", TRIAL: "trial"}


def make_key(home: Home) -> Path:
    """Make the key of deliveries of a home unless it is there, and return its file, which only its owner can read."""
    path = home.made().root / KEY_FILE
    if not path.exists():
        write_text(path, secrets.token_hex(_KEY_BYTES) + "\n", "the key of deliveries", private=True)
    return path


def read_key(home: Home) -> bytes | None:
    """Return the key of deliveries, None when there is none.

    Raises ``InputError`` when the file is no key, or others can read it.
    """
    path = home.root / KEY_FILE
    if not path.exists():
        return None
    try:
        if path.stat().st_mode & 0o077:
            raise ValueError("other users can read it: chmod 600")
        key = bytes.fromhex(read_bytes(path, _LONGEST).decode("ascii").strip())
        if len(key) != _KEY_BYTES:
            raise ValueError(f"{len(key)} bytes instead of {_KEY_BYTES}")
    except ValueError as error:
        raise InputError(
            "the key of deliveries is not usable",
            code="pull.key",
            where=str(path),
            got=str(error)[:100],
            hint="dtwin home key makes one; copy it to the serving host",
        ) from error
    return key


def question(key: bytes, nonce: str, machine: str) -> str:
    """Return the signature of a question."""
    return _signed(key, b"question", nonce, machine.encode())


def answer(key: bytes, nonce: str, content: bytes) -> str:
    """Return the signature of the answer to a question."""
    return _signed(key, b"answer", nonce, content)


def same(given: str, signature: str) -> bool:
    """Compare two signatures in a time that says nothing."""
    return hmac.compare_digest(given.encode(), signature.encode())


def delivery(home: Home, machine: str) -> bytes:
    """Return what a serving host needs of a machine, as JSON.

    Raises ``InputError`` when nothing is known of the machine.
    Raises ``GateRefusal`` when its files are not those that were sealed.
    """
    folder = machine_folder(machine, home)
    if not folder.is_dir():
        raise InputError("nothing is delivered of this machine", code="pull.machine", got=machine[:80])
    with locked(folder):
        sealed = {name: read_sealed(folder, name) for name in _IN_ORDER}
        named: dict[str, str] = {}
        for pointer in _POINTERS:
            if (told := sealed[pointer]) is None:
                continue
            if named.setdefault(str(told["bundle"]), str(told["sha256"])) != told["sha256"]:
                # A kill came before the trial of what became champion was cleared.
                sealed[pointer] = None
        bundles = {
            name: read_bytes(named_file(folder, name, sha256), MAX_BYTES).decode() for name, sha256 in named.items()
        }
    return json.dumps({"machine": machine, "sealed": sealed, "bundles": bundles}).encode()


def install(home: Home, machine: str, content: bytes) -> bool:
    """Put what was delivered in force, whole or not at all, and return whether anything is new.

    It is tried in a folder beside first: pointers must name their bundles, and bundles hold on this processor.

    Raises ``DtwinError`` when it does not hold; what was in force stays.
    """
    where = Path("the delivery")
    fields = only_fields(parse_json(content, where), ("machine", "sealed", "bundles"), str(where))
    if text(fields["machine"], "machine") != machine:
        raise GateRefusal("another machine was delivered", code="pull.machine", got=str(fields["machine"])[:80])
    sealed = only_fields(fields["sealed"], _IN_ORDER, str(where))
    bundles = mapping(fields["bundles"], str(where))
    if not all(isinstance(content, str) and require_name(name, "the bundle") for name, content in bundles.items()):
        raise InputError("a delivered bundle is no text", code="pull.bundle")
    beside = Home(home.made().root / f".pulled-{secrets.token_hex(4)}")
    try:
        _write(beside, machine, sealed, bundles)
        for name, model in _POINTERS.items():
            if sealed[name] is not None:
                load_bundle(resolve(model, machine, beside, harmless=True).path, machine)
    finally:
        rmtree(beside.root, ignore_errors=True)
    return _write(home, machine, sealed, bundles)


def _write(home: Home, machine: str, sealed: Mapping[str, Any], bundles: Mapping[str, str]) -> bool:
    folder, new = machine_folder(machine, home), False
    with locked(folder):
        for name, content in bundles.items():
            path = folder / name
            if not path.exists() or hashlib.sha256(read_bytes(path, MAX_BYTES)).digest() != _digest(content):
                replace_bundle(path, partial(write_text, path, content, "the bundle"))
                new = True
        for name in _IN_ORDER:
            if _present(folder, name) != sealed[name]:
                write_sealed(folder, name, sealed[name])
                new = True
        forget_replaced(folder)
    return new


def _present(folder: Path, name: str) -> Any:
    try:
        return read_sealed(folder, name)
    except DtwinError:
        # Of an older delivery that a power cut spoilt, or of other hands: what is signed replaces it.
        return object()


def _digest(content: str) -> bytes:
    return hashlib.sha256(content.encode()).digest()


def _signed(key: bytes, what: bytes, nonce: str, content: bytes) -> str:
    return hmac.new(key, b"\n".join((what, nonce.encode(), content)), hashlib.sha256).hexdigest()
