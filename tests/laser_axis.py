"""Positioning tests of an axis, as a laser would record them: formulas of their own, no code of dtwin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RUNS = 5
NOISE_UM, DATUM_UM = 0.15, 0.3


def errors_um(
    at_mm: NDArray[np.float64], forward: bool, lead_ppm: float, lost_um: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return what a laser reads at targets: a lead that is off, and half of the lost motion to either side."""
    side = -0.5 if forward else 0.5
    return 1e-3 * lead_ppm * (at_mm - at_mm[0]) + side * lost_um + NOISE_UM * rng.standard_normal(at_mm.size)


def readings(
    lead_ppm: float, lost_um: float, seed: int
) -> list[tuple[NDArray[np.float64], list[str], NDArray[np.float64]]]:
    """Return positions, directions and errors of each run, there and back, about a datum of its own."""
    rng = np.random.default_rng(seed)
    at = np.linspace(10.0, 390.0, 20)
    out = []
    for _ in range(RUNS):
        there, back = (errors_um(at, forward, lead_ppm, lost_um, rng) for forward in (True, False))
        error = np.concatenate([there, back]) + DATUM_UM * rng.standard_normal()
        out.append((np.tile(at, 2), ["forward"] * at.size + ["reverse"] * at.size, error))
    return out


def write_laser(folder: Path, machine: str, axis: str, lead_ppm: float, lost_um: float, seed: int = 0) -> Path:
    """Write the folder of a campaign."""
    folder.mkdir(parents=True)
    lines = ["[campaign]", f'name = "{folder.name}"', f'machine = "{machine}"', 'kind = "linear"']
    for number, (at, ways, error) in enumerate(readings(lead_ppm, lost_um, seed), start=1):
        rows = [f"{10 * i},{x},{way},{e:.4f}" for i, (x, way, e) in enumerate(zip(at, ways, error, strict=True))]
        (folder / f"r{number}.csv").write_text("\n".join(["t_s,position_mm,direction,error_um", *rows]) + "\n")
        lines += ["[[run]]", f'id = "r{number}"', f'file = "r{number}.csv"', f"repeat = {number}"]
        lines += [f'started = "2025-01-0{number}T09:00:00+00:00"', "[run.condition]", f'axis = "{axis}"']
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
