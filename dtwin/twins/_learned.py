"""Formulas and maps that twins have learned, kept as text and found in the library by name; twins from their stored form."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from dtwin.atomic import write_text
from dtwin.documents import unknown_form
from dtwin.errors import InputError, StoreError
from dtwin.physics.contradictions import Contradiction
from dtwin.physics.effect import Effect, Instance
from dtwin.physics.fit import Estimate
from dtwin.physics.problem import Term
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import FORMAT, Twin, ValidityBox
from dtwin.train.residual_formula import PlaceMap, ResidualFormula, formula_effect, place_map_effect

_EFFECT = {"learned_formula_": formula_effect, "learned_map_": place_map_effect}
_NAME = re.compile(f"({'|'.join(_EFFECT)})[0-9a-f]{{8}}")


class WithLearned(Mapping[str, Effect]):
    """A library and the formulas and maps of a folder."""

    def __init__(self, library: Mapping[str, Effect], folder: Path) -> None:
        self.library, self.folder = library, folder

    def keep(self, learned: ResidualFormula | PlaceMap) -> str:
        """Keep a formula or a map and return its name."""
        prefix = "learned_map_" if isinstance(learned, PlaceMap) else "learned_formula_"
        name = _name_of(prefix, learned.text)
        document = json.dumps({"name": name, **vars(learned)}, indent=1)
        write_text(self.folder / f"{name}.json", document, "what was learned")
        return name

    def __getitem__(self, name: str) -> Effect:
        path = self.folder / f"{name}.json"
        match = _NAME.fullmatch(name)
        if match is None or not path.exists():
            return self.library[name]
        try:
            text = str(json.loads(path.read_text(encoding="utf-8"))["text"])
            if _name_of(match[1], text) != name:
                raise ValueError("it is not what was written")
            return _EFFECT[match[1]](name, text)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StoreError(
                "a learned effect cannot be read", code="twin.formula", where=str(path), got=str(error)[:120]
            ) from error

    def __contains__(self, name: object) -> bool:
        return name in self.library or (
            isinstance(name, str) and _NAME.fullmatch(name) is not None and (self.folder / f"{name}.json").exists()
        )

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the other effects: what was learned explains only its own twin."""
        return iter(self.library)

    def __len__(self) -> int:
        return len(self.library)


def _name_of(prefix: str, text: str) -> str:
    return prefix + hashlib.sha256(text.encode()).hexdigest()[:8]


_CONTRADICTION = tuple(field.name for field in fields(Contradiction))
_ABOUT = ("kind", "started", "weight")


def twin_from(document: Mapping[str, Any], library: Mapping[str, Effect], where: str) -> Twin:
    """Return a twin from its stored form. ``document``: what ``as_dict`` of a twin returned."""
    twin = _twin_from(document, library, where)
    if "campaigns" not in document:
        return twin
    return SeveralTwin(
        **vars(twin),
        parts=tuple(_twin_from(entry["part"], library, where) for entry in document["campaigns"]),
        about=tuple({name: entry[name] for name in _ABOUT} for entry in document["campaigns"]),
        contradictions=contradictions_from(document),
    )


def contradictions_from(document: Mapping[str, Any]) -> tuple[Contradiction, ...]:
    """Return the contradictions that a twin stores."""
    lists = ("campaigns", "others", "rivals")
    every = (
        {"missed": 0.0, **entry, **{name: tuple(entry.get(name, ())) for name in lists}}
        for entry in document["contradictions"]
    )
    return tuple(Contradiction(**{name: one[name] for name in _CONTRADICTION}) for one in every)


def _twin_from(document: Mapping[str, Any], library: Mapping[str, Effect], where: str) -> Twin:
    if document.get("format") != FORMAT:
        raise unknown_form("a twin", where, FORMAT, document.get("format"))
    terms = []
    for entry in document["effects"]:
        if entry["effect"] not in library:
            raise InputError(
                "the twin uses an effect that is not known here",
                code="twin.effect_source",
                where=where,
                got=entry["effect"],
                hint="--effects-path " + str(document["effect_sources"].get(entry["effect"], "FILE")),
            )
        effect = library[entry["effect"]]
        # A version before may not have known every shape parameter.
        terms.append(Term(Instance(effect, entry["axis"]), effect.completed(entry["shape"])))
    estimates = tuple(Estimate.of(e) for e in document["parameters"])
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
            tuple(box["planes"]),
            tuple(box["directions"]),
            (box["radius_mm"][0], box["radius_mm"][1]),
            (box["feed_mm_min"][0], box["feed_mm_min"][1]),
        ),
        figures=document["figures"],
        by_condition=tuple(document["by_condition"]),
        aliases=tuple(document["aliases"]),
        data=document["data"],
        effect_sources=document["effect_sources"],
    )
