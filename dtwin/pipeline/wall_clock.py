"""A short time of serving to the virtual controller, on the wall clock."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from dtwin.config import Home
from dtwin.errors import DeviceError
from dtwin.pipeline._virtual_robot import virtual_controller

Circle = tuple[str, float, float]
"""Plane, radius in mm, feed in mm/min."""


def serve_wall_clock(home: Home, machine: str, circle: Circle, duration_s: float, seed: int) -> dict[str, Any]:
    """Serve the trial to the virtual controller over real RTDE, on the wall clock.

    Serving runs in a process of its own, as it would beside a machine: no other thread may
    hold its interpreter.

    ``circle``: plane, radius in mm and feed in mm/min that the robot runs.
    ``duration_s``: for how long, in s.
    Returns what ``dtwin serve --json`` printed.
    Raises ``DeviceError`` when the process printed no status.
    """
    plane, radius, feed = circle
    log = home.logs / "virtual-controller.log"
    with virtual_controller(plane=plane, radius_mm=radius, feed_mm_min=feed, seed=seed, log=log) as host:
        done = subprocess.run(
            [
                *(sys.executable, "-m", "dtwin", "serve", "--model", "trial"),
                *("--machine", machine, "--host", host, "--duration", str(duration_s), "--json"),
            ],
            env=dict(os.environ, DTWIN_HOME=str(home.root)),
            capture_output=True,
            text=True,
            check=False,
        )
    try:
        figures: dict[str, Any] = json.loads(done.stdout)
    except ValueError as error:
        raise DeviceError(
            "serving printed no status", code="demo.serve", got=done.stderr[-400:] or "nothing"
        ) from error
    return figures


def serving_numbers(serving: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows (what, value) of a serving status, as ``dtwin serve --json`` prints it."""
    if "timing" not in serving:
        return [["error", str(serving.get("error", serving))[:200]]]
    rows = [
        ["ended", str(serving["ended"])],
        ["corrections sent", str(serving["last_sequence"])],
        ["correction released", "yes" if serving["released"] else "no"],
    ]
    for name, value in serving["timing"].items():
        if isinstance(value, Mapping) and "p50" in value:
            shown = ", ".join(f"{k} {v:.4g}" for k, v in value.items() if isinstance(v, float))
            rows.append([name, shown])
        elif isinstance(value, int | float):
            rows.append([name, f"{value:.4g}"])
    rows += [[f"real time: {k}", v] for k, v in serving["realtime"].items()]
    return rows
