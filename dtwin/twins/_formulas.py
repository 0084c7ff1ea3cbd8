"""Formulas that twins have learned, kept as text and found in the library by name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from dtwin.atomic import write_text
from dtwin.errors import StoreError
from dtwin.physics.effect import Effect
from dtwin.train.residual_formula import ResidualFormula, formula_effect

_PREFIX = "learned_formula_"


class WithFormulas(Mapping[str, Effect]):
    """A library and the formulas of a folder."""

    def __init__(self, library: Mapping[str, Effect], folder: Path) -> None:
        self.library, self.folder = library, folder

    def keep(self, formula: ResidualFormula) -> str:
        """Keep a formula and return its name."""
        name = _name_of(formula.text)
        document = json.dumps({"name": name, **vars(formula)}, indent=1)
        write_text(self.folder / f"{name}.json", document, "the formula")
        return name

    def __getitem__(self, name: str) -> Effect:
        path = self.folder / f"{name}.json"
        if not name.startswith(_PREFIX) or not path.exists():
            return self.library[name]
        try:
            text = str(json.loads(path.read_text(encoding="utf-8"))["text"])
            if _name_of(text) != name:
                raise ValueError("it is not the formula that was written")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise StoreError(
                "a learned formula cannot be read", code="twin.formula", where=str(path), got=str(error)[:120]
            ) from error
        return formula_effect(name, text)

    def __contains__(self, name: object) -> bool:
        return name in self.library or (self.folder / f"{name}.json").exists()

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the other effects: a formula explains only its own twin."""
        return iter(self.library)

    def __len__(self) -> int:
        return len(self.library)


def _name_of(text: str) -> str:
    return _PREFIX + hashlib.sha256(text.encode()).hexdigest()[:8]
