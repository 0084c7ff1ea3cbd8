"""The way in for files: a tray collects them, a table that lies alone is shown and asked about, then all is ingested."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse

from dtwin.acquire.foreign_table import Looked, look
from dtwin.acquire.importing import read_as_it_is, understand, write_folder
from dtwin.acquire.ingest import open_source
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named, kinds
from dtwin.pipeline.measuring import ingest
from dtwin.progress import Tell
from dtwin.workbench._bench import Bench, Here, bench_of
from dtwin.workbench._pages import accepted
from dtwin.workbench._reading import campaign_floor, campaign_sheet_of
from dtwin.workbench._uploads import safe_path, sources, tables_alone

router = APIRouter()
_MOST_TABLES = 200
_OPTION = re.compile(r"--(\w+) ")
"""An option of the command line, within a sentence."""


class _Told(BaseModel):
    """What is told of a table that lies alone; empty fields are not told."""

    machine: str = Field("", max_length=100)
    campaign: str = Field("", max_length=100)
    started: str = Field("", max_length=40)
    plane: str = Field("", max_length=10)
    radius_mm: float | None = None
    feed_mm_min: float | None = None
    direction: str = Field("", max_length=10)
    axis: str = Field("", max_length=10)
    kind: str = Field("", max_length=20)
    instrument: str = Field("", max_length=100)

    def as_dict(self) -> dict[str, Any]:
        """Return what was told, named as in campaign.toml."""
        return {name: value for name, value in self if value not in ("", None)}


# With a limit, what is no text (half a character) is refused, too.
_Word = Annotated[str, Field(max_length=1000)]


class _Table(BaseModel):
    """A table of a tray, and what is answered of it.

    ``answers``: column of the house by head; an empty one leaves the column out.
    ``confirmed``: whether conditions of an earlier file hold for this one, too.
    """

    file: str = Field(max_length=500)
    told: _Told = Field(default_factory=lambda: _Told.model_validate({}))
    answers: dict[_Word, _Word] = Field(default_factory=dict, max_length=512)
    decimal: Literal["", "comma", "point"] = ""
    confirmed: bool = False


class _Tables(BaseModel):
    """The tables that lie alone in a tray."""

    tables: list[_Table] = Field(default_factory=list, max_length=_MOST_TABLES)


@router.post("/api/trays")
def new_tray(bench: Here) -> dict[str, str]:
    """Open a tray for files."""
    return {"tray": bench.trays.new()}


@router.put("/api/trays/{tray}")
async def receive(request: Request, tray: str, name: str) -> JSONResponse:
    """Take one file into a tray."""
    try:
        size = await bench_of(request).trays.receive(tray, name, request.stream())
    except ClientDisconnect:
        # Nobody hears it.
        return JSONResponse({"bytes": 0}, 400)
    return JSONResponse({"bytes": size})


@router.delete("/api/trays/{tray}")
def drop_tray(bench: Here, tray: str) -> dict[str, str]:
    """Throw a tray away."""
    trays = bench.trays
    trays.folder(tray)
    trays.drop(tray)
    return {"dropped": tray}


@router.post("/api/trays/{tray}/tables")
def tables_of_tray(bench: Here, tray: str) -> list[str]:
    """Return the tables of a tray that lie alone, in archives, too."""
    folder = bench.trays.folder(tray)
    with _said_of_the_tray(folder):
        return tables_alone(folder)


@router.post("/api/trays/{tray}/understand")
def understand_table(bench: Here, tray: str, table: _Table) -> dict[str, Any]:
    """Return what a table of a tray is taken for; where it cannot be, its heads and the reason."""
    folder = bench.trays.folder(tray)
    path = _in_tray(folder, table.file)
    with _said_of_the_tray(folder):
        return _understood(bench, path, table)


def _understood(bench: Bench, path: Path, table: _Table) -> dict[str, Any]:
    if read_as_it_is(path):
        refused = _refused_as_it_is(path, table.told.as_dict())
        return {"heads": [], "columns": [], "missing": [], "unconfirmed": [], "conditions": {}, "refused": refused}
    looked = look(path, bench.home, table.decimal, table.told.axis)
    try:
        return understand(path, bench.home, table.told.as_dict(), table.answers, table.decimal).as_dict() | {
            "refused": "",
            "names": _names(),
        }
    except InputError as error:
        return _heads(looked) | {"refused": _said(error, path), "names": _names()}


def _refused_as_it_is(path: Path, told: Mapping[str, Any]) -> str:
    """Return why a table that is read by rules of its own cannot be ingested; nothing before anything is told of it."""
    try:
        for _ in open_source(path, told)[1] if told else ():
            pass
    except InputError as error:
        return _said(error, path)
    return ""


@contextmanager
def _said_of_the_tray(folder: Path) -> Iterator[None]:
    """Let refusals name files as they were dropped, without the tray's place on this computer, and fields of the form for options."""
    try:
        yield
    except InputError as error:
        _for_the_page(error, folder)
        raise


def _for_the_page(error: InputError, folder: Path) -> None:
    error.where = error.where and error.where.replace(f"{folder}/", "")
    error.hint = error.hint and error.hint.replace(f"{folder}/", "")
    if error.hint:
        # A command that is proposed keeps its options.
        said, mark, command = error.hint.partition("dtwin ")
        error.hint = _OPTION.sub(r"\1 in the form: ", said) + mark + command


def _said(error: InputError, path: Path) -> str:
    """Return a refusal without the tray's place on this computer."""
    _for_the_page(error, path.parent)
    return error.render()


@router.post("/api/trays/{tray}/ingest")
async def ingest_tray(request: Request, tray: str, told: _Tables | None = None) -> JSONResponse:
    """Ingest what a tray holds."""
    bench = bench_of(request)
    trays = bench.trays
    folder = trays.folder(tray)

    def work(tell: Tell) -> str:
        try:
            with _said_of_the_tray(folder):
                return _ingested(bench, folder, [] if told is None else told.tables, tell)
        finally:
            trays.drop(tray)

    return accepted(await run_in_threadpool(bench.jobs.start, "Ingest", work))


def _in_tray(folder: Path, name: str) -> Path:
    path = folder / safe_path(name)
    if not path.is_file():
        raise InputError("the tray has no such file", code="upload.file", got=name[:120], hint="drop the files again")
    return path


def _names() -> list[str]:
    """Return the columns that kinds of tests know."""
    return sorted({column for kind in kinds() for column in kind.columns})


def _heads(looked: Looked) -> dict[str, Any]:
    """Return a table of which no kind of test is known yet."""
    units = looked.units or ("",) * len(looked.heads)
    return {
        "heads": list(looked.heads),
        "first_rows": [list(row) for row in looked.body[:4]],
        "columns": [
            {"head": head, "unit": unit, "name": "", "factor": 1.0, "why_not": ""}
            for head, unit in zip(looked.heads, units, strict=False)
        ],
        "missing": [],
        "unconfirmed": [],
        "conditions": {},
        "decimal": looked.decimal,
    }


def _ingested(bench: Bench, folder: Path, tables: Sequence[_Table], tell: Tell) -> str:
    tell("look at the files")
    alone: dict[Path, Mapping[str, Any]] = {}
    for number, table in enumerate(tables):
        path = _in_tray(folder, table.file)
        if read_as_it_is(path):
            alone[path] = table.told.as_dict()
            continue
        understood = understand(path, bench.home, table.told.as_dict(), table.answers, table.decimal)
        write_folder(understood, folder / f"table-{number}", bench.home, confirmed=table.confirmed)
        path.unlink()
    names = []
    for source in [*sources(folder, alone)]:

        def count(done: int, total: int, what: str, source: Path = source) -> None:
            tell(f"{source.name}: {done} of {total} files")

        names.append(ingest(source, bench.home, count, alone.get(source)).campaign)
    for name in dict.fromkeys(names):
        tell(f"prepare the pages of {name}")
        campaign_floor(bench, name)
        known = bench.lake.campaign(name)
        if kind_named(known.kind).offers("sheet"):
            campaign_sheet_of(bench, name, known.machine)
    return f"/campaigns/{names[0]}" if len(set(names)) == 1 else "/campaigns"
