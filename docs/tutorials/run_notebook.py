"""Run the notebook of this folder and keep what its cells show: ``python docs/tutorials/run_notebook.py``.

Writes ``notebook.ipynb`` with its outputs, and ``notebook.md``, which the documentation shows.
"""

from __future__ import annotations

import ast
import code
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from types import CodeType
from typing import Any

HERE = Path(__file__).parent
NOTEBOOK, PAGE = HERE / "notebook.ipynb", HERE / "notebook.md"
NOTE = (
    "!!! note\n"
    "    This page is [a notebook](notebook.ipynb): take it along and run it. A test does, and compares "
    "what is printed.\n"
)


class _Cells(code.InteractiveInterpreter):
    """One namespace for all cells; an error ends the run."""

    def showtraceback(self) -> None:
        raise


def shown(cells: list[dict[str, Any]], folder: Path) -> list[str]:
    """Run the code cells in a folder and return what each shows.

    Args:
        cells: Cells of a notebook.
        folder: Where they run.
    """
    interpreter = _Cells({"__name__": "__main__"})
    out = []
    with contextlib.chdir(folder):
        for cell in cells:
            if cell["cell_type"] == "code":
                printed = io.StringIO()
                with contextlib.redirect_stdout(printed), _displayed():
                    for part in _parts("".join(cell["source"])):
                        interpreter.runcode(part)
                lines = printed.getvalue().strip("\n").splitlines()
                out.append("\n".join(line.rstrip() for line in lines))
    return out


def _parts(source: str) -> list[CodeType]:
    """Return the statements of a cell, the last one as a prompt takes it: its value is shown."""
    *first, last = ast.parse(source).body
    return [compile(ast.Module(first, []), "cell", "exec"), compile(ast.Interactive([last]), "cell", "single")]


@contextlib.contextmanager
def _displayed() -> Any:
    before, sys.displayhook = sys.displayhook, _display
    try:
        yield
    finally:
        sys.displayhook = before


def _display(value: object) -> None:
    if value is None:
        return
    layout = getattr(value, "layout", None)
    print(f"(figure: {layout.title.text})" if layout is not None else repr(value))


def with_outputs(notebook: dict[str, Any], outputs: list[str]) -> dict[str, Any]:
    """Return a notebook whose code cells show texts."""
    texts = iter(outputs)
    cells = [
        {**cell, "outputs": _outputs(next(texts))} if cell["cell_type"] == "code" else cell
        for cell in notebook["cells"]
    ]
    return {**notebook, "cells": cells}


def _outputs(text: str) -> list[dict[str, Any]]:
    if not text:
        return []
    return [{"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)}]


def kept(notebook: dict[str, Any]) -> list[str]:
    """Return what the code cells of a notebook show."""
    return [
        "".join(line for output in cell["outputs"] for line in output["text"])
        for cell in notebook["cells"]
        if cell["cell_type"] == "code"
    ]


def page(notebook: dict[str, Any]) -> str:
    """Return a notebook as Markdown."""
    parts = []
    texts = iter(kept(notebook))
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] != "code":
            parts.append(source)
            continue
        text = next(texts)
        parts.append(f"```python\n{source}\n```")
        parts += [f"```text\n{text}\n```"] if text else []
    title, *rest = parts
    return "\n\n".join(["<!-- Made by run_notebook.py from notebook.ipynb. -->", title, NOTE, *rest]) + "\n"


def main() -> None:
    """Run the notebook and write both files."""
    # Before the folder goes, not in the background.
    os.environ["DTWIN_MLFLOW"] = "now"
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        done = with_outputs(notebook, shown(notebook["cells"], Path(folder)))
    NOTEBOOK.write_text(json.dumps(done, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    PAGE.write_text(page(done), encoding="utf-8")


if __name__ == "__main__":
    main()
