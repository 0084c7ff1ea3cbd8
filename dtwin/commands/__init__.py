"""The commands of ``dtwin``; heavy imports happen inside their bodies."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

import typer

__all__ = ["register"]
_STUDIES = "studies.commands"


def register(app: typer.Typer) -> None:
    """Add every command to the application: each module here, and of the studies, that has an ``app`` adds its own."""
    packages = [import_module(name) for name in (__name__, _STUDIES)]
    modules = [import_module(f"{p.__name__}.{found.name}") for p in packages for found in iter_modules(p.__path__)]
    for module in modules:
        if hasattr(module, "app"):
            app.add_typer(module.app)
