"""The command that keeps the pages up: up."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json
from dtwin.config import home

if TYPE_CHECKING:
    from dtwin.config import Home

HOURLY = "0 * * * *"
Port = Annotated[int | None, typer.Option(min=1, max=65535, help="A free one without.")]

app = typer.Typer()


@app.command()
def up(
    prefect_port: Port = None,
    mlflow_port: Port = None,
    cron: Annotated[str, typer.Option(help="When to train on new data: minute hour day month weekday.")] = HOURLY,
    no_schedule: Annotated[bool, typer.Option("--no-schedule", help="Train only when somebody starts it.")] = False,
    allow: Annotated[
        list[Path] | None, typer.Option(help="Folder besides DTWIN_HOME that flows started on the page may use.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Start the Prefect and MLflow pages on this computer; Ctrl-C stops them."""
    from dtwin.serve.signals import ending_signals
    from dtwin.twins.registration import log_waiting, waiting_text
    from flows.servers import UpRequest, servers

    times = None if no_schedule else _checked(cron)
    request = UpRequest(prefect_port, mlflow_port, times, tuple(allow or ()))
    # Both, also where a shell has switched one off for background jobs.
    for number in ending_signals():
        signal.signal(number, _as_interrupt)
    try:
        print("starting; the first time takes half a minute", file=sys.stderr, flush=True)
        left = log_waiting(home())
        if left:
            print(waiting_text(left), file=sys.stderr, flush=True)
        with servers(home(), request) as found:
            payload: dict[str, Any] = found.addresses | {"cron": times}
            shown = json.dumps(payload, indent=2) if as_json else _text(payload, home())
            print(shown, flush=True)
            found.watch()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)


def _checked(cron: str) -> str:
    from importlib.util import find_spec

    if find_spec("prefect") is None:
        return cron
    from flows.cron import require_cron

    return require_cron(cron)


def _text(payload: dict[str, Any], state: Home) -> str:
    when = payload["cron"] or "only when started from the Prefect page"
    return "\n".join(
        [
            f"Prefect  {payload.get('prefect_enter', payload['prefect'])}   flows, runs, tables, plots",
            f"MLflow   {payload.get('mlflow_enter', payload['mlflow'])}   versions, comparisons, gates",
            f"training on new data: {when}",
            f"logs     {state.logs}",
            "Ctrl-C stops everything",
        ]
    )


def _as_interrupt(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
