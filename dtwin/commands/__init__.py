"""The commands of ``dtwin``; heavy imports happen inside their bodies."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

import typer

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add every command to the application: each module that has an ``app`` adds its own."""
    modules = [import_module(f"{__name__}.{found.name}") for found in iter_modules(__path__)]
    for module in modules:
        if hasattr(module, "app"):
            app.add_typer(module.app)
