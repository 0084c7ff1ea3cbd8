"""What a champion leaves of recorded circles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.features.motion import PATH_INPUTS
from dtwin.lake.store import Lake
from dtwin.progress import Progress
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.train.candidates import score
from dtwin.train.champion_error import (
    ChampionError,
    HeldOut,
    as_served,
    held_out,
    new_values,
    require_inputs,
    require_trained,
)
from dtwin.train.dataset import TICK_HZ, TickRun, load_ticks
from dtwin.train.results import FRESH_RUN
from dtwin.train.rows import gather, noise_floor_um


def circles_error(
    lake: Lake,
    rows: Sequence[dict[str, Any]],
    bundle: Bundle,
    metrics: Mapping[str, float],
    progress: Progress | None = None,
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
