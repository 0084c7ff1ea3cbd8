"""Twins as files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.atomic import write_text
from dtwin.errors import InputError, StoreError
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.fit import Estimate
from dtwin.physics.problem import Term
from dtwin.physics.twin import FORMAT, Twin, ValidityBox

_SEAL = "sha256"


def twin_from(document: Mapping[str, Any], library: Mapping[str, Effect], where: str) -> Twin:
    """Return a twin from its stored form.

    Parameters
    ----------
    document : dict
        What ``Twin.as_dict`` returned.
    library : mapping of str to Effect
        Effects by name.
    where : str
        The file, for messages.

    Raises
    ------
    StoreError
        When the document is not a twin.
    InputError
        When it uses an effect that is not in the library.
    """
    if document.get("format") != FORMAT:
        raise StoreError(
            "this is not a twin", code="twin.format", where=where, allowed=FORMAT,
            got=str(document.get("format"))[:40],
        )  # fmt: skip
    terms = []
    for entry in document["effects"]:
        if entry["effect"] not in library:
            raise InputError(
                "the twin uses an effect that is not known here",
                code="twin.effect_source",
                where=where,
                got=entry["effect"],
                hint="--effects-path "
                + str(document["effect_sources"].get(entry["effect"], "FILE")),
            )
        effect = library[entry["effect"]]
        terms.append(Term(Instance(effect, entry["axis"]), entry["shape"]))
    estimates = tuple(
        Estimate(**(e | {"uncertainty": _number(e["uncertainty"]), "value": _number(e["value"])}))
        for e in document["parameters"]
    )
    box = document["box"]
    return Twin(
        name=document["twin"],
        version=document["version"],
        machine=document["machine"],
        campaign=document["campaign"],
        action=document["action"],
        terms=tuple(terms),
        estimates=estimates,
        setups=tuple(document["setups"]),
        box=ValidityBox(
            tuple(box["planes"]), tuple(box["directions"]),
            (box["radius_mm"][0], box["radius_mm"][1]),
            (box["feed_mm_min"][0], box["feed_mm_min"][1]),
        ),
        figures=document["figures"],
        by_condition=tuple(document["by_condition"]),
        aliases=tuple(document["aliases"]),
        data=document["data"],
        effect_sources=document["effect_sources"],
    )  # fmt: skip


def write_document(path: Path, document: Mapping[str, Any], what: str) -> None:
    """Write a JSON document with a hash of itself; NaN becomes null.

    Parameters
    ----------
    path : Path
        File to write or replace.
    document : mapping
        JSON-ready but for NaN.
    what : str
        What it is, for the error message.
    """
    # As it will be read back, keys and tuples included.
    content = json.loads(json.dumps(finite(document)))
    sealed = {**content, _SEAL: _digest(content)}
    write_text(path, json.dumps(sealed, indent=1), what)


def read_document(path: Path) -> dict[str, Any]:
    """Return a stored JSON document, after comparing it with its hash.

    Raises
    ------
    StoreError
        When it cannot be read, or is not what was written.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        seal = found.pop(_SEAL, None) if isinstance(found, dict) else None
        if seal is None or seal != _digest(found):
            raise ValueError("it is not what was written")
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(
            "a stored document cannot be read",
            code="twin.damaged",
            where=str(path),
            got=str(error)[:120],
            hint="restore the file from a backup, or remove it and fit again",
        ) from error
    return dict(found)


def _digest(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def finite(value: Any) -> Any:
    """Return the value with NaN as null, which JSON knows."""
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value
