"""The command that ingests what arrives in a folder: watch."""

from __future__ import annotations

import json
import shlex
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dtwin.config import home
from dtwin.errors import Interrupted

if TYPE_CHECKING:
    from dtwin.pipeline.watching import WatchEvent

app = typer.Typer()


@app.command()
def watch(
    folder: Annotated[Path, typer.Argument(help="Folder that instruments write to.")],
    machine: Annotated[
        list[str] | None, typer.Option(help="Machine to take in though the lake does not know it yet.")
    ] = None,
    settle: Annotated[float, typer.Option(min=0.0, help="Seconds for which a file must stand still.")] = 10.0,
    every: Annotated[float, typer.Option(min=0.05, help="Seconds between two looks.")] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="End when all that is there was taken or refused.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a line, nothing else.")] = False,
) -> None:
    """Ingest what arrives in a folder, until Ctrl-C (exit 130); run it again to go on.

    Campaign folders and .b5r files are taken once they stand still and can be read. A file of an
    unknown machine stays where it is, with a message.
    """
    from dtwin.pipeline.watching import FolderWatch
    from dtwin.pipeline.watching import watch as go_on
    from dtwin.serve.signals import stop_on_signals

    def tell(event: WatchEvent) -> None:
        text = f"{event.outcome}: {event.path}: {event.message}"
        print(json.dumps(event.as_dict()) if as_json else text, flush=True)

    folder_watch = FolderWatch(folder, home(), machine or (), settle)
    if not once:
        print(f"watching {folder}; Ctrl-C ends it", file=sys.stderr, flush=True)
    never = threading.Event()
    with stop_on_signals() as asked:

        def wait(seconds: float) -> bool:
            steps = max(1, round(seconds / 0.1))
            return any(asked() or never.wait(seconds / steps) for _ in range(steps)) or asked()

        go_on(folder_watch, tell, wait, every_s=every, once=once)
        stopped = asked()
    if stopped:
        raise Interrupted(
            "the watch has ended; what arrived is in the lake",
            code="watch.interrupted",
            where=str(folder),
            hint=shlex.join(["dtwin", *sys.argv[1:]]),
        )
