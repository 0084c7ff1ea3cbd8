"""``dtwin`` in this process, for tests of what a command says: a process of its own costs one to three seconds."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import pytest
from typer.testing import CliRunner

from dtwin.cli import app, main
from dtwin.errors import DtwinError


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


def printed(*words: object) -> str:
    """Return what a command that succeeds says."""
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def said(*words: object) -> Any:
    """Return what a command that succeeds says as JSON."""
    return json.loads(printed(*words, "--json"))


def refused(*words: object) -> DtwinError:
    """Return the mistake for which a command is refused."""
    with pytest.raises(DtwinError) as error:
        printed(*words)
    return error.value
