"""The log of a campaign that a twin is fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.drift._check import contradicting
from dtwin.kinds.drift._model import Series
from dtwin.kinds.drift._series import series_of
from dtwin.lake.store import Lake
from dtwin.schema import Run


@dataclass(frozen=True)
class Loaded:
    """The longest sound log of a campaign, of several displacements of it that which moved most.

    ``axis``: of the displacement, empty where nobody says it; ``data``: table versions and a hash of what was used.
    """

    campaign: str
    machine: str
    run_id: str
    axis: str
    series: Series
    data: Mapping[str, Any]


def longest_first(runs: Sequence[Run]) -> list[Run]:
    """Return logs without those that the others contradict, the longest first."""
    out = contradicting(runs) if len(runs) > 1 else {}
    kept = [run for run in runs if run.meta.run_id not in out]
    return sorted(kept or runs, key=lambda run: -float(np.ptp(run.samples["t_s"])))


def of_twin(runs: Sequence[Run]) -> Run:
    """Return the longest log; of several displacements that were read together that which moved most."""
    first, *others = longest_first(runs)
    together = [first, *(run for run in others if np.array_equal(run.samples["t_s"], first.samples["t_s"]))]
    return max(together, key=lambda run: float(np.std(run.samples["displacement_um"])))


def load(home: Home, campaign: str) -> Loaded:
    """Return a campaign of the lake or of a folder, which is ingested first.

    Raises ``InputError`` when it is of another kind, or has no sound log that was measured without a correction.
    """
    lake, name = Lake(home.lake), in_lake(home, campaign)
    known = lake.campaign(name).of_kind("drift")
    rows = [row for row in lake.runs(name) if row["n_errors"] == 0 and not row["correction"]]
    runs = [lake.load(row) for row in rows]
    if not runs:
        raise InputError(
            "the campaign has no sound log without a correction",
            code="drift.runs",
            where=name,
            got=f"{len(lake.runs(name))} logs",
            hint="dtwin check tells what is wrong with them",
        )
    run = of_twin(runs)
    data = lake.provenance(rows, len(rows)) | {"fitted_to": run.meta.run_id}
    axis = str(run.meta.condition.get("axis", "")).upper()
    return Loaded(name, known.machine, run.meta.run_id, axis, series_of(run), data)
