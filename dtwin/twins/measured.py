"""Measurements for a twin, and how it compares with them.

Runs are reduced to one value per degree, kept in a file. The file is only a short cut. It names what it was made from (the content of the runs and the code
that reduces them), and is made anew when that differs or when the file is spoilt.
"""

from __future__ import annotations

import hashlib
import json
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.amending import AMENDED, amendment_findings
from dtwin.acquire.campaign_name import in_lake
from dtwin.atomic import whole_file
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.features.encoder_split import Cutoff
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.machine_record import read_record
from dtwin.physics import centres, grid, gridding, localise, observations
from dtwin.physics.gridding import CIRCLE, N_BINS, Condition
from dtwin.physics.observations import Observations, observe
from dtwin.physics.screw import PITCH
from dtwin.physics.twin import Twin, by_condition
from dtwin.physics.whitening import PureError, pure_error, to_harmonics
from dtwin.schema import Campaign, Floats, RunMeta, of_one_way, require_name
from dtwin.twins import encoder_comparison
from dtwin.twins.encoder_comparison import DEFAULT_CUTOFF, controller_rows_um, encoder_split


@dataclass(frozen=True)
class Loaded:
    """Runs of a campaign, ready to look at.

    ``data``: table versions, a hash of what was used, ``left_out``: runs and why, and ``amended``: what was stated
    anew.
    ``controller_um``, shape (rows, n): following error that the controller saw; None when it was not logged.
    """

    obs: Observations
    data: Mapping[str, Any]
    controller_um: Floats | None = None


@dataclass(frozen=True)
class Comparison:
    """Measured against predicted.

    ``residual_um``, shape (rows, n): measured minus predicted.
    ``before_um``, shape (rows, n): measured, set-ups taken out.
    ``warnings``: what a reader must know: another machine, outside the box.
    ``controller_um``, shape (rows, n): following error that the controller saw; None when it was not logged.
    """

    twin: Twin
    obs: Observations
    residual_um: Floats
    before_um: Floats
    warnings: tuple[str, ...]
    controller_um: Floats | None = None

    def as_dict(self, cutoff: Cutoff = DEFAULT_CUTOFF) -> dict[str, Any]:
        """Return a JSON-ready mapping.

        ``cutoff``: where quasi-static ends and dynamic begins, when the controller was logged.
        """
        obs = self.obs
        parts = encoder_split(obs, self.controller_um, cutoff)
        floor = _pure_error(obs, self.residual_um)
        return {
            "twin": self.twin.name,
            "version": self.twin.version,
            "campaign": obs.campaign.name,
            "runs": len(set(obs.run_of.tolist())),
            "rms_before_um": obs.rms(self.before_um),
            "residual_rms_um": obs.rms(self.residual_um),
            "systematic_rms_um": localise.systematic_rms_um(obs, self.residual_um),
            "noise_floor_um": float("nan") if floor is None else floor.floor_um,
            "noise_floor_dof": 0 if floor is None else floor.dof,
            "conditions": list(by_condition(obs, self.before_um, self.residual_um)),
            "where": [dict(w) for w in localise.worst_places(obs, self.residual_um)],
            "headline": localise.headline(obs, self.residual_um),
            "encoder_split": None if parts is None else parts.as_dict(),
            "warnings": list(self.warnings),
        }


def pure_rms_um(obs: Observations, residual_um: Floats) -> float:
    """Return the RMS of one run about the mean of its condition; NaN without repeats."""
    pure = _pure_error(obs, residual_um)
    return float("nan") if pure is None else pure.floor_um


def _pure_error(obs: Observations, residual_um: Floats) -> PureError | None:
    return pure_error(to_harmonics(residual_um), obs.condition_of, float(obs.mask.mean()))


def load(home: Home, campaign: str) -> Loaded:
    """Return the usable runs of a campaign.

    ``campaign``: name in the lake, or a file or folder, which is ingested first.
    Raises ``InputError`` when there is no such campaign, or no usable run in it.
    """
    lake = Lake(home.lake)
    name = in_lake(home, campaign)
    stored = lake.campaign(name)
    rows = lake.runs(name, left_out=True)
    left_out = {str(row["run_id"]): why for row in rows if (why := row["left_out"] or _error_in(row))}
    sound = [row for row in rows if str(row["run_id"]) not in left_out]
    usable = of_one_way(sound)
    if corrected := [str(row["run_id"]) for row in sound if row not in usable]:
        left_out[", ".join(corrected)] = "measured with a correction"
    if not usable:
        why = "; ".join(f"{k}: {v}" for k, v in list(left_out.items())[:3])
        raise InputError(
            "the campaign has no usable run",
            code="twin.no_runs",
            where=name,
            got=why or "no runs",
            hint=f"dtwin check {name}",
        )
    kind_named(stored.kind).require("rows")
    data = lake.provenance(usable, len(usable)) | {
        "left_out": left_out,
        "amended": [f.message for f in amendment_findings(rows) if f.code == AMENDED],
    }
    obs, controller_um = _reduced(home, lake, stored, usable)
    return Loaded(_with_pitch(home, obs), data | {"wander_um": obs.wander_um}, controller_um)


def _with_pitch(home: Home, obs: Observations) -> Observations:
    """Return positions of an axis with the pitch of its screw that the machine's record states, where the campaign states none."""
    campaign = obs.campaign
    record = (
        read_record(home, campaign.machine) if obs.there_and_back and PITCH not in campaign.machine_geometry else None
    )
    stated = [known["pitch_mm"] for axis in obs.axes if record and "pitch_mm" in (known := record.axes.get(axis, {}))]
    if not stated:
        return obs
    return replace(obs, campaign=replace(campaign, machine_geometry={**campaign.machine_geometry, PITCH: stated[0]}))


def rises_from_one(loaded: Sequence[Loaded]) -> list[Loaded]:
    """Return campaigns that count rises of a temperature from one value, the mean of their means.

    From the mean of each, growth between them would be another scale of each.
    """
    told = common_temperatures([one.obs for one in loaded])
    return [replace(one, obs=from_temperatures(one.obs, told)) for one in loaded]


def common_temperatures(campaigns: Sequence[Observations]) -> dict[str, float]:
    """Return what several campaigns count rises of their temperatures from, degC, by column."""
    every = [(name, mean) for obs in campaigns for name, mean in obs.means.items() if name.endswith("_c")]
    return {name: float(np.mean([mean for other, mean in every if other == name])) for name, _ in every}


def from_temperatures(obs: Observations, told: Mapping[str, float]) -> Observations:
    """Return a campaign that counts rises from given temperatures, degC, by column."""
    return replace(obs, told_from={name: told[name] for name in obs.means if name in told}) if told else obs


def _error_in(row: Mapping[str, Any]) -> str:
    """Return the first error that was found in a run, empty when there is none."""
    findings = json.loads(row["findings_json"])
    return next((str(f["message"]) for f in findings if f["severity"] == "error"), "")


def _reduced(
    home: Home, lake: Lake, campaign: Campaign, rows: Sequence[Mapping[str, Any]]
) -> tuple[Observations, Floats | None]:
    stamp = _stamp_of(rows)
    kept = _read_reduced(home, campaign.name, stamp)
    if kept is not None:
        return kept
    runs = [lake.load(row, signals=False) for row in rows]
    obs = observe(campaign, runs)
    made = obs, controller_rows_um(runs) if obs.grid is CIRCLE else None
    _keep_reduced(home, campaign.name, stamp, made)
    return made


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


def _stamp_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what a reduction of these runs of the lake is made from. ``rows``: rows of the lake's table of runs."""
    digest = hashlib.sha256(_code_sha256().encode())
    for row in rows:
        digest.update(json.dumps(row, sort_keys=True, default=str).encode())
    return digest.hexdigest()


def _read_reduced(home: Home, campaign: str, stamp: str) -> _Reduced | None:
    """Return the runs and what the controller saw; None when they are to be made.

    ``stamp``: as ``_stamp_of`` gives it.
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
        wander_um=words["wander_um"],
        columns=tuple(numbers),
        **arrays,
    )
    return obs, controller


def _keep_reduced(home: Home, campaign: str, stamp: str, reduced: _Reduced) -> None:
    """Keep reduced runs; where there is no room they are made again the next time.

    ``home``, ``campaign``, ``stamp``: as in ``_read_reduced``.
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
        "wander_um": obs.wander_um,
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
    for module in (grid, gridding, centres, observations, encoder_comparison):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()
