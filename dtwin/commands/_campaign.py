"""The command that measures a campaign on a machine, test by test: campaign."""

from __future__ import annotations

import select
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.report.text import table

if TYPE_CHECKING:
    from dtwin.pipeline.desk import Desk

app = typer.Typer()


@app.command()
def campaign(
    plan: Annotated[Path, typer.Argument(help="Plan file (TOML) of circles.")],
    inbox: Annotated[Path, typer.Option(help="Folder that the ball bar's program saves its .b5r files in.")],
    out: Annotated[Path | None, typer.Option(help="Campaign folder; by default below DTWIN_HOME/campaigns.")] = None,
    sensors: Annotated[
        Path | None, typer.Option(help="Channel file of accelerometers to record meanwhile (TOML).")
    ] = None,
    robot: Annotated[str | None, typer.Option(help="Address of a UR controller to record meanwhile.")] = None,
    version: Annotated[
        str | None,
        typer.Option("--with", help="Version on trial, or champion: each test without and with it, by turns."),
    ] = None,
    settle: Annotated[float, typer.Option(min=0.0, help="Seconds for which a file must stand still.")] = 10.0,
    as_json: Json = False,
) -> None:
    """Measure a plan on a machine: hand out each program, record, take and judge the file.

    A test ends when its file has arrived, or when you type done. A spoilt one can be repeated.
    Ctrl-C keeps what is there (exit 130); the same command goes on. With --with the runs are
    evidence for the version.
    """
    from dtwin.pipeline.campaign_job import CampaignRequest, run_request
    from dtwin.plan import read_plan
    from dtwin.serve.realtime import stop_on_signals

    request = CampaignRequest(read_plan(plan), inbox, out, sensors, robot, version, settle)
    with stop_on_signals() as asked:
        done = run_request(home(), request, _desk, asked)
    emit(done, lambda: _text(done), as_json=as_json)


def _desk(folder: Path) -> Desk:
    from dtwin.pipeline.desk import Desk

    return Desk(folder, lambda line: print(line, file=sys.stderr, flush=True), _typed_line)


def _typed_line() -> str | None:
    """Return a line that was typed, None while there is none; never waits."""
    try:
        ready, _, _ = select.select([sys.stdin], [], [], 0.0)
        line = sys.stdin.readline() if ready else ""
    except (OSError, ValueError):
        return None
    return line if line else None


def _text(done: dict[str, Any]) -> str:
    from dtwin.report.campaign import evidence_advice, evidence_table

    lines = [
        f"{done['campaign']}: {done['measured']} tests measured, {done['kept']} kept from before, "
        f"{done['set_aside']} put aside; {done['added']} runs added to the lake"
    ]
    if done["evidence"]:
        lines += [
            table(*evidence_table(done["evidence"])),
            *done["evidence"]["told"],
            evidence_advice(done["evidence"], done["version"], done["machine"]),
        ]
    else:
        lines.append(f"next: dtwin check {done['folder']}")
    return "\n".join(lines)
