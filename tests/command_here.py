"""``dtwin`` in this process, for tests of what a command says: a process of its own costs one to three seconds."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout

from dtwin.cli import main


def command_here(*arguments: str) -> tuple[int, str, str]:
    """Return the exit code of a command, and what it wrote to its output and to its error output."""
    out, err = io.StringIO(), io.StringIO()
    before = sys.argv
    sys.argv = ["dtwin", *arguments]
    try:
        with redirect_stdout(out), redirect_stderr(err):
            main()
        code = 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        sys.argv = before
    return code, out.getvalue(), err.getvalue()
