"""What a champion leaves of recorded logs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.kinds.drift._model import moved_um, series_of
from dtwin.kinds.drift._training import HELD_OUT
from dtwin.lake.store import Lake
from dtwin.schema import Floats, Run
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, as_served, held_out, require_inputs, require_trained

_TIME = "timestamp_s"
_FRAMES = ("base_x", "base_y", "base_z")


def logs_error(lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, *_: object) -> ChampionError:
    """Return a bundle's error over all readings; each log begins at its own zero, and its lags begin anew."""
    runs = [lake.load(row) for row in rows]
    known = set.intersection(*({n for n in run.samples if n.startswith("temperature_")} for run in runs))
    require_inputs(bundle, (*known, _TIME), _FRAMES, "temperatures that every log has, and one axis")
    axis = bundle.outputs[0].frame[-1].upper()
    require_trained([{"condition_json": json.dumps({"axis": axis})}], rows, "axis")
    before, after, outside = zip(*(_left(bundle, run) for run in runs), strict=True)
    floors = [series_of(run).floor_um for run in runs]
    return ChampionError(
        rms_um=rms(np.concatenate(after)),
        before_um=rms(np.concatenate(before)),
        noise_floor_um=rms(np.array(floors)),
        outside_box_share=float(np.mean(np.concatenate(outside))),
        n_runs=len(runs),
    )


def logs_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with stretches of time left out, of the axis that was trained."""
    require_trained(known, fresh, "axis")
    return held_out(HELD_OUT)


def _left(bundle: Bundle, run: Run) -> tuple[Floats, Floats, Any]:
    """Return what a log moves since it began, without and with the bundle, and where it was outside its range."""
    told = {name: np.asarray(values, float) for name, values in run.samples.items() if name.startswith("temperature_")}
    told[_TIME] = 1e9 + run.samples["t_s"]
    asked = CompiledBundle(bundle).run(np.column_stack([told[name] for name in bundle.tick_inputs]))[:, 0]
    sent, outside = as_served(bundle, told, asked)
    first = run.samples["t_s"] == run.samples["t_s"][0]
    moved = moved_um(run)
    left = moved - sent
    return moved - moved[first].mean(), left - left[first].mean(), outside
