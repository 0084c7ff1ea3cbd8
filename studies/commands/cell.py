"""Commands for the cell: robot and mill as one job."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import EXIT_INTERRUPTED
from dtwin.report.text import table

app = typer.Typer(name="cell", help="The cell: robot and mill as one job, on virtual machines.", no_args_is_help=True)
_Cell = Annotated[str, typer.Option(help="Name of the cell.")]


@app.command("run")
def run(
    cell: _Cell = "demo",
    parts: Annotated[int, typer.Option(help="Parts to make.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of both virtual machines.")] = 0,
    as_json: Json = False,
) -> None:
    """Begin a job: load, hold, mill four quarters, unload, for every part."""
    _run(cell, {"parts": parts, "seed": seed}, as_json=as_json)


@app.command("resume")
def resume(cell: _Cell = "demo", as_json: Json = False) -> None:
    """Go on with a job that was stopped or interrupted."""
    _run(cell, {"resume": True}, as_json=as_json)


@app.command("status")
def status(cell: _Cell = "demo", as_json: Json = False) -> None:
    """Show every step, the twin that is live, and whether the job runs."""
    from studies.cell import status as seen_now
    from studies.cell_state import CellFile

    seen = seen_now(CellFile(home(), cell))
    emit(seen, lambda: _text(seen), as_json=as_json)


@app.command("stop")
def stop(
    cell: _Cell = "demo",
    reason: Annotated[str, typer.Option(help="Kept with the run.")] = "stopped by the operator",
    as_json: Json = False,
) -> None:
    """Ask a running job to stop when its step is done: no machine is left in the middle."""
    from studies.cell_state import CellFile

    CellFile(home(), cell).ask_to_stop(reason)
    emit({"cell": cell, "stop_asked": reason}, lambda: f"asked: {reason}", as_json=as_json)


@app.command("clear")
def clear(cell: _Cell = "demo", as_json: Json = False) -> None:
    """Forget the job of a cell that is not running."""
    from studies.cell_state import CellFile

    CellFile(home(), cell).clear()
    emit({"cell": cell, "cleared": True}, lambda: f"cell {cell} has no job now", as_json=as_json)


def _run(cell: str, parameters: Mapping[str, Any], *, as_json: bool) -> None:
    from flows._runtime import delivered
    from flows._runtime import run as run_flow
    from flows.cell import cell_flow
    from studies.cell import status as seen_now
    from studies.cell_state import CellFile

    with delivered():
        run_flow(cell_flow, cell=cell, **parameters)
    seen = seen_now(CellFile(home(), cell))
    emit(seen, lambda: _text(seen), as_json=as_json)
    if seen["condition"] != "done":
        typer.echo(f"stopped before: {seen['next']}; dtwin cell resume --cell {cell}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED)


def _text(seen: Mapping[str, Any]) -> str:
    from studies.cell import step_rows

    head = ("part", "step", "its twin", "state", "s", "error without, µm", "error, µm")
    asked = f"; asked to stop: {seen['stop_asked']}" if seen["stop_asked"] else ""
    return "\n".join(
        [
            f"cell {seen['cell']}: {seen['condition']}, {seen['done_steps']} of "
            f"{len(seen['steps'])} steps; live twin: {seen['live_twin']}{asked}",
            table(head, step_rows(seen)),
        ]
    )
