"""Commands about a home: what it holds, whether it is sound, a backup, a move, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, ProgressLine, emit
from dtwin.config import home
from dtwin.errors import EXIT_USER, InputError
from dtwin.report.text import table

app = typer.Typer(
    name="home", no_args_is_help=True, help="What DTWIN_HOME holds, whether it is sound, a backup, and back."
)


@app.command()
def show(as_json: Json = False) -> None:
    """Show where the home is and what its parts take."""
    from dtwin.pipeline.home_check import home_parts, shared_parts

    where = home()
    parts, shared = home_parts(where), shared_parts(where)
    payload = {"root": str(where.root), "mlflow": where.mlflow_uri, "engine": where.engine, "parts": parts}
    if where.file.as_dict():
        payload["shared"] = where.file.as_dict() | {"parts": shared}
    every = {**parts, **{f"{where.file.store}/{name}": part for name, part in shared.items()}}
    rows = [[name, part["files"], f"{part['bytes'] / 1e6:z.1f}"] for name, part in every.items()]

    def text() -> str:
        head = f"home    {where.root}\nMLflow  {where.mlflow_uri}\nengine  {where.engine}"
        head += f"\nstore   {where.file.store}" if where.file.store else ""
        head += f"\nflows   {where.file.flows}" if where.file.flows else ""
        return f"{head}\n\n{table(('part', 'files', 'MB'), rows)}" if rows else f"{head}\n\nnothing is kept here yet"

    emit(payload, text, as_json=as_json)


@app.command()
def check(as_json: Json = False) -> None:
    """Read every run, document, database and bundle, and compare it with its hash (exit 1 when one is damaged)."""
    from dtwin.pipeline.home_check import check_home

    checked = check_home(home(), ProgressLine("runs", quiet=as_json))

    def text() -> str:
        counts = ", ".join(f"{count} {name}" for name, count in checked.looked_at.items())
        return "\n".join([f"looked at {counts}", *(f"damaged: {n}: {w}" for n, w in checked.wrong.items())])

    emit(vars(checked), text, as_json=as_json)
    if checked.wrong:
        raise typer.Exit(EXIT_USER)


@app.command()
def backup(
    out: Annotated[Path, typer.Argument(help="File to write, such as home-2026-11-24.tar.")], as_json: Json = False
) -> None:
    """Write all that the home holds to one file; caches and logs are left out."""
    from dtwin.pipeline.home_archive import backup as write

    made = write(home(), out, ProgressLine("files", quiet=as_json))
    emit(vars(made), lambda: f"{made.files} files, {made.bytes / 1e6:z.1f} MB: {made.path}", as_json=as_json)


@app.command()
def restore(
    archive: Annotated[Path, typer.Argument(help="What dtwin home backup wrote.")], as_json: Json = False
) -> None:
    """Make DTWIN_HOME, which must not be there, from a backup; every file is compared with its hash."""
    from dtwin.pipeline.home_archive import restore as read

    made = read(archive, home(), ProgressLine("files", quiet=as_json))

    def text() -> str:
        back = f"{made.files} files, {made.bytes / 1e6:z.1f} MB are back in {made.path}"
        return "\n".join([back, *(f"left by a restore that was killed, remove it: {folder}" for folder in made.left)])

    emit(vars(made), text, as_json=as_json)


@app.command()
def key(as_json: Json = False) -> None:
    """Make the key by which hosts that serve machines prove that they may fetch bundles, and say where it is."""
    from dtwin.serve.delivery import make_key

    path = make_key(home())
    emit(
        {"key": str(path)},
        lambda: (
            f"{path}\ncopy it to DTWIN_HOME of each serving host; there: dtwin serve --machine NAME --pull http://HOST:PORT"
        ),
        as_json=as_json,
    )


@app.command()
def move(
    store: Annotated[str | None, typer.Option(help="To this store: s3://bucket/prefix.")] = None,
    registry: Annotated[
        str | None, typer.Option(help="Models go there: postgresql://user@host/database, or an MLflow server.")
    ] = None,
    endpoint: Annotated[
        str | None, typer.Option(help="Address of the store's server, where it is not Amazon's.")
    ] = None,
    flows: Annotated[str | None, typer.Option(help="Flows go there: postgresql://user@host/database.")] = None,
    local: Annotated[bool, typer.Option("--local", help="Back to this computer.")] = False,
    as_json: Json = False,
) -> None:
    """Move the home to a shared store, or back; it is compared before it changes, and what was stays. Can be repeated."""
    from dtwin.pipeline.home_moving import bring_home, share

    given = {"store": store, "registry": registry, "endpoint": endpoint, "flows": flows}
    stated = {name: value for name, value in given.items() if value is not None}
    if local == bool(stated):
        raise InputError(
            "a home moves to a store, or back to this computer",
            code="move.where",
            got="both" if local else "neither",
            allowed="--store and --registry, or --local",
        )
    line = ProgressLine("files", quiet=as_json)
    made = bring_home(home(), line) if local else share(home(), stated, line)
    emit(
        vars(made),
        lambda: (
            f"{made.lake_files} files of the lake and {made.registry_rows} rows of the registry are the same at "
            f"{made.store or home().root}\nbefore, and kept: {made.before}"
        ),
        as_json=as_json,
    )
