"""What a champion leaves of recorded positioning tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.kinds.linear._bundle import axis_number, told
from dtwin.kinds.linear._gates import along
from dtwin.kinds.linear._judging import HELD_OUT, noise_floor_um
from dtwin.lake.store import Lake
from dtwin.positioning.matrix import linear_test
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, as_served, held_out, require_inputs, require_trained

_BOTH = {"forward", "reverse"}


def strokes_error(lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, *_: object) -> ChampionError:
    """Return a bundle's error over all readings, the zero of the laser in each set-up taken out."""
    here = np.zeros(1)
    require_inputs(bundle, tuple(told(here, here)), ("base_x", "base_y", "base_z"), "the position of one axis")
    runs = [lake.load(row) for row in rows]
    moved = "XYZ"[axis_number(bundle)]
    runs = [run for run in runs if _axis(run) == moved]
    require_trained([{"condition_json": f'{{"axis": "{moved}"}}'}], rows, "axis")
    parts = [_served(bundle, run) for run in runs]
    setups = [run.meta.setup for run in runs]
    measured = [run.samples["error_um"] for run in runs]
    left = [error - served for error, (served, _) in zip(measured, parts, strict=True)]
    both = [run for run in runs if set(run.samples["direction"]) == _BOTH]
    return ChampionError(
        rms_um=rms(_without_zero(left, setups)),
        before_um=rms(_without_zero(measured, setups)),
        noise_floor_um=noise_floor_um(linear_test(both)) if len(both) > 1 else float("nan"),
        outside_box_share=float(np.mean(np.concatenate([outside for _, outside in parts]))),
        n_runs=len(runs),
    )


def strokes_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with runs left out, on the axis that was trained."""
    require_trained(known, fresh, "axis")
    return held_out(HELD_OUT)


def _served(bundle: Bundle, run: Run) -> tuple[Floats, Any]:
    """Return the error that serving takes away at each reading of a run, and where it takes none."""
    place = np.asarray(run.samples["position_mm"], float)
    way = (run.samples["direction"] == "reverse").astype(float)
    return as_served(bundle, told(place, way), along(bundle, place))


def _without_zero(errors: Sequence[Floats], setups: Sequence[str]) -> Floats:
    parts = [
        np.concatenate([e for e, own in zip(errors, setups, strict=True) if own == setup]) for setup in set(setups)
    ]
    return np.concatenate([part - part.mean() for part in parts])


def _axis(run: Run) -> str:
    return str(run.meta.condition.get("axis", "Z"))
