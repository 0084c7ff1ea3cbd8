"""3-D motion and placements on the virtual cobot, beside what the source thesis prints of both."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.virtual import TRANSPORT_S
from dtwin.config import Home
from dtwin.machines.cobot import VirtualCobot
from dtwin.progress import Progress
from dtwin.schema import Floats
from studies import placement_campaign as placing
from studies.machines.sphere_path import sphere_plan, sphere_run
from studies.published_placements import recomputed
from studies.sphere_evidence import sphere_evidence
from studies.sphere_model import fit_sphere, sphere_bundle

WANTED_SHARE = 0.8
_TRAINED_MM_MIN = (2000.0, 4000.0, 6000.0)


@dataclass(frozen=True)
class StorySize:
    """How much is measured.

    ``mountings``: mountings of the bar that the path's model is fitted to.
    ``feeds_mm_min``: feeds of the three circles, before and after.
    ``runs``: Runs of each way.
    ``placements``: placements of each condition and way.
    ``training``: placements of each motion and training feed.
    """

    mountings: int
    feeds_mm_min: tuple[float, ...]
    runs: int
    placements: int
    training: int


FULL = StorySize(3, (1000.0, 3000.0, 6000.0), 5, 10, 8)
QUICK = StorySize(2, (6000.0,), 3, 4, 4)


def placement_story(
    home: Home, seed: int = 0, *, size: StorySize = FULL, progress: Callable[[str], Progress] | None = None
) -> dict[str, Any]:
    """Measure both, machine clock, and put the published tables beside them.

    ``home``: the campaign of placements is written below its ``campaigns``.
    ``seed``: of the machine and of what does not repeat.
    ``size``: how much.
    ``progress``: ``progress(title)`` returns what is called with (done, total, what).
    Returns JSON-ready: ``sphere``, ``placements``, ``published``, and ``shortfalls``: where less than 80 % of the
    oracle's reduction was reached, or a condition became worse.
    """
    tell = progress or (lambda title: lambda done, total, what: None)
    cobot = VirtualCobot(seed=seed)
    tcp_mm = np.array([0.0, 0.0, cobot.parameters.motion.tcp_z_mm])
    sphere = _sphere(cobot, tcp_mm, size, tell("three circles"))
    placements = _placements(home, cobot, tcp_mm, size, seed, tell("placements"))
    return {
        "seed": seed,
        "sphere": sphere,
        "placements": placements,
        "published": recomputed(),
        "wanted_share": WANTED_SHARE,
        "shortfalls": _shortfalls([*sphere["feeds"], *placements["conditions"]]),
    }


def _sphere(cobot: VirtualCobot, tcp_mm: Floats, size: StorySize, progress: Progress) -> dict[str, Any]:
    groups = []
    for number in range(size.mountings):
        runs = []
        for feed in _TRAINED_MM_MIN:
            ticks = cobot.run(sphere_plan(cobot, feed))
            runs.append(sphere_run(cobot, feed, ticks, setup=f"sphere-{number}", repeat=number + 1))
        groups.append(runs)
    model = fit_sphere(groups)
    control = cobot.parameters.controller
    horizon_s = control.actuator_delay_s + control.actuator_lag_s + TRANSPORT_S
    bundle = sphere_bundle(model, "virtual-cobot", horizon_s=horizon_s)
    found = sphere_evidence(
        bundle,
        cobot,
        tcp_mm=tcp_mm,
        feeds_mm_min=size.feeds_mm_min,
        trained_mm_min=_TRAINED_MM_MIN,
        repeats=size.runs,
        setup="sphere-evidence",
        progress=progress,
    )
    return {
        "clock": "machine clock (lock-step, 500 Hz)",
        "delay_s": horizon_s,
        "clamp_um": bundle.safety.clamp_um,
        "slew_um_s": bundle.safety.slew_um_s,
        "fitted_to": {"mountings": size.mountings, "feeds_mm_min": list(_TRAINED_MM_MIN)},
        "fit_rms_um": model.rms_um,
        "feeds": [result.as_dict() for result in found],
    }


def _placements(
    home: Home, cobot: VirtualCobot, tcp_mm: Floats, size: StorySize, seed: int, progress: Progress
) -> dict[str, Any]:
    bundle, left_out = placing.learn(cobot, tcp_mm, repeats=size.training)
    rows = placing.measure(cobot, bundle, tcp_mm, repeats=size.placements, seed=seed, progress=progress)
    name = f"placement-{seed}"
    folder = home.campaigns / name
    # A repeated demo measures the same campaign again; half of an older one must not stay.
    shutil.rmtree(folder, ignore_errors=True)
    placing.write_campaign(folder, rows, name)
    temperature = [r.probed.temperature_c for r in rows]
    grown = placing.SETTINGS.half_y_mm * placing.SETTINGS.expansion_1_k * 1e3
    return {
        "clock": "machine clock",
        "folder": str(folder),
        "clamp_um": bundle.safety.clamp_um,
        "trained_mm_min": list(placing.TRAINED_MM_MIN),
        "left_out_in_training": left_out,
        "flags": placing.flags(rows),
        "conditions": placing.conditions(rows),
        "audit": placing.audit(rows),
        "temperature_c": [min(temperature), max(temperature)],
        "growth_um": grown * (max(temperature) - placing.SETTINGS.reference_c),
    }


def _shortfalls(results: Sequence[Mapping[str, Any]]) -> list[str]:
    out = []
    for r in results:
        name = f"{r.get('motion', 'three circles')} at {r['feed_mm_min']:g} mm/min"
        if np.isnan(r["share_of_oracle"]):
            out.append(f"{name}: nothing to correct, the oracle's change is not told from zero")
        elif r["share_of_oracle"] < WANTED_SHARE:
            out.append(f"{name}: {100 * r['share_of_oracle']:z.0f} % of the oracle's reduction")
        if r["worse"]:
            out.append(f"{name}: worse beyond its confidence interval")
    return out
