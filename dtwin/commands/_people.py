"""Commands about people: who may do what at the workbench, and who did."""

from __future__ import annotations

from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import StoreError
from dtwin.report.text import table

app = typer.Typer(
    name="people", no_args_is_help=True, help="Who may do what at the workbench, and the record of who did."
)
_Name = Annotated[str, typer.Argument(help="Stands under what the person does.")]


@app.command()
def add(
    name: _Name,
    role: Annotated[list[str], typer.Option(help="look, measure, train, promote or stop; several times for several.")],
    as_json: Json = False,
) -> None:
    """Give a person a token, which is shown once; an earlier one of the same name holds no more."""
    from dtwin.people import add_person

    token = add_person(home(), name, role)
    emit(
        {"name": name, "roles": role, "token": token},
        lambda: f"{token}\nfor {name} alone: http://HOST:PORT/?token={token} enters the workbench",
        as_json=as_json,
    )


@app.command("list")
def list_people(as_json: Json = False) -> None:
    """List who has a token, and for what."""
    from dtwin.people import read_people

    known = read_people(home())
    people = [{"name": person.name, "roles": list(person.roles)} for person in known.people]
    rows = [[person.name, ", ".join(person.roles)] for person in known.people]

    def text() -> str:
        needs = "two people" if known.second_person else "one person"
        return f"{table(('name', 'may'), rows) if rows else 'nobody has a token yet'}\na champion needs {needs}"

    emit({"people": people, "second_person": known.second_person}, text, as_json=as_json)


@app.command()
def remove(name: _Name, as_json: Json = False) -> None:
    """Take a person's token away, at once; the name stays in the record."""
    from dtwin.people import remove_person

    remove_person(home(), name)
    emit({"removed": name}, lambda: f"{name} has no token any more", as_json=as_json)


@app.command()
def second(
    wanted: Annotated[bool, typer.Option("--required/--not-required", help="Whether a champion needs two people.")],
    as_json: Json = False,
) -> None:
    """Let a version become champion only when two people promote it."""
    from dtwin.people import require_second_person

    require_second_person(home(), wanted)
    emit(
        {"second_person": wanted},
        lambda: f"a champion needs {'two people' if wanted else 'one person'}",
        as_json=as_json,
    )


@app.command()
def record(as_json: Json = False) -> None:
    """Show who did what, when and why, after comparing each line with the hash in the next."""
    from dtwin.people import AUDIT, audit, damaged_in

    said = audit(home())
    names = ("when", "who", "what", "came", "why")
    rows = [
        [str(line.get(name, "")) for name in names] if line else ["?", "?", "a damaged line", "?", "?"] for line in said
    ]
    heads = ("when", "who", "what", "came of it", "why")
    damaged = damaged_in(said)
    emit(
        {"record": said, "damaged": damaged},
        lambda: table(heads, rows) if rows else "nothing is recorded yet",
        as_json=as_json,
    )
    if damaged:
        told = StoreError(
            "the record of who did what was changed, or a line of it is cut; all others are shown",
            code="audit.changed",
            where=f"{home().root / AUDIT} line {', '.join(map(str, damaged))}",
            hint="compare it with a backup: there, or in the line before, something was changed, taken out or put in",
        )
        typer.echo(told.render(), err=True)
        raise typer.Exit(told.exit_code)
