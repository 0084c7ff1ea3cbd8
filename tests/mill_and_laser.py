"""Tests of one machine by a ball bar and a laser: circles of the virtual mill, positions by formulas of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from laser_axis import readings

from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics.observations import Observations, observe
from dtwin.schema import Campaign, Direction, Run, RunMeta

DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")


def circular_tests(
    radii_mm: Sequence[float] = (100.0,), feeds_mm_min: Sequence[float] = (2000.0,), repeats: int = 3
) -> list[CircularTest]:
    """Return circles both ways, a set-up for each radius."""
    every = product(radii_mm, feeds_mm_min, range(1, repeats + 1), DIRECTIONS)
    return [CircularTest("XY", way, radius, feed, k, f"xy{radius:g}") for radius, feed, k, way in every]


def measured(
    mill: MillParameters,
    seed: int,
    radii_mm: Sequence[float] = (100.0,),
    feeds_mm_min: Sequence[float] = (2000.0,),
    repeats: int = 3,
) -> tuple[Campaign, list[Run]]:
    """Return what the ball bar reads of them."""
    made = VirtualMill(mill, seed=seed, noise=NoiseParameters(rms_um=0.1))
    return made.campaign(), made.measure(circular_tests(radii_mm, feeds_mm_min, repeats))


def circles(
    mill: MillParameters,
    seed: int = 1,
    name: str = "bar",
    day: str = "",
    radii_mm: Sequence[float] = (100.0,),
    feeds_mm_min: Sequence[float] = (2000.0,),
    repeats: int = 3,
) -> Observations:
    """Return the same on a grid, begun on a day where one is given."""
    campaign, runs = measured(mill, seed, radii_mm, feeds_mm_min, repeats)
    if day:
        runs = [replace(run, meta=replace(run.meta, started=f"{day}T09:{n:02d}:00")) for n, run in enumerate(runs)]
    return observe(replace(campaign, name=name), runs)


def laser(
    axis: str, lead_ppm: float, lost_um: float, seed: int = 1, name: str = "", day: str = "", cubic_um: float = 0.0
) -> Observations:
    """Return a positioning test of an axis on its targets: five runs, there and back; ``cubic_um``: lead error at 400 mm."""
    runs = []
    for n, (at, ways, error) in enumerate(readings(lead_ppm, lost_um, seed), start=1):
        started = f"{day}T10:0{n}:00" if day else ""
        meta = RunMeta(f"r{n}", kind="linear", condition={"axis": axis}, repeat=n, started=started)
        error = error + cubic_um * (at / 400.0) ** 3
        samples = {"position_mm": at, "direction": np.array(ways, dtype=object), "error_um": error}
        runs.append(Run(meta, {"t_s": 10.0 * np.arange(at.size), **samples}))
    return observe(Campaign(name or f"laser-{axis}", "mill", kind="linear"), runs)


def warmed(
    axis: str, seed: int, *, wave: tuple[float, float, float] = (0.0, 200.0, 0.0), growth_um_m_k: float = 0.0
) -> Observations:
    """Return a positioning test of a sound axis while it warms from 19 to 21 degrees, with a wave of its screw and with growth.

    ``wave``: amplitude in um, length in mm, phase.
    """
    runs = []
    for n, (at, ways, error) in enumerate(readings(0.0, 0.0, 2 * seed + "XYZ".index(axis)), start=1):
        warm_c = 19.0 + 0.5 * (n - 1)
        error += wave[0] * np.cos(2.0 * np.pi * at / wave[1] + wave[2])
        error += 1e-3 * growth_um_m_k * (warm_c - 20.0) * (at - at[0])
        covariates = {"temperature_c": warm_c}
        meta = RunMeta(f"r{n}", kind="linear", condition={"axis": axis}, repeat=n, covariates=covariates)
        meta = replace(meta, started=f"2026-03-03T1{n}:00:00")
        samples = {"position_mm": at, "direction": np.array(ways, dtype=object), "error_um": error}
        runs.append(Run(meta, {"t_s": 10.0 * np.arange(at.size), **samples}))
    return observe(Campaign(f"laser-{axis}", "mill", kind="linear"), runs)


def write_circles(folder: Path, machine: str, mill: MillParameters, seed: int = 1) -> Path:
    """Write the folder of a campaign of circles."""
    folder.mkdir(parents=True)
    lines = ["[campaign]", f'name = "{folder.name}"', f'machine = "{machine}"', 'kind = "circular"']
    _, runs = measured(mill, seed)
    for run in runs:
        meta = run.meta
        columns = (run.samples[name] for name in ("t_s", "angle_deg", "deviation_um"))
        rows = [f"{t:.5f},{angle:.5f},{um:.5f}" for t, angle, um in zip(*columns, strict=True)]
        text = "\n".join(["t_s,angle_deg,deviation_um", *rows])
        (folder / f"{meta.run_id}.csv").write_text(text + "\n", encoding="utf-8")
        lines += ["[[run]]", f'id = "{meta.run_id}"', f'file = "{meta.run_id}.csv"', f'plane = "{meta.plane}"']
        lines += [f"radius_mm = {meta.radius_mm}", f"feed_mm_min = {meta.feed_mm_min}", f"repeat = {meta.repeat}"]
        lines += [f'direction = "{meta.direction}"', f'setup = "{meta.setup}"', f"started = {meta.started}"]
    (folder / "campaign.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
