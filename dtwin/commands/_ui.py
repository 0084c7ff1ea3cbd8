"""Commands that open pages: ui the workbench, up those of MLflow and Prefect."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.atomic import write_text
from dtwin.commands._output import Json
from dtwin.config import home
from dtwin.errors import DtwinError, InputError

if TYPE_CHECKING:
    from dtwin.config import Home

_LOOPBACK = "127.0.0.1"
_OPENING = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>dtwin</title>'
    '<meta http-equiv="refresh" content="0; url={to}"><p><a href="{to}">To the workbench</a></p>'
)

app = typer.Typer()


@app.command()
def ui(
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="8765, or a free one when it is taken.")] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to listen on; others than loopback let others in.")] = _LOOPBACK,
    effects_path: Annotated[
        Path | None, typer.Option(help="Folder of your own effects, to edit in the browser; their code is run.")
    ] = None,
    private: Annotated[
        bool, typer.Option("--private", help="Reading needs the token too: where several people use the computer.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Open the workbench in a browser: ingest, fit, compare, diagnose, add; Ctrl-C stops it."""
    if effects_path is not None and not effects_path.is_dir():
        raise InputError(
            "no such folder for effects", code="ui.effects_path", where=str(effects_path), hint=f"mkdir {effects_path}"
        )
    from dtwin.shared_documents import following
    from dtwin.workbench.listening_socket import listening, only_one

    def announce(address: str) -> None:
        shown = json.dumps({"address": address, "home": str(home().root)}, indent=2)
        text = f"workbench  {address}\nCtrl-C stops it"
        print(shown if as_json else text, flush=True)
        if not no_browser:
            _open(address, opening)

    opening = home().root / "workbench" / "open.html"
    own = None if effects_path is None else effects_path.absolute()
    # Over before the process may end at once.
    with following(home()), only_one(home()), listening(host, port) as bound:
        from dtwin.workbench.server import run

        # The server has ended in order by then, and raises the signal once more.
        with contextlib.suppress(KeyboardInterrupt):
            run(home(), host, bound, own, announce, private=private)
        opening.unlink(missing_ok=True)
    print("stopped", file=sys.stderr, flush=True)
    if threading.active_count() > 1:
        # A thread that still reads or fits must not meet an interpreter that is taken apart:
        # it would end in a segmentation fault. What it stores is whole or absent.
        sys.stdout.flush()
        os._exit(0)


def _open(address: str, opening: Path) -> None:
    """Open an address in a browser by a file that leads there.

    Every user of a computer sees the words of its commands; the token in them would be everybody's.
    """
    import html
    import webbrowser

    # Without room for it, the address that was printed is pressed.
    with contextlib.suppress(DtwinError):
        write_text(opening, _OPENING.format(to=html.escape(address)), "the way into the workbench", private=True)
        webbrowser.open(opening.as_uri())


_HOURLY = "0 * * * *"
_Port = Annotated[int | None, typer.Option(min=1, max=65535, help="A free one without.")]


@app.command()
def up(
    prefect_port: _Port = None,
    mlflow_port: _Port = None,
    cron: Annotated[str, typer.Option(help="When to train on new data: minute hour day month weekday.")] = _HOURLY,
    no_schedule: Annotated[bool, typer.Option("--no-schedule", help="Train only when somebody starts it.")] = False,
    allow: Annotated[
        list[Path] | None, typer.Option(help="Folder besides DTWIN_HOME that flows started on the page may use.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Start the Prefect and MLflow pages on this computer; Ctrl-C stops them."""
    from dtwin.serve.realtime import ending_signals
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
        with servers(home(), request) as running:
            payload: dict[str, Any] = running.addresses | {"cron": times}
            shown = json.dumps(payload, indent=2) if as_json else _text(payload, home())
            print(shown, flush=True)
            running.watch()
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
