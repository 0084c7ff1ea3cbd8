"""Nothing jumps when a process is held up: the short form of the benchmark, link by link."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "freezes" / "run.py"


@pytest.mark.parametrize(
    "link",
    [
        "robot",
        pytest.param("axes", marks=pytest.mark.long),
        pytest.param("axes, machine clock", marks=pytest.mark.long),
        pytest.param("analogue", marks=pytest.mark.long),
        pytest.param("linuxcnc", marks=pytest.mark.long),
    ],
)
def test_no_freeze_makes_a_correction_jump(link: str) -> None:
    done = subprocess.run(
        [sys.executable, SCRIPT, "--link", link, "--short", "--seed", "4", "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    found = json.loads(done.stdout)[link]
    if "skipped" in found:
        pytest.skip(found["skipped"])
    assert (done.returncode, found["failures"]) == (0, 0), found
    assert found["tries"] == 8
