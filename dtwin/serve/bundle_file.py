"""Bundles on disk: written whole or not at all, proved before they are used."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from dtwin.atomic import whole_file, write_text
from dtwin.errors import GateRefusal, InputError
from dtwin.features.windows import WindowContract
from dtwin.serve.band import Band
from dtwin.serve.bundle import Bundle
from dtwin.serve.graph import Graph
from dtwin.serve.interface import Input, Output, Provenance, SafetyLimits, State, TestVectors
from dtwin.serve.proof import prove, with_vectors
from dtwin.serve.runtime import CompiledBundle

MAX_BYTES = 8_000_000


def create_bundle(
    *,
    name: str,
    machine: str,
    model_version: int,
    inputs: Sequence[Input],
    outputs: Sequence[Output],
    tick_graph: Graph,
    states: Sequence[State] = (),
    window: WindowContract | None = None,
    window_graph: Graph | None = None,
    safety: SafetyLimits | None = None,
    provenance: Provenance | None = None,
    corrects: str = "",
    band: Band | None = None,
) -> Bundle:
    """Return a bundle with its test vectors, proved on this host.

    Raises ``InputError`` when the parts do not fit together, or the model is not finite in its validity box.
    Raises ``GateRefusal`` when the tape and the slow evaluation disagree.
    """
    created = datetime.now(UTC).isoformat(timespec="seconds")
    bundle = Bundle(
        name,
        machine,
        model_version,
        created,
        tuple(inputs),
        tuple(outputs),
        tuple(states),
        window,
        window_graph,
        tick_graph,
        safety or SafetyLimits(),
        provenance or Provenance(),
        TestVectors((), (), ()),
        corrects,
        band,
    )
    proved = with_vectors(bundle)
    prove(proved)
    return proved


def save_bundle(bundle: Bundle, path: Path) -> Path:
    """Write a bundle atomically and return its path. Raises ``StoreError`` when the file cannot be written."""
    write_json(path, bundle.to_dict())
    return path


def replace_bundle(path: Path, write: Callable[[], object]) -> None:
    """Write a bundle anew, and keep what was there under its checksum: a pointer names it until it names the new one."""
    if path.is_file():
        raw = read_bytes(path, MAX_BYTES)
        with whole_file(replaced(path, hashlib.sha256(raw).hexdigest()), "the bundle of before") as beside:
            beside.touch(mode=0o600)
            beside.write_bytes(raw)
    write()


def replaced(path: Path, sha256: str) -> Path:
    """Return where a bundle lies that was written anew, while a pointer may still name it."""
    return path.with_name(f"{path.stem}.{sha256[:12]}{path.suffix}")


def load_bundle(path: Path, machine: str | None = None) -> CompiledBundle:
    """Read, check and prove a bundle, and compile it.

    Args:
        machine: Machine that will be served; a bundle of another one is refused.

    Raises:
        InputError: When the file is missing, malformed, too large or was changed.
        GateRefusal: When it belongs to another machine, or its test vectors do not hold here.
    """
    bundle = Bundle.from_dict(read_json(path, MAX_BYTES))
    if machine is not None and bundle.machine != machine:
        raise GateRefusal(
            "the bundle was made for another machine",
            code="bundle.machine",
            where=str(path),
            got=bundle.machine,
            allowed=machine,
        )
    prove(bundle)
    return CompiledBundle(bundle)


def json_text(content: Mapping[str, Any]) -> str:
    """Return the text that ``write_json`` writes."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON so that a reader sees the old file or the new one, never a part.

    Raises ``StoreError`` when the folder cannot be written.
    """
    write_text(path, json_text(content), "the file", private=True)


def read_json(path: Path, max_bytes: int) -> Any:
    """Read a JSON file of bounded size, refusing NaN, infinity and repeated names.

    Raises ``InputError`` when it is missing, too large, or not such JSON.
    """
    return parse_json(read_bytes(path, max_bytes), path)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a file of bounded size. Raises ``InputError`` when it is missing, unreadable or too large."""
    try:
        if path.exists() and not path.is_file():
            # A pipe would be waited for, and a device has no end.
            raise OSError("no regular file")
        with path.open("rb") as file:
            raw = file.read(max_bytes + 1)
    except OSError as error:
        raise InputError(
            "the file cannot be read",
            code="bundle.missing",
            where=str(path),
            got=error.strerror or str(error),
            hint="dtwin promote writes it",
        ) from error
    if len(raw) > max_bytes:
        raise InputError("the file is too large", code="bundle.size", where=str(path), allowed=f"{max_bytes} bytes")
    return raw


def parse_json(raw: bytes, path: Path) -> Any:
    """Return what JSON says, refusing NaN, infinity and repeated names.

    Raises ``InputError`` when it is not such JSON.
    """
    try:
        return json.loads(raw, parse_constant=_refuse_constant, object_pairs_hook=_unrepeated)
    except (ValueError, RecursionError) as error:
        raise InputError(
            "the file is not usable JSON", code="bundle.json", where=str(path), got=str(error)[:120]
        ) from error


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a number that a bundle may hold")


def _unrepeated(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len({name for name, _ in pairs}) != len(pairs):
        raise ValueError("a name is given twice")
    return dict(pairs)
