"""The command that writes a test sheet as a document to sign: certificate."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from dtwin.commands._output import Json, emit
from dtwin.config import home
from dtwin.errors import InputError, MissingPart

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
_PRINTING_S = 120.0

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
    from dtwin.atomic import write_text
    from dtwin.pipeline.certificate import certificate as certificate_of

    if out.suffix not in (".html", ".pdf"):
        raise InputError(
            "no such form", code="certificate.form", got=str(out), allowed="a name ending in .html or .pdf"
        )
    browser = _browser() if out.suffix == ".pdf" else ""
    name = in_lake(home(), campaign)
    made = certificate_of(home(), name, language)
    if browser:
        _print(browser, made, out)
    else:
        write_text(out, made, "the certificate")
    emit({"campaign": name, "file": str(out)}, lambda: f"certificate of {name}: {out}", as_json=as_json)


def _browser() -> str:
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise MissingPart(
            "printing to a PDF needs a browser",
            code="certificate.browser",
            allowed=", ".join(_BROWSERS),
            hint="write a .html file, open it and save it as PDF from there",
        )
    return browser


def _print(browser: str, page: str, out: Path) -> None:
    """Have a browser print a page; the file is there whole or not at all."""
    from dtwin.atomic import whole_file

    with tempfile.TemporaryDirectory() as folder, whole_file(out, "the certificate") as partial:
        source = Path(folder) / "certificate.html"
        source.write_text(page, encoding="utf-8")
        printed = Path(folder) / "certificate.pdf"
        command = [
            browser,
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            # Its maker's servers are asked for all the same: there is no name that it could ask.
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/profile",
            "--virtual-time-budget=20000",
            f"--print-to-pdf={printed}",
            # As root, a browser starts only without its sandbox; the page is ours and asks for nothing.
            *(["--no-sandbox"] if os.geteuid() == 0 else []),
            source.as_uri(),
        ]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_PRINTING_S)
            said = done.stderr
        except subprocess.TimeoutExpired:
            said = f"no answer within {_PRINTING_S:g} s"
        if not printed.exists():
            raise MissingPart(
                "the browser did not print the certificate",
                code="certificate.print",
                where=browser,
                got=said.strip()[-200:],
                hint="write a .html file, open it and save it as PDF from there",
            )
        shutil.copyfile(printed, partial)
