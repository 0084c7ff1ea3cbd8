"""Example campaigns: they are what their script makes, and the tutorial about them is true."""

from __future__ import annotations

import csv
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest
from shown_commands import ROOT, blocks, follow, here, page

EXAMPLES = ROOT / "data" / "examples"
pytestmark = pytest.mark.system


@pytest.mark.long
def test_the_tutorial_about_the_three_mills_prints_what_it_shows(tmp_path: Path) -> None:
    said = follow(blocks(page("docs/tutorials/three-mills.md")), tmp_path, here)
    assert len(said) >= 8


def test_the_script_makes_the_examples_that_are_kept(tmp_path: Path) -> None:
    run_path(str(ROOT / "data" / "make_examples.py"))["make_examples"](tmp_path)
    made = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*.*"))
    assert made == sorted(p.relative_to(EXAMPLES) for p in EXAMPLES.rglob("*.*"))
    for name in made:
        if name.suffix == ".csv":
            # Another processor may round the last digit differently.
            assert np.allclose(table(tmp_path / name), table(EXAMPLES / name), atol=2e-4), name


def test_the_examples_stay_small_and_do_not_tell_their_fault_by_name() -> None:
    assert sum(p.stat().st_size for p in EXAMPLES.rglob("*.*")) < 3_000_000
    for folder in EXAMPLES.iterdir():
        assert "backlash" not in (folder / "campaign.toml").read_text(encoding="utf-8")


def table(path: Path) -> np.ndarray:
    with path.open(newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    assert head == ["t_s", "angle_deg", "deviation_um"]
    return np.array(rows, dtype=float)
