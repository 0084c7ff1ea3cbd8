"""Commands about people: who may do what at the workbench, and who did."""

from __future__ import annotations

from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.report.text import table

app = typer.Typer(
    name="people", no_args_is_help=True, help="Who may do what at the workbench, and the record of who did."
)
Name = Annotated[str, typer.Argument(help="Stands under what the person does.")]


@app.command()
def add(
    name: Name,
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
def remove(name: Name, as_json: Json = False) -> None:
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
    from dtwin.people import audit

    said = audit(home())
    rows = [[line["when"], line["who"], line["what"], line["came"], line["why"]] for line in said]
    heads = ("when", "who", "what", "came of it", "why")
    emit({"record": said}, lambda: table(heads, rows) if rows else "nothing is recorded yet", as_json=as_json)
