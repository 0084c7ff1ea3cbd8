"""Commands that take in files: import makes a campaign folder of a foreign table, watch ingests what arrives in a folder."""

from __future__ import annotations

import json
import shlex
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dtwin.commands._output import Json, emit
from dtwin.commands._told import tells_a_table
from dtwin.config import home
from dtwin.errors import InputError, Interrupted

if TYPE_CHECKING:
    from dtwin.acquire.importing import Understood
    from dtwin.pipeline.watching import WatchEvent

app = typer.Typer()


@app.command("import")
@tells_a_table("pitch", "instrument")
def import_table(
    source: Annotated[Path, typer.Argument(help="A table of text, in any dialect, or a spreadsheet.")],
    told: Mapping[str, Any],
    out: Annotated[Path | None, typer.Option(help="Campaign folder to make; without, nothing is written.")] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            help="HEAD=NAME: what a column is here, with the unit that it has in the file; HEAD= leaves it out."
        ),
    ] = None,
    decimal: Annotated[
        str, typer.Option(help="comma or point, where it is not seen; the other one then parts digits into groups.")
    ] = "",
    as_remembered: Annotated[
        bool, typer.Option("--as-remembered", help="The conditions of the earlier file hold for this one, too.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Say what a foreign table is taken for; with --out make a campaign folder of it, and remember the answers."""
    from dtwin.acquire.importing import understand, write_folder

    understood = understand(source, home(), told, _answers(column or []), decimal)
    toml = None if out is None else write_folder(understood, out, home(), confirmed=as_remembered)
    payload = {**understood.as_dict(), "written": None if toml is None else str(toml)}
    emit(payload, lambda: _text(understood, out), as_json=as_json)


def _answers(pairs: list[str]) -> dict[str, str]:
    parted = [pair.rpartition("=") for pair in pairs]
    wrong = [
        pair
        for pair, (_, mark, name) in zip(pairs, parted, strict=True)
        if not mark or (name and not name.isidentifier())
    ]
    if wrong:
        raise InputError(
            "--column does not say what a column is",
            code="import.column",
            got=wrong[0][:60],
            allowed='"HEAD=NAME", such as "Weg=position_mm"',
        )
    return {head.strip(): name for head, _, name in parted}


def _text(understood: Understood, out: Path | None) -> str:
    from dtwin.report.text import counted

    as_dict = understood.as_dict()
    lines = [f"{understood.path.name}: {understood.encoding}, columns parted by {as_dict['parted_by']}"]
    if understood.skipped:
        lines[0] += f", lines above the heads: {understood.skipped}"
    if understood.remembered:
        lines.append(f"  what was answered for {understood.remembered}, which has the same heads, is used")
    for c in understood.columns:
        unit = f" [{c.unit}]" if c.unit and c.unit not in c.head else ""
        less = f", less {c.zero:g}" if c.zero else ""
        factor = f"{less}, times {c.factor:.6g}" if c.factor != 1.0 else ""
        lines.append(
            f"  {c.head}{unit} -> {c.name}{factor}" if c.name else f"  {c.head}{unit} is left out: {c.why_not}"
        )
    if not understood.columns:
        lines.append(f"  {', '.join(understood.header)[:200]}: read as a table of its own form")
    told = {"kind": understood.kind, **understood.told}
    lines.append("  " + "; ".join(f"{name} {value}" for name, value in told.items()))
    if understood.missing:
        lines.append(f"  missing: {', '.join(understood.missing)}")
    if understood.unconfirmed and out is None:
        said = ", ".join(f"{name} {understood.told[name]}" for name in understood.unconfirmed)
        lines.append(f"  only {understood.remembered} tells {said}: --as-remembered confirms it for this file")
    if understood.runs:
        rows = sum(n for _, n in understood.runs)
        lines.append(
            f"  {counted(len(understood.runs), 'run')}, {counted(rows, 'row')}: {', '.join(name for name, _ in understood.runs)[:120]}"
        )
    lines.append(
        "nothing is written; --out FOLDER makes a campaign of it"
        if out is None
        else f"{out} written: dtwin check {out}"
    )
    return "\n".join(lines)


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
    from dtwin.serve.realtime import stop_on_signals

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
