"""Tutorials are executed as a reader would, and end where they say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from shown_commands import here

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.system


def commands(tutorial: str) -> list[str]:
    text = (ROOT / "docs" / "tutorials" / tutorial).read_text(encoding="utf-8")
    found = re.findall(r"^```sh\n(.*?)^```", text, re.S | re.M)
    return [line for block in found for line in block.strip().splitlines()]


def test_the_page_includes_the_effect_that_it_runs() -> None:
    # A formatter once turned this line into Python, and the page showed that instead.
    page = (ROOT / "docs" / "tutorials" / "missing-effect.md").read_text(encoding="utf-8")
    assert '\n--8<-- "wobble.py"\n' in page


def test_the_hidden_effect_is_found_added_and_the_unknown_one_is_learned(tmp_path: Path) -> None:
    (tmp_path / "wobble.py").write_text(
        (ROOT / "docs" / "tutorials" / "wobble.py").read_text("utf-8"), encoding="utf-8"
    )

    def run(command: str) -> str:
        return here(command, tmp_path)

    said = [(command, run(command)) for command in commands("missing-effect.md")]
    verdicts = [text.split(":")[0] for command, text in said if " twin diagnose " in command]
    assert verdicts == [
        "missing_effect",
        "nothing_missing",
        "unknown_effect",
        "nothing_missing",
        "missing_effect",
        "nothing_missing",
    ]
    assert "backlash X is missing" in next(t for c, t in said if c == "dtwin twin diagnose mill-a")
    assert (tmp_path / "compare.html").stat().st_size > 100_000
    assert (tmp_path / "mill-a.html").stat().st_size > 100_000

    rungs = json.loads(run("dtwin twin history mill-a --json"))["rungs"]
    first, last = rungs[0], rungs[-1]
    assert first["rms_after_um"] > 2 * first["noise_floor_um"]
    assert last["rms_after_um"] < 1.1 * last["noise_floor_um"]
    shown = json.loads(run("dtwin twin show mill-a --json"))
    (play,) = [e for e in shown["parameters"] if e["effect"] == "backlash"]
    truth = (tmp_path / "mill" / "truth.toml").read_text(encoding="utf-8")
    assert "play_um = 3.0" in truth
    assert play["value"] == pytest.approx(3.0, abs=0.3)
