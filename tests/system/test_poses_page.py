"""The page on robot poses, followed literally."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dtwin.cli import app

ROOT = Path(__file__).parents[2]


pytestmark = pytest.mark.system


def test_the_commands_of_the_page_print_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path))
    page = (ROOT / "docs/how-to/robot-poses.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(sh|text)\n(.*?)```", page, re.DOTALL)
    assert [language for language, _ in blocks] == ["sh", "text"] * 3
    printed = ""
    for language, body in blocks:
        for line in body.splitlines():
            if language == "sh":
                done = CliRunner().invoke(app, shlex.split(line)[1:])
                assert done.exit_code == 0, done.output
                printed = done.output
            else:
                assert line in printed
