"""What commands print: text for people, or nothing but JSON on stdout."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from dtwin.errors import InputError, printable
from dtwin.progress import telling

Json = Annotated[bool, typer.Option("--json", help="Print only JSON on stdout.")]
"""Option of every command that has figures to tell."""
Report = Annotated[
    Path | None,
    typer.Option("--html", help="Write a report, one offline page; a name that ends in .pdf is printed by a browser."),
]


ReportLanguage = Annotated[str, typer.Option("--language", help="Of the report: en or de.")]


def require_report(html: Path | None, language: str) -> None:
    """Refuse a language that is of nothing."""
    if html is None and language != "en":
        raise InputError(
            "in that language there is only the report",
            code="document.language",
            got=f"--language {language}",
            hint="--html FILE",
        )


def emit(payload: Mapping[str, Any], text: Callable[[], str], *, as_json: bool) -> None:
    """Print a result. ``text``: makes the readable form; called only when it is wanted."""
    if as_json:
        print(json.dumps(_clean(payload), indent=2, default=str))
    else:
        print(printable(text()))


def _clean(value: Any) -> Any:
    """Return the value with NaN and infinities as null, which JSON knows, and no size that the runs do not tell."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        if value.get("identifiable") is False:
            value = {**value, "value": None, "uncertainty": None}
        return {str(k): _clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(v) for v in value]
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        return _clean(value.item())
    return value


@contextmanager
def stages(*, quiet: bool) -> Iterator[None]:
    """Show on one line on stderr what long work does now; silent when piped, and with ``--json``. ``quiet``: never print."""
    if quiet or not sys.stderr.isatty():
        yield
        return

    def show(stage: str) -> None:
        print(f"\r{stage[: shutil.get_terminal_size().columns - 1]}\x1b[K", end="", file=sys.stderr, flush=True)

    try:
        with telling(show):
            yield
    finally:
        show("")


class ProgressLine:
    """One line on stderr that counts; silent when short, when piped, and with ``--json``. ``quiet``: never print."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self.title = title
        self.quiet = quiet or not sys.stderr.isatty()
        self.begun = time.monotonic()
        self.drawn = 0.0

    def __call__(self, done: int, total: int, what: str = "") -> None:
        """Show that ``done`` of ``total`` is finished."""
        now = time.monotonic()
        if self.quiet or now - self.begun < 0.2 or (done < total and now - self.drawn < 0.1):
            return
        self.drawn = now
        left = (now - self.begun) / max(done, 1) * (total - done)
        end = "\n" if done >= total else ""
        print(
            f"\r{self.title}: {done}/{total} {what:<24.24} {left:z4.0f} s left\x1b[K",
            end=end,
            file=sys.stderr,
            flush=True,
        )
