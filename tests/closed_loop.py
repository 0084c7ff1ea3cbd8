"""A registered correction, and circles of its machine with and without it, for tests of evidence."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Direction, Run, RunMeta
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from dtwin.serve.served_time import events_path
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import Candidate, Latency, Scores, TrainingReport

MACHINE = "mill-a"
GEOMETRY: dict[str, Any] = {"type": "ur10e", "tcp_mm": [0.0, 0.0, 100.0]}
BEGIN = datetime(2026, 5, 4, 8, 0, tzinfo=UTC)
APART = timedelta(minutes=2)
WITHOUT, WITH = "", "corrected"


def small_bundle(machine: str = MACHINE, size_um: float = 20.0) -> Bundle:
    builder = GraphBuilder()
    angle = builder.input("path_angle_rad")
    return create_bundle(
        name="two-lobes",
        machine=machine,
        model_version=0,
        inputs=[Input("path_angle_rad", "rad", "path", 500.0, "path", -20.0, 20.0)],
        outputs=[Output("radial_um", "path_radial", "error")],
        tick_graph=builder.graph({"radial_um": size_um * builder.apply("cos", 2.0 * angle)}),
        safety=SafetyLimits(clamp_um=15.0),
    )


def candidate(name: str, r2: float, worst: float, bundle: Bundle | None = None) -> Candidate:
    scores = {
        group: Scores(group, r2, 5.0, 4.0, worst, "XY R50 F1000 CCW", 3, 12) for group in ("feed_mm_min", "radius_mm")
    }
    front = (
        {"terms": 2, "held_out_rms_um": 9.0, "radius_out_rms_um": 9.5},
        {"terms": 6, "held_out_rms_um": 5.0, "radius_out_rms_um": 6.0},
    )
    return Candidate(
        name,
        "symbolic" if bundle else "tree",
        bundle is not None,
        7,
        scores,
        4.0,
        latency=Latency(0.5, 1.0, 1000, "bundle tick"),
        front=front if bundle else (),
        bundle=bundle.to_dict() if bundle else None,
    )


def registered(
    home: Home, bundle: Bundle, r2: Sequence[float] = (0.9,), *, virtual: bool = False
) -> list[RegisteredVersion]:
    """Register versions of one training, one for each R2 of what was left out."""
    registry = Registry(home)
    proposed = [candidate(f"r2-{value:g}", value, 0.5, bundle) for value in r2]
    report = TrainingReport(
        bundle.machine,
        "march",
        {"runs": 1},
        1.0,
        12.0,
        12,
        4320,
        (*proposed, candidate("tree", -3e11, 1.4)),
        proposed[-1].name,
        1,
    )
    ids = registry.log_training(report, {})
    geometry = GEOMETRY | {"virtual": virtual}
    found = [registry.register(report, ids[one.name], one) for one in proposed]
    for version in found:
        registry.attach(version, {"geometry.json": json.dumps(geometry)})
    return found


def circles(
    ways: Iterable[str],
    *,
    before_um: float = 12.0,
    after_um: float = 4.0,
    seed: int = 0,
    feed_mm_min: float = 1000.0,
    noise_um: float = 0.5,
    begin: datetime = BEGIN,
    directions: Sequence[Direction] = ("CCW", "CW"),
) -> list[Run]:
    """Return circles in order of time, both directions for each way; two lobes of error."""
    rng = np.random.default_rng(seed)
    runs: list[Run] = []
    for way in ways:
        for direction in directions:
            turned = np.linspace(0.0, 360.0, 361)
            angle = turned if direction == "CCW" else -turned
            size = (after_um if way else before_um) * (1.0 + 0.02 * rng.standard_normal())
            error = size * np.sqrt(2.0) * np.cos(2.0 * np.radians(angle))
            samples = {
                "t_s": turned / 60.0,
                "angle_deg": angle,
                "deviation_um": error + noise_um * rng.standard_normal(turned.size),
            }
            meta = RunMeta(
                f"f{feed_mm_min:g}-{len(runs) + 1:02d}",
                plane="XY",
                direction=direction,
                radius_mm=50.0,
                feed_mm_min=feed_mm_min,
                correction=way,
                started=(begin + len(runs) * APART).isoformat(),
                sample_rate_hz=60.0,
            )
            runs.append(Run(meta, samples))
    return runs


def turns(bundle: Bundle, repeats: int = 3) -> list[str]:
    """Return the ways of an interleaved campaign."""
    return [WITHOUT, bundle.model_sha256] * repeats


def in_lake(home: Home, name: str, runs: Sequence[Run], *, virtual: bool = False) -> None:
    geometry = GEOMETRY | ({"virtual": True} if virtual else {})
    Lake(home.lake).commit(Campaign(name, MACHINE, machine_geometry=geometry), runs)


def copied(run: Run, run_id: str) -> Run:
    """Return the same readings under another name and a later time."""
    later = datetime.fromisoformat(run.meta.started) + timedelta(hours=3)
    meta = replace(run.meta, run_id=run_id, repeat=9, started=later.isoformat())
    return replace(run, meta=meta)


def served(
    home: Home,
    model_sha256: str,
    runs: Iterable[Run],
    *,
    device: str = "real",
    mode: str = "live",
    lasts_s: float = 40.0,
    ends: str = "released",
) -> Path:
    """Write the journal of sessions that served a model during each of the runs."""
    path = events_path(home, MACHINE)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as journal:
        for number, run in enumerate(runs):
            begun = datetime.fromisoformat(run.meta.started)
            about = {"session": f"{device}-{ends}-{number}"}
            for event in (
                {
                    "time": (begun - timedelta(seconds=20)).isoformat(),
                    "event": "serving",
                    "mode": mode,
                    "model_sha256": model_sha256,
                    "device": device,
                    "trial": True,
                },
                {"time": (begun + timedelta(seconds=lasts_s)).isoformat(), "event": ends},
            ):
                journal.write(json.dumps(event | about) + "\n")
    return path
