"""Pages as PDF files, printed by a browser of this computer that asks nobody."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from threading import Lock

from dtwin.atomic import whole_file
from dtwin.errors import MissingPart

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
"""Programs that can print, the first that is installed does."""
_PRINTING_S = 120.0
_HINT = "take the page as a .html file, open it in a browser, and save it as PDF from there"
# Several at once would take the memory of the computer.
_ONE = Lock()


def browser() -> str | None:
    """Return the program that prints; None where none is installed."""
    return next((path for name in _BROWSERS if (path := shutil.which(name))), None)


def require_browser() -> str:
    """Return the program that prints.

    Raises ``MissingPart`` when none is installed.
    """
    if (program := browser()) is None:
        raise MissingPart(
            "printing to a PDF needs a browser", code="pdf.browser", allowed=", ".join(_BROWSERS), hint=_HINT
        )
    return program


def pdf_of(page: str) -> bytes:
    """Return a page that holds everything it shows as a PDF.

    Raises ``MissingPart`` when no browser is installed, or it does not print.
    """
    program = require_browser()
    with _ONE, tempfile.TemporaryDirectory() as folder:
        source, printed = Path(folder) / "page.html", Path(folder) / "page.pdf"
        source.write_text(page, encoding="utf-8")
        command = [
            program,
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
            said = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_PRINTING_S).stderr
        except subprocess.TimeoutExpired:
            said = f"no answer within {_PRINTING_S:g} s"
        if not printed.exists():
            raise MissingPart(
                "the browser did not print the page",
                code="pdf.print",
                where=program,
                got=said.strip()[-200:],
                hint=_HINT,
            )
        return printed.read_bytes()


def write_document(path: Path, page: str, what: str) -> None:
    """Write a page in one step: printed where the name ends in .pdf, else as it is; arguments as :func:`whole_file`."""
    content = pdf_of(page) if path.suffix == ".pdf" else page.encode()
    with whole_file(path, what) as partial:
        partial.write_bytes(content)
