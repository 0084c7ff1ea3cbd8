"""The commands of ``dtwin``; heavy imports happen inside their bodies."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules

import typer

__all__ = ["register"]
_ENTRY_POINTS = "dtwin.commands"
"""Group of the packages of others whose modules add commands; the studies are one."""


def register(app: typer.Typer) -> None:
    """Add every command to the application: each module here, and in a package of an entry point, that has an ``app`` adds its own."""
    packages = [import_module(__name__), *(entry.load() for entry in entry_points(group=_ENTRY_POINTS))]
    modules = [
        import_module(f"{p.__name__}.{module_info.name}") for p in packages for module_info in iter_modules(p.__path__)
    ]
    for module in modules:
        if hasattr(module, "app"):
            app.add_typer(module.app)
