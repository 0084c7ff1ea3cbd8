"""MkDocs hook: the command reference is the help text itself, and shown commands must exist."""

from __future__ import annotations

import logging
import re
import shlex
from functools import cache
from typing import Any

import typer

from dtwin.cli import app

PLACE = "<!-- commands -->"
_BLOCK = re.compile(r"^```(?:sh|bash|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_log = logging.getLogger("mkdocs.hooks.commands")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Insert the help texts, and warn of commands and options that do not exist."""
    for wrong in _wrong_commands(markdown):
        _log.warning("%s shows what dtwin does not have: %s", page.file.src_path, wrong)
    return markdown.replace(PLACE, _reference()) if PLACE in markdown else markdown


@cache
def _known() -> dict[str, Any]:
    """Return every command by its words, made once for all pages."""
    return _leaves(typer.main.get_command(app), "dtwin")


def _leaves(group: Any, path: str) -> dict[str, Any]:
    """Return every command by its words, groups taken apart."""
    found: dict[str, Any] = {}
    for name, command in group.commands.items():
        words = f"{path} {name}"
        found |= _leaves(command, words) if hasattr(command, "commands") else {words: command}
    return found


def _reference() -> str:
    parts = []
    for words, command in _known().items():
        context = command.make_context(words, [], resilient_parsing=True, terminal_width=88)
        parts.append(f"## {words}\n\n```text\n{command.get_help(context)}\n```\n")
    return "\n".join(parts)


def _wrong_commands(markdown: str) -> list[str]:
    known = _known()
    wrong = []
    for block in _BLOCK.findall(markdown):
        for line in block.replace("\\\n", " ").splitlines():
            if not line.startswith("dtwin "):
                continue
            words = shlex.split(line, comments=True)
            if len(words) < 2 or words[1] == "--help":
                continue
            command = known.get(" ".join(words[:2])) or known.get(" ".join(words[:3]))
            options = {o for p in (command.params if command else ()) for o in p.opts}
            unknown = [w for w in words[2:] if w.startswith("--") and w.split("=")[0] not in options]
            if command is None or unknown:
                wrong.append(line.strip())
    return wrong
