"""The list of commands, by what a user wants to do."""

from __future__ import annotations

import sys
from copy import copy
from typing import Any

import typer
from typer.core import TyperGroup
from typer.models import TyperInfo

from dtwin.errors import CommandLineError

_TASKS: dict[str, tuple[str, ...]] = {
    "Begin": ("demo", "ui", "examples", "simulate"),
    "Measure": (
        "machine",
        "plan",
        "campaign",
        "record",
        "watch",
        "check",
        "import",
        "ingest",
        "runs",
        "amend",
        "leave-out",
        "restore",
        "repair",
        "migrate",
    ),
    "Understand": ("twin", "fleet", "alert", "effects", "dynamics", "report", "certificate", "papers"),
    "Correct": (
        "features",
        "train",
        "models",
        "evidence",
        "promote",
        "recheck",
        "rollback",
        "lathe",
        "turning",
        "volumetric",
    ),
    "Run": (
        "serve",
        "robot-program",
        "robot-targets",
        "export",
        "analogue",
        "linuxcnc",
        "cell",
        "up",
        "home",
        "people",
    ),
}
_TWIN_TASKS: dict[str, tuple[str, ...]] = {
    "Fit and look": ("fit", "compare", "recording", "show", "history", "budget"),
    "Find what is missing": ("diagnose", "discover", "learn"),
    "Change": ("add", "remove", "restore"),
    "Prove and use": ("confirm", "correct"),
}
_FLEET_TASKS: dict[str, tuple[str, ...]] = {
    "Do for every machine": ("diagnose", "train", "recheck", "nightly"),
    "Look": ("show", "sisters"),
}
_OTHER = "More"
_LONGEST = 200
# Typer has no public name for it.
_WrongUse: Any = typer.BadParameter.__base__


class EndedEarly(Exception):
    """Ctrl-C, or a reader of our output that went away: its cause. Typer would end both without a word."""


def _sections(tasks: dict[str, tuple[str, ...]], names: list[str]) -> dict[str, list[str]]:
    """Return commands by task; one that nobody has put anywhere is shown all the same."""
    placed = {name for task in tasks.values() for name in task}
    by_title = {title: [n for n in task if n in names] for title, task in tasks.items()}
    by_title[_OTHER] = [n for n in names if n not in placed]
    return {title: task for title, task in by_title.items() if task}


class Commands(typer.Typer):
    """The tree of commands, of which a process builds only the branch that it was asked for: all takes a tenth of a second."""

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        """Run the command line of this process."""
        asked = sys.argv[1] if len(sys.argv) > 1 else ""
        holding = [branch for branch in self.registered_groups if asked in _branch_names(branch)]
        alone = copy(self)
        if holding and not arguments and not settings:
            alone.registered_groups = holding
        return super(Commands, alone).__call__(*arguments, **settings)


def _branch_names(branch: TyperInfo) -> list[str]:
    """Return the names by which the command line knows a group, or the commands of one without a name."""
    held = branch.typer_instance
    if held is None:
        return []
    if isinstance(held.info.name, str):
        return [held.info.name]
    named = [command.name or getattr(command.callback, "__name__", "") for command in held.registered_commands]
    return [name.lower().replace("_", "-") for name in named]


class ByTask(TyperGroup):
    """Commands of ``dtwin``."""

    tasks = _TASKS

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a program that asked for JSON is told in JSON what is wrong with its command line."""
        try:
            done = super().invoke(ctx)
            sys.stdout.flush()
        except _WrongUse as error:
            if "--json" not in sys.argv:
                raise
            where = error.ctx.command_path if error.ctx else None
            raise CommandLineError(error.format_message(), code="usage", where=where) from error
        except (KeyboardInterrupt, BrokenPipeError) as error:
            raise EndedEarly from error
        return done

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section for each task, whole sentences instead of cut ones."""
        width = max(map(len, self.commands))
        for title, names in _sections(self.tasks, self.list_commands(ctx)).items():
            with formatter.section(title):
                formatter.write_dl(
                    [(f"{name:<{width}}", self.commands[name].get_short_help_str(_LONGEST)) for name in names]
                )


class TwinCommands(ByTask):
    """Commands of ``dtwin twin``."""

    tasks = _TWIN_TASKS


class FleetCommands(ByTask):
    """Commands of ``dtwin fleet``."""

    tasks = _FLEET_TASKS
