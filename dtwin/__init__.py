"""A workshop for the accuracy of machine tools and robots; ``open_home`` is where a notebook begins."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dtwin.errors import DtwinError as DtwinError
    from dtwin.errors import InputError as InputError
    from dtwin.notebook.answers import ComparisonResult as ComparisonResult
    from dtwin.notebook.answers import DiagnosisResult as DiagnosisResult
    from dtwin.notebook.answers import IngestResult as IngestResult
    from dtwin.notebook.answers import TwinResult as TwinResult
    from dtwin.notebook.open_home import OpenHome as OpenHome
    from dtwin.notebook.open_home import open_home as open_home

__version__ = "0.1.0"

_PLACES = {
    "open_home": "notebook.open_home",
    "OpenHome": "notebook.open_home",
    "IngestResult": "notebook.answers",
    "TwinResult": "notebook.answers",
    "ComparisonResult": "notebook.answers",
    "DiagnosisResult": "notebook.answers",
    "DtwinError": "errors",
    "InputError": "errors",
}
__all__ = [*_PLACES]


def __getattr__(name: str) -> Any:
    """Import a name when it is asked for: a serving host has no pandas."""
    if name not in _PLACES:
        raise AttributeError(f"module 'dtwin' has no attribute {name!r}")
    try:
        return getattr(import_module(f"dtwin.{_PLACES[name]}"), name)
    except ModuleNotFoundError as error:
        from dtwin.errors import MissingPart

        raise MissingPart(
            "a notebook needs a package that is not installed here",
            code="package.missing",
            got=str(error.name),
            hint="pip install '.[report]' in a checkout of dtwin",
        ) from error


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
