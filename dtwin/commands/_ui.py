"""The command that opens the workbench: ui."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json
from dtwin.config import home
from dtwin.errors import InputError

LOOPBACK = "127.0.0.1"

app = typer.Typer()


@app.command()
def ui(
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="8765, or a free one when it is taken.")] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to listen on; others than loopback let others in.")] = LOOPBACK,
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
            import webbrowser

            webbrowser.open(address)

    own = None if effects_path is None else effects_path.absolute()
    # Over before the process may end at once.
    with following(home()), only_one(home()), listening(host, port) as bound:
        from dtwin.workbench.server import run

        # The server has ended in order by then, and raises the signal once more.
        with contextlib.suppress(KeyboardInterrupt):
            run(home(), host, bound, own, announce, private=private)
    print("stopped", file=sys.stderr, flush=True)
    if threading.active_count() > 1:
        # A thread that still reads or fits must not meet an interpreter that is taken apart:
        # it would end in a segmentation fault. What it stores is whole or absent.
        sys.stdout.flush()
        os._exit(0)
