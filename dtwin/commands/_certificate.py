"""The command that writes a test sheet as a document to sign: certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError

app = typer.Typer()


@app.command()
def certificate(
    campaign: Annotated[str, typer.Argument(help="Campaign in the lake, or a file or folder.")],
    out: Annotated[Path, typer.Option(help="File to write: .html, or .pdf where a browser is installed.")],
    language: Annotated[str, typer.Option(help="en or de.")] = "en",
    as_json: Json = False,
) -> None:
    """Write the test sheet of a campaign as a document to sign: machine, instrument, decision, figures, pictures."""
    from dtwin.acquire.campaign_name import in_lake
    from dtwin.pipeline.campaign_certificate import certificate as certificate_of
    from dtwin.report.pdf import require_browser, write_document

    if out.suffix not in (".html", ".pdf"):
        raise InputError(
            "no such form", code="certificate.form", got=str(out), allowed="a name ending in .html or .pdf"
        )
    if out.suffix == ".pdf":
        require_browser()
    name = in_lake(home(), campaign)
    write_document(out, certificate_of(home(), name, language), "the certificate")
    emit({"campaign": name, "file": str(out)}, lambda: f"certificate of {name}: {out}", as_json=as_json)
