"""Commands that a page shows, and the lines that it says they print."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import dedent, indent

from typer.testing import CliRunner

from dtwin.cli import app

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its lines, and its title: the file that a reader makes of it."""

    language: str
    lines: list[str]
    title: str = ""


def blocks(text: str) -> list[Block]:
    """Return the fenced blocks of a Markdown page in their order."""
    found: list[Block] = []
    open_block: Block | None = None
    for line in text.splitlines():
        if not line.strip().startswith("```"):
            if open_block is not None:
                open_block.lines.append(line)
        elif open_block is None:
            head = line.strip()[3:]
            open_block = Block(head.split(" ")[0], [], head.partition('title="')[2].rstrip('"'))
        else:
            lines = dedent("\n".join(open_block.lines)).splitlines()
            found.append(replace(open_block, lines=lines))
            open_block = None
    assert open_block is None, "a block is not closed"
    return found


def page(name: str) -> str:
    """Return a page of the repository."""
    return (ROOT / name).read_text(encoding="utf-8")


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a reader whose state is below ``folder``."""
    return dict(
        os.environ,
        DTWIN_HOME=str(folder / "home"),
        OMP_NUM_THREADS="1",
        PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    )


def run(command: str, folder: Path, *, code: int = 0) -> str:
    """Run a command as a reader would and return what it prints."""
    done = subprocess.run(
        ["bash", "-c", command], cwd=folder, env=environment(folder), capture_output=True, text=True, check=False
    )
    assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def here(command: str, folder: Path) -> str:
    """Run a plain ``dtwin`` command in this process, anything else as a reader would.

    A process start costs seconds; README's tour is run in processes of its own.
    """
    words = shlex.split(command, comments=True)
    if words[0] != "dtwin" or set(command) & set("|><&;$`*"):
        return run(command, folder)
    before = {name: os.environ.get(name) for name in ("DTWIN_HOME", "OMP_NUM_THREADS")}
    os.environ |= {name: environment(folder)[name] for name in before}
    try:
        with contextlib.chdir(folder):
            done = CliRunner().invoke(app, words[1:], catch_exceptions=False)
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
    assert done.exit_code == 0, f"{command}\n{done.output}"
    return done.stdout


def follow(shown: Sequence[Block], folder: Path, runner: Callable[[str, Path], str] = run) -> list[tuple[str, str]]:
    """Run the ``sh`` blocks; every line of a ``text`` block must have been printed by the one before.

    A shown line may leave its end out with an ellipsis. A block with a title becomes that file.

    Returns commands with what they printed.
    """
    said: list[tuple[str, str]] = []
    recent: set[str] = set()
    for block in shown:
        if block.title:
            write(block, folder)
        elif block.language == "sh":
            printed = [(command, runner(command, folder)) for command in block.lines if command]
            said += printed
            recent = {line.strip() for _, text in printed for line in text.splitlines()}
        elif block.language == "text":
            absent = [line for line in block.lines if not _printed(line.strip(), recent)]
            assert not absent, f"shown, but not printed: {absent}"
    return said


IN_CLASS = ", in the class"
_END_OF_CLASS = "\n\n\nKIND = "


def write(block: Block, folder: Path) -> None:
    """Write a block where its title says: a file, or the end of the class in a module of a kind."""
    path = folder / block.title.removesuffix(IN_CLASS)
    text = "\n".join(block.lines)
    if block.title.endswith(IN_CLASS):
        before = path.read_text(encoding="utf-8")
        assert before.count(_END_OF_CLASS) == 1
        added = indent(text, "    ")
        path.write_text(before.replace(_END_OF_CLASS, f"\n\n{added}{_END_OF_CLASS}"), "utf-8")
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n", encoding="utf-8")


_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


def _printed(shown: str, recent: set[str]) -> bool:
    """Whether a line was printed: words as they are, numbers to the precision that is shown.

    Which way the last digit is rounded depends on the processor.
    """
    if not shown:
        return True
    begun = shown.endswith("…")
    return any(alike(shown.rstrip("… "), line, begun=begun) for line in recent)


def alike(shown: str, line: str, *, begun: bool = False) -> bool:
    """Whether two lines say the same; with ``begun`` the second may go on."""
    words, said = (" ".join(_NUMBER.sub("#", text).split()) for text in (shown, line))
    if not (said.startswith(words) if begun else said == words):
        return False
    pairs = zip(_NUMBER.finditer(shown), _NUMBER.finditer(line), strict=False)
    return all(abs(float(one[0]) - float(other[0])) <= 1.001 * _step(one, shown) for one, other in pairs)


def _step(number: re.Match[str], text: str) -> float:
    """Return what one more in the last digit is; 0 for a count, which is exact."""
    decimals, exponent = number[1], number[2]
    if decimals is None and exponent is None:
        return 1.0 if text[number.end() :].startswith(" %") else 0.0
    last = 10.0 ** -(len(decimals) - 1 if decimals else 0)
    return last * 10.0 ** int(exponent[1:]) if exponent else last
