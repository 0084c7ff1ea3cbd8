"""The error budget of a twin: of what was measured, and along a program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._effects import Paths, library_with
from dtwin.commands._exporting import numbers
from dtwin.commands._output import Json, emit
from dtwin.commands._twins import Name, twins_named
from dtwin.commands._twins import app as twin_app
from dtwin.config import home
from dtwin.errors import InputError

if TYPE_CHECKING:
    from dtwin.physics.twin import Twin


@twin_app.command("budget")
def error_budget(
    name: Name,
    campaign: Annotated[str | None, typer.Option("--on", help="Other measurements.")] = None,
    program: Annotated[Path | None, typer.Option(help="G-code: of this program instead of the measured paths.")] = None,
    origin: Annotated[
        str | None,
        typer.Option(help="With --program: X,Y,Z in mm, centre of the measured circles on this machine; 0,0,0."),
    ] = None,
    effects_path: Paths = None,
    as_json: Json = False,
) -> None:
    """How much of the error each cause makes, and what would be left after its remedy."""
    from dtwin.pipeline.reported_twin import diagnosed
    from dtwin.report.error_budget import budget_text
    from dtwin.report.faults import undecided_lines, undecided_of
    from dtwin.twins.budget_spread import spread_as_dict
    from dtwin.twins.of_kind import paths_of
    from dtwin.twins.verbs import Twins

    library = library_with(effects_path)
    twin = paths_of(home(), library, name)
    if program is not None:
        about, text = _of_program(twin, program, origin, campaign)
    elif origin is not None:
        raise InputError("--origin is of a program only", code="budget.origin", got=origin, hint="--program FILE")
    else:
        budget, spread = Twins(home(), library).budget(twin, campaign)
        about = {"campaign": campaign or twin.campaign, **spread_as_dict(budget, spread)}
        text = budget_text(budget, spread)
    shelf = twins_named(name, effects_path)
    diagnosis = diagnosed(shelf, shelf.newest(name))[1]
    payload = {"twin": name, "version": twin.version, **about, "undecided": undecided_of(diagnosis)}
    emit(payload, lambda: "\n".join([text, *undecided_lines(diagnosis)]), as_json=as_json)


def _of_program(twin: Twin, program: Path, origin: str | None, campaign: str | None) -> tuple[dict[str, Any], str]:
    import numpy as np

    from dtwin.lifecycle.gcode_program import program_of
    from dtwin.lifecycle.program_budget import program_budget, program_text

    if campaign is not None:
        raise InputError("either a program or other measurements", code="budget.on", got=f"--program, --on {campaign}")
    origin_mm = np.array(numbers(origin or "0,0,0", 3, "--origin"))
    budget = program_budget(twin, program_of(program), origin_mm=origin_mm, where=program.name)
    return {"program": str(program), **budget.as_dict()}, program_text(budget)
