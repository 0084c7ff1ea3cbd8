"""Runs reduced to one value per degree, kept in a file: reading a thousand runs again takes long.

The file is only a short cut. It names what it was made from (the content of the runs and the code
that reduces them), and is made anew when that differs or when the file is spoilt.
"""

from __future__ import annotations

import hashlib
import json
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.atomic import whole_file
from dtwin.config import Home
from dtwin.errors import StoreError
from dtwin.physics import grid, gridding, observations
from dtwin.physics.gridding import CIRCLE, N_BINS, Condition
from dtwin.physics.observations import Observations
from dtwin.schema import Campaign, Floats, RunMeta, require_name
from dtwin.twins import encoder_comparison

_ARRAYS = ("y_um", "mask", "condition_of", "setup_of", "run_of", "feed_mm_s")
_COLUMN, _CONTROLLER, _WORDS = "column:", "controller_um", "words"
# What reading a damaged file of arrays may raise; a header may ask for any amount of memory.
_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    MemoryError,
    OverflowError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
    SyntaxError,
    tokenize.TokenError,
)
_Reduced = tuple[Observations, Floats | None]


def stamp_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what a reduction of these runs of the lake is made from. ``rows``: rows of the lake's table of runs."""
    digest = hashlib.sha256(_code_sha256().encode())
    for row in rows:
        digest.update(json.dumps(row, sort_keys=True, default=str).encode())
    return digest.hexdigest()


def read_reduced(home: Home, campaign: str, stamp: str) -> _Reduced | None:
    """Return the runs and what the controller saw; None when they are to be made.

    ``stamp``: as ``stamp_of`` gives it.
    """
    path = _path(home, campaign)
    try:
        with np.load(path, allow_pickle=False) as kept:
            words = json.loads(str(kept[_WORDS]))
            if words.pop("stamp") != stamp:
                return None
            arrays = {name: kept[name] for name in _ARRAYS}
            wide = {n.removeprefix(_COLUMN): kept[n] for n in kept.files if n.startswith(_COLUMN)}
            controller = kept[_CONTROLLER] if _CONTROLLER in kept.files else None
    except _DAMAGED:
        return None
    numbers: list[dict[str, Any]] = words["columns"]
    for name, values in wide.items():
        for row, value in zip(numbers, values, strict=True):
            if not np.isnan(value).all():
                row[name] = value
    obs = Observations(
        campaign=Campaign(**words["campaign"]),
        runs=tuple(RunMeta(**meta) for meta in words["runs"]),
        conditions=tuple(Condition(**c) for c in words["conditions"]),
        setups=tuple(words["setups"]),
        columns=tuple(numbers),
        **arrays,
    )
    return obs, controller


def keep_reduced(home: Home, campaign: str, stamp: str, reduced: _Reduced) -> None:
    """Keep reduced runs; where there is no room they are made again the next time.

    ``home``, ``campaign``, ``stamp``: as in ``read_reduced``.
    """
    obs, controller = reduced
    if obs.grid is not CIRCLE:
        # Sweeps and tones are few numbers: they are reduced again each time.
        return
    names = sorted({n for row in obs.columns for n, v in row.items() if np.ndim(v)})
    blank = np.full(N_BINS, np.nan)
    arrays = {name: getattr(obs, name) for name in _ARRAYS}
    arrays |= {
        f"{_COLUMN}{name}": np.array([np.broadcast_to(row.get(name, blank), N_BINS) for row in obs.columns])
        for name in names
    }
    if controller is not None:
        arrays[_CONTROLLER] = controller
    words = {
        "stamp": stamp,
        "campaign": asdict(obs.campaign),
        "runs": [asdict(meta) for meta in obs.runs],
        "conditions": [c.as_dict() for c in obs.conditions],
        "setups": obs.setups,
        "columns": [{n: float(v) for n, v in row.items() if n not in names} for row in obs.columns],
    }
    try:
        with whole_file(_path(home, campaign), "the reduced runs") as partial, partial.open("wb") as file:
            np.savez(file, **arrays, words=np.array(json.dumps(words)))
    except StoreError:
        return


def _path(home: Home, campaign: str) -> Path:
    return home.reduced / f"{require_name(campaign, 'the campaign')}.npz"


@cache
def _code_sha256() -> str:
    """Return the check sum of the code that reduces runs."""
    digest = hashlib.sha256()
    for module in (grid, gridding, observations, encoder_comparison):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()
