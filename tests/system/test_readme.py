"""README is executed: what it shows is what works."""

from __future__ import annotations

import re
import signal
import subprocess
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from running_servers import few_candidates
from shown_commands import ROOT, Block, blocks, environment, follow, here, page, run

README = page("README.md")
pytestmark = pytest.mark.system


def below(heading: str) -> list[Block]:
    """Return the blocks below a heading, up to the next one."""
    return blocks(README.partition(f"\n## {heading}")[2].partition("\n## ")[0])


def test_the_first_block_is_the_main_job_and_the_tests() -> None:
    first = blocks(README)[0].lines
    assert len(first) == 2
    for line in first:
        program, script = line.split()
        assert program == "bash"
        assert (ROOT / script).is_file()
    assert "dtwin demo" in (ROOT / "tests" / "demo.sh").read_text()
    assert "pytest" in (ROOT / "tests" / "run.sh").read_text()


@pytest.mark.parametrize("name", ["README.md", "data/README.md"])
def test_links_lead_somewhere(name: str) -> None:
    text = page(name)
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert ((ROOT / name).parent / target).exists(), target


def test_every_block_is_executed_by_a_test_here() -> None:
    executed = [blocks(README)[0]]
    for heading in ("Five minutes", "The same in the browser", "The main job, step by step"):
        executed += below(heading)
    assert executed == blocks(README)


def test_the_tour_prints_what_it_shows_and_draws_the_picture(tmp_path: Path) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    measured, *rest = below("Five minutes")
    assert "dtwin twin diagnose mill-a" in "\n".join(line for block in rest for line in block.lines)
    # A campaign is measured and kept by processes, as a reader would; the same program then goes on here.
    follow([measured, rest[0]], tmp_path)
    follow(rest[1:], tmp_path, here)
    assert (tmp_path / "compare.html").stat().st_size > 100_000
    command = "python docs/pictures/residual_falls.py mill-a residual-falls.svg"
    assert f"`{command}`" in README
    run(command, tmp_path)
    drawn, kept = (
        (folder / "residual-falls.svg").read_text(encoding="utf-8") for folder in (tmp_path, ROOT / "docs" / "pictures")
    )
    number = re.compile(r"-?\d+(?:\.\d+)?")
    assert number.sub("#", drawn) == number.sub("#", kept)
    values = [[float(n) for n in number.findall(text)] for text in (drawn, kept)]
    # A tenth of a pixel may be rounded differently on another processor.
    assert np.allclose(*values, rtol=0, atol=0.15)
    the_workbench_shows("mill-a", tmp_path)


def the_workbench_shows(twin: str, folder: Path) -> None:
    (command,) = below("The same in the browser")[0].lines
    server = subprocess.Popen(
        [*command.split(), "--no-browser"], cwd=folder, env=environment(folder), stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1].partition("?")[0]
        with urllib.request.urlopen(f"{address.rstrip('/')}/twins") as answer:
            assert twin in answer.read().decode("utf-8")
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(300)
    assert server.returncode == 0


def test_the_main_job_step_by_step_ends_with_a_champion(tmp_path: Path) -> None:
    (tmp_path / "data").symlink_to(ROOT / "data")
    with few_candidates():
        said = follow(below("The main job, step by step"), tmp_path, here)
    assert "champion" in dict(said)["dtwin models"]
