"""Closed-loop evidence for a correction of tones: surfaces with and without, on the virtual slide."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.machines.turning import AnaloguePath
from dtwin.pipeline.turning_trial import RIM_MM, SLOPE_UM_PER_MM, TRIAL_HZ, trial
from dtwin.report.html import page
from dtwin.report.turning import trial_section
from dtwin.serve.bundle import Bundle
from dtwin.train.registry import EVIDENCE_FILE, RegisteredVersion, Registry

REPEATS = 3
Progress = Callable[[int, int, str], None]


def tone_evidence(
    bundle: Bundle, truth: str, *, seed: int, progress: Progress | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Cut the surface several times with and without a bundle.

    Parameters
    ----------
    bundle : Bundle
        Corrects tones.
    truth : str
        Mechanism of the virtual slide.
    seed : int
        Of noise.
    progress : callable, optional
        Called with (done, total, what).

    Returns
    -------
    evidence, first : tuple
        In the form that the gates read, error vectors at the rim in um; and the first trial.
    """
    trials = []
    for repeat in range(REPEATS):
        trials.append(trial(bundle, truth=truth, seed=1000 * (seed + 1) + 10 * repeat)[0])
        if progress is not None:
            progress(repeat + 1, REPEATS, "surfaces")
    conditions = [
        _condition(f, [t["rows"][i] for t in trials]) for i, f in enumerate(TRIAL_HZ)
    ]  # fmt: skip
    evidence = {
        "kind": "virtual", "clock": trials[0]["clock"], "bundle_sha256": bundle.sha256,
        "delays": {"analogue path": AnaloguePath().delay_s}, "conditions": conditions,
    }  # fmt: skip
    return evidence, trials[0]


def measure_tone_evidence(
    home: Home, version: RegisteredVersion, geometry: Mapping[str, Any], *, seed: int,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Measure evidence for a registered version and keep it with the version.

    Parameters
    ----------
    home : Home
        Registry.
    version : RegisteredVersion
        The version.
    geometry : mapping
        Of a virtual slide: ``truth`` names its mechanism.
    seed : int
        Of noise.
    progress : callable, optional
        Called with (done, total, what).
    """
    registry = Registry(home)
    bundle = Bundle.from_dict(registry.bundle(version))
    evidence, first = tone_evidence(
        bundle, str(geometry.get("truth", "")), seed=seed, progress=progress
    )
    title = f"version {version.version}"
    registry.attach(
        version,
        {
            EVIDENCE_FILE: json.dumps(evidence, indent=1),
            "evidence.html": page("Closed-loop evidence", title, [trial_section(first, {})]),
        },
    )
    return evidence


def _condition(frequency: float, rows: list[dict[str, Any]]) -> dict[str, Any]:
    before = np.array([r["before"]["vector_um"] for r in rows])
    after = np.array([r["after"]["vector_um"] for r in rows])
    # Student's t of two degrees of freedom, 95 %, for three repeats.
    half = 4.303 / math.sqrt(len(rows))
    ci = [float(half * values.std(ddof=1)) for values in (before, after)]
    b, a = float(before.mean()), float(after.mean())
    ticks = sum(sum(r["guard"].values()) for r in rows)
    outside = sum(r["guard"].get("outside_box", 0) for r in rows)
    return {
        "frequency_hz": frequency, "amplitude_um": SLOPE_UM_PER_MM * RIM_MM, "trained": True,
        "before_um": b, "after_um": a, "before_ci_um": ci[0], "after_ci_um": ci[1],
        "floor_um": float(before.std(ddof=1)), "oracle_um": None, "n_runs": len(rows),
        "reduction": 1.0 - a / b,
        # At the rim, or over the whole surface.
        "worse": a - b > math.hypot(*ci) or all(r["reduction"]["rms_um"] < 0.0 for r in rows),
        "acted": {"outside_box": outside / max(ticks, 1)},
        "alarms": [r["alarm"] for r in rows if r["alarm"]],
    }  # fmt: skip
