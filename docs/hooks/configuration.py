"""MkDocs hook: the environment variables and folders, from the code that reads them."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from dtwin.config import SETTINGS, Home

_SETTINGS, _FOLDERS = "<!-- settings -->", "<!-- folders -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert both tables."""
    if _SETTINGS not in markdown:
        return markdown
    return markdown.replace(_SETTINGS, _settings()).replace(_FOLDERS, _folders())


def _settings() -> str:
    rows = [f"| `{name}` | {default} | {what} |" for name, (default, what) in SETTINGS.items()]
    return "\n".join(["| variable | default | what it is for |", "| --- | --- | --- |", *rows])


def _folders() -> str:
    home = Home(Path("DTWIN_HOME"))
    rows = [
        f"| `{getattr(home, name)}` | {inspect.getdoc(member)} |"
        for name, member in inspect.getmembers(Home, lambda m: isinstance(m, property))
        if isinstance(getattr(home, name), Path)
    ]
    return "\n".join(["| folder | what lies there |", "| --- | --- |", *rows])
