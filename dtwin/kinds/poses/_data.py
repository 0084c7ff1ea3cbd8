"""Runs of poses with their chain, and as a problem to fit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.poses._chain import KNOWN, chain_of
from dtwin.kinds.poses._fit import Grams
from dtwin.kinds.poses._iso9283 import joints_of, measured_of, numbers_of, times_of
from dtwin.kinds.poses._series import series_of
from dtwin.kinds.poses._setup import Setup
from dtwin.kinds.poses._urdf import stated_chain
from dtwin.lake.store import Lake
from dtwin.schema import Campaign, Floats, Run


@dataclass(frozen=True)
class Loaded:
    """A campaign, ready to fit.

    ``data``: table versions and a hash of what was used.
    ``rows`` (n,): numbers of its rows in their table.
    """

    campaign: str
    machine: str
    grams: Grams
    data: Mapping[str, Any]
    rows: NDArray[np.int64]


def with_chain(run: Run, campaign: Campaign) -> Run:
    """Return a run that knows the chain of its robot; its condition carries it. One without joints needs none."""
    if not joints_of(run).size:
        return run
    geometry = campaign.machine_geometry
    read = stated_chain(geometry, Path(run.source).parent)
    dh = chain_of(geometry, campaign.name) if read is None else read
    if dh.shape[0] != joints_of(run).shape[1]:
        raise InputError(
            "chain and table differ in their joints",
            code="poses.joints",
            where=run.source,
            got=f"{joints_of(run).shape[1]} columns joint_N_deg",
            allowed=f"{dh.shape[0]}, as the chain has",
        )
    name = str(geometry.get("chain", "")).lower()
    told = name if name in KNOWN and not {"dh", "urdf"} & set(geometry) else json.dumps(dh.round(9).tolist())
    return replace(run, meta=replace(run.meta, condition={**run.meta.condition, "chain": told}))


def chain_in(run: Run) -> Floats:
    """Return the chain that the condition of a run carries."""
    told = str(run.meta.condition["chain"])
    return KNOWN[told] if told in KNOWN else np.array(json.loads(told))


def load(home: Home, campaign: str, setup: Setup | None = None) -> Loaded:
    """Return a campaign of the lake or of a folder, which is ingested first.

    ``setup``: frame and tool of another campaign of the same mounting; fitted without.

    Raises ``InputError`` when it has no sound run, with what is wrong, or several: each has a frame and a tool of its own.
    """
    lake, name = Lake(home.lake), in_lake(home, campaign)
    known = lake.campaign(name)
    if known.kind != "poses":
        raise InputError("not a campaign of poses", code="poses.kind", where=name, got=known.kind, allowed="poses")
    there = list(lake.iterate(name))
    wrong = [(run, f) for run in there for f in run.findings if f.severity == "error"]
    runs = [run for run in there if not any(run is unsound for unsound, _ in wrong)]
    if there and not runs:
        run, found = wrong[0]
        raise InputError(
            "the run is not sound, and no twin is fitted to it",
            code=found.code,
            where=f"{name} {run.meta.run_id}",
            got=found.message,
            hint=f"dtwin check {name} tells all that is wrong with it",
        )
    if len(runs) != 1:
        raise InputError(
            "a twin of poses is fitted to one run",
            code="poses.runs",
            where=name,
            got=f"{len(runs)} sound runs",
            hint="a campaign for each table; dtwin twin compare NAME CAMPAIGN tries the twin on another",
        )
    run = runs[0]
    if not joints_of(run).size:
        raise InputError(
            "a twin of an arm needs joints",
            code="poses.joints",
            where=name,
            got="commanded and measured places",
            allowed="joint_1_deg … beside them, and a chain",
            hint="dtwin check tells the figures of ISO 9283 without them",
        )
    ambient = run.samples.get("ambient_c")
    series = series_of(joints_of(run), measured_of(run), chain_in(run), ambient, setup, times_of(run))
    data = lake.provenance(lake.runs(name), len(series.error_mm))
    return Loaded(name, known.machine, Grams(series), data, numbers_of(run))
