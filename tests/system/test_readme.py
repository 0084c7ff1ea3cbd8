"""README is executed: what it shows is what works."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.system


def blocks() -> list[list[str]]:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return [b.strip().splitlines() for b in re.findall(r"^```\n(.*?)^```", text, re.S | re.M)]


def test_the_first_block_is_the_main_job_and_the_tests() -> None:
    first = blocks()[0]
    assert len(first) == 2
    for line in first:
        program, script = line.split()
        assert program == "bash"
        assert (ROOT / script).is_file()
    assert "dtwin demo" in (ROOT / "tests" / "demo.sh").read_text()
    assert "pytest" in (ROOT / "tests" / "run.sh").read_text()


def test_links_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize(
    ("first", "ends_with"), [("dtwin check", "champion"), ("dtwin simulate", "reference")]
)
def test_a_block_of_commands_works(tmp_path: Path, first: str, ends_with: str) -> None:
    steps = next(b for b in blocks() if b[0].startswith(first))
    environment = dict(
        os.environ,
        DTWIN_HOME=str(tmp_path / "home"),
        OMP_NUM_THREADS="1",
        PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    )
    (tmp_path / "data").symlink_to(ROOT / "data")
    for step in steps:
        done = subprocess.run(
            ["bash", "-c", step],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{step}\n{done.stdout}\n{done.stderr}"
    assert ends_with in done.stdout
