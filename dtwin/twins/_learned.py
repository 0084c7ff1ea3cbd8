"""Formulas and maps that twins have learned, kept as text and found in the library by name."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from dtwin.atomic import write_text
from dtwin.errors import StoreError
from dtwin.physics.effect import Effect
from dtwin.train.place_map import PlaceMap, place_map_effect
from dtwin.train.residual_formula import ResidualFormula, formula_effect

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
        found = _NAME.fullmatch(name)
        if found is None or not path.exists():
            return self.library[name]
        try:
            text = str(json.loads(path.read_text(encoding="utf-8"))["text"])
            if _name_of(found[1], text) != name:
                raise ValueError("it is not what was written")
            return _EFFECT[found[1]](name, text)
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
