"""The commands of ``dtwin``; heavy imports happen inside their bodies."""

from __future__ import annotations

import typer

from dtwin.commands import (
    _alerts,
    _amending,
    _analogue,
    _campaign,
    _cell,
    _certificate,
    _data,
    _demo,
    _dynamics,
    _effects,
    _evidence,
    _exporting,
    _fleet,
    _home,
    _importing,
    _lathe,
    _linuxcnc,
    _machine,
    _machine_tests,
    _models,
    _papers,
    _people,
    _planning,
    _rechecking,
    _record,
    _servers,
    _serving,
    _simulating,
    _single,
    _turning,
    _twins,
    _ui,
    _volumetric,
    _watch,
)

__all__ = ["register"]

# Help lists what no task names in this order.
_MODULES = (
    _demo,
    _data,
    _planning,
    _amending,
    _record,
    _campaign,
    _watch,
    _simulating,
    _models,
    _evidence,
    _rechecking,
    _serving,
    _twins,
    _effects,
    _machine,
    _fleet,
    _alerts,
    _certificate,
    _analogue,
    _linuxcnc,
    _cell,
    _lathe,
    _turning,
    _volumetric,
    _papers,
    _dynamics,
    _exporting,
    _importing,
    _servers,
    _home,
    _people,
    _ui,
)


def register(app: typer.Typer) -> None:
    """Add every command to the application."""
    _twins.app.add_typer(_single.app)
    _machine.app.add_typer(_machine_tests.app)
    for module in _MODULES:
        app.add_typer(module.app)
