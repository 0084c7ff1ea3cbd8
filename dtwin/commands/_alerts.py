"""Commands about alerts: who is told, and of what not."""

from __future__ import annotations

from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import EXIT_USER

app = typer.Typer(
    name="alert", no_args_is_help=True, help="Who is told what dtwin fleet nightly finds, and of what not."
)


@app.command("test")
def send_test(as_json: Json = False) -> None:
    """Send a test message to every channel of DTWIN_HOME/alerts.toml."""
    from dtwin.fleet.channels import try_channels

    outcomes = try_channels(home())

    def text() -> str:
        return "\n".join(f"{name}: {why or 'sent'}" for name, why in outcomes.items())

    emit({"channels": outcomes}, text, as_json=as_json)
    if any(outcomes.values()):
        raise typer.Exit(EXIT_USER)


@app.command()
def silence(
    key: Annotated[str, typer.Argument(help="As alerts are listed, such as overdue:mill-1.")],
    days: Annotated[float, typer.Option(help="For how long; 0 tells again.")] = 7.0,
    as_json: Json = False,
) -> None:
    """Tell nobody of something for some days."""
    from dtwin.fleet.alerts import silence as silenced

    until = silenced(home(), key, days)
    text = f"{key} is told again" if not days else f"{key} is not told before {until}"
    emit({"key": key, "until": until if days else None}, lambda: text, as_json=as_json)
