"""The page on drift, followed literally, with a log of a printer whose frame is followed late."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from shown_commands import blocks, follow, here, page

pytestmark = pytest.mark.system

STEP_UM, TAU_S, FRAME_UM_K, BED_UM_K = 2.5, 900.0, 30.0, -2.0
"""Of the tool: where it has risen, the motor touches lower."""


def write_night(folder: Path) -> None:
    """Write ten hours of a frame that warms and cools, read twice every minute, in steps of the motor."""
    rng = np.random.default_rng(3)
    t_s = np.arange(0.0, 36_000.0, 60.0)
    frame = 24.0 + 8.0 * (1.0 - np.exp(-t_s / 5000.0)) + 2.0 * np.sin(t_s / 1300.0)
    bed = 60.0 + 3.0 * np.sin(t_s / 500.0)
    core = np.empty_like(frame)
    core[0] = frame[0]
    for n in range(1, t_s.size):
        core[n] = frame[n - 1] + (core[n - 1] - frame[n - 1]) * np.exp(-60.0 / TAU_S)
    moved = FRAME_UM_K * (core - core[0]) + BED_UM_K * (bed - bed[0])
    rows = ["time,sample,mcu_pos_z,frame_t,bed_t"]
    for n, t in enumerate(t_s):
        for again in range(2):
            steps = round((-moved[n] + 1.5 * rng.standard_normal()) / STEP_UM)
            rows.append(f"{t + again},{n},{steps},{frame[n]:.3f},{bed[n]:.3f}")
    folder.mkdir()
    (folder / "night.csv").write_text("\n".join(rows), encoding="utf-8")


def test_the_page_is_followed(tmp_path: Path) -> None:
    write_night(tmp_path / "warm-up")
    said = follow(blocks(page("docs/how-to/drift.md")), tmp_path, here)
    (klipper,) = [
        block for block in blocks(page("docs/how-to/export.md")) if "z_thermal_adjust" in "".join(block.lines)
    ]
    follow([klipper], tmp_path, here)
    (coefficient,) = re.findall(r"^temp_coeff: (\S+)$", (tmp_path / "z_thermal_adjust.cfg").read_text("utf-8"), re.M)
    assert float(coefficient) == pytest.approx(FRAME_UM_K / 1e3, rel=0.01)
    printed = {" ".join(command.split()[1:3]): text for command, text in said}
    assert float(re.findall(r"frame late by ([\d.]+) ± [\d.]+ min", printed["check warm-up"])[-1]) == pytest.approx(
        TAU_S / 60.0, abs=2.0
    )
    frame, spread = map(float, re.findall(r"± [\d.]+ min (-?[\d.]+) ± ([\d.]+)", printed["check warm-up"])[-1])
    assert abs(frame - FRAME_UM_K) <= spread < 0.05 * abs(frame)
    assert "add lag@frame" in printed["twin history"]
    before, after = re.findall(r"([\d.]+) ± [\d.]+", printed["promote candidate"])
    assert f"{before} ± 2.8 µm RMS become {float(after):.2f} ± 0.30 µm" in page("docs/how-to/drift.md")
