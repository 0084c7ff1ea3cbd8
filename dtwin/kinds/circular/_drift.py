"""What a champion leaves of recorded circles, and their errors as evidence compares them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.path_inputs import PATH_INPUTS
from dtwin.lake.store import Lake
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.campaign_rows import gather, noise_floor_um
from dtwin.train.champion_error import (
    ChampionError,
    Condition,
    HeldOut,
    RunError,
    as_served,
    held_out,
    new_values,
    require_inputs,
    require_trained,
)
from dtwin.train.comparison_models import score
from dtwin.train.dataset import TICK_HZ, TickRun, load_ticks
from dtwin.train.results import FRESH_RUN


def circles_error(
    lake: Lake,
    rows: Sequence[dict[str, Any]],
    bundle: Bundle,
    metrics: Mapping[str, float],
    progress: Progress = silent,
) -> ChampionError:
    """Return a bundle's radial error over the marked windows, centre and radius of each set-up taken out.

    ``metrics``: say how far the equation looks ahead: its output at a tick is for that much later.
    """
    require_inputs(bundle, PATH_INPUTS, ("path_radial",), "inputs of the path, one radial output")
    horizon_s = metrics.get("horizon_ms", 0.0) / 1000.0
    gathered = gather(load_ticks(lake, lake.campaign(rows[0]["campaign"]), rows, progress))
    parts = [_predicted_um(bundle, run, horizon_s) for run in gathered.runs]
    predicted = np.concatenate([values for values, _ in parts])
    return ChampionError(
        rms_um=score(gathered, predicted, "run_id").rms_um,
        before_um=gathered.rms_um(gathered.target_um),
        noise_floor_um=noise_floor_um(gathered)[0],
        outside_box_share=float(np.mean(np.concatenate([outside for _, outside in parts]))),
        n_runs=len(gathered.runs),
    )


def circles_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: of a fresh run, or with radii or feeds left out when new ones are there."""
    require_trained(known, fresh, "plane")
    new = [name for name in ("radius_mm", "feed_mm_min") if new_values(known, fresh, name)]
    return held_out(new[0]) if new else HeldOut(FRESH_RUN, "run")


def _predicted_um(bundle: Bundle, run: TickRun, horizon_s: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the radial error that serving takes away at the rows of a run, and where it takes none, (rows,) each."""
    columns = [PATH_INPUTS.index(name) for name in bundle.tick_inputs]
    inputs = run.inputs[:, columns].astype(float)
    asked = CompiledBundle(bundle).run(inputs)[:, 0]
    served, outside = as_served(bundle, dict(zip(bundle.tick_inputs, inputs.T, strict=True)), asked)
    ticks = np.clip(run.arc - round(horizon_s * TICK_HZ), 0, None)
    return served[ticks], outside[ticks]


_BINS = 180
# Of one turn; what is swept less of begins somewhere.
_WHOLE_DEG = 350.0
_PLACE_DEG = 10.0


def circle_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the errors of circles.

    Centre and radius belong to a mounting, which all feeds and both directions share.
    """
    parts = [run.arc for run in runs]
    mounted = defaultdict(list)
    for number, (run, (angle_deg, _)) in enumerate(zip(runs, parts, strict=True)):
        mounted[run.meta.setup, run.meta.plane, run.meta.radius_mm, _swept(angle_deg)].append(number)
    rest = dict[int, Floats]()
    for numbers in mounted.values():
        designs = {n: _mounting(parts[n][0]) for n in numbers}
        # A slow circle has more samples; every run weighs the same.
        normal = sum((d.T @ d / len(d) for d in designs.values()), np.zeros((3, 3)))
        right = sum((d.T @ parts[n][1] / len(d) for n, d in designs.items()), np.zeros(3))
        terms = np.linalg.lstsq(normal, right, rcond=None)[0]
        rest |= {n: parts[n][1] - d @ terms for n, d in designs.items()}
    conditions = [_circle(run) for run in runs]
    grids = _grids(runs, [angle for angle, _ in parts])
    return [
        RunError(n, conditions[n], str(run.meta.direction), rms(rest[n]), _at(grids[n], parts[n][0], rest[n]))
        for n, run in enumerate(runs)
    ]


def _circle(run: Run) -> Condition:
    meta = run.meta
    if meta.radius_mm and meta.feed_mm_min:
        return {"plane": str(meta.plane), "radius_mm": meta.radius_mm, "feed_mm_min": meta.feed_mm_min}
    raise InputError("a circle does not state radius and feed", code="evidence.condition", where=f"run {meta.run_id}")


def _swept(angle_deg: Floats) -> int:
    """Tell arcs apart that do not cover the same angles; a whole turn covers all of them."""
    low, high = float(angle_deg.min()), float(angle_deg.max())
    if high - low >= _WHOLE_DEG:
        return -1
    return round((low % 360.0) / _PLACE_DEG)


def _mounting(angle_deg: Floats) -> Floats:
    angle = np.radians(angle_deg)
    return np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])


def _grids(runs: Sequence[Run], angles: Sequence[Floats]) -> list[Floats]:
    """Return, for each run, angles that all of its direction and condition went through."""
    ends: dict[object, tuple[float, float]] = {}
    keys = [(r.meta.plane, r.meta.radius_mm, r.meta.feed_mm_min, r.meta.direction) for r in runs]
    for key, angle in zip(keys, angles, strict=True):
        low, high = ends.get(key, (-math.inf, math.inf))
        ends[key] = max(low, float(angle.min())), min(high, float(angle.max()))
    steps = (np.arange(_BINS) + 0.5) / _BINS
    return [ends[key][0] + steps * (ends[key][1] - ends[key][0]) for key in keys]


def _at(places: Floats, angle_deg: Floats, rest_um: Floats) -> Floats:
    order = np.argsort(angle_deg)
    return np.asarray(np.interp(places, angle_deg[order], rest_um[order]))
