"""What a champion leaves of the distances between balls of a recorded campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.volumetric._evidence import corrections
from dtwin.kinds.volumetric._judging import changes_left_um, distance_changes_um
from dtwin.kinds.volumetric._training import HELD_OUT
from dtwin.kinds.volumetric.session import session_in
from dtwin.lake.store import Lake
from dtwin.progress import Progress
from dtwin.serve.bundle import Bundle
from dtwin.statistics import rms
from dtwin.train.champion_error import ChampionError, HeldOut, held_out


def heat_error(
    lake: Lake, rows: Sequence[dict[str, Any]], bundle: Bundle, metrics: object, progress: Progress | None = None
) -> ChampionError:
    """Return a bundle's error in the changes of distances since the first cycles, as training states it.

    The floor is what the identified error motions leave themselves.
    """
    name = str(rows[0]["campaign"])
    measured = session_in(lake, name, progress or (lambda *_: None))
    if len(rows) != len(measured.hour):
        raise InputError(
            "the cycles of a campaign share their reference and are judged together",
            code="drift.cycles",
            where=f"campaign {name}",
            got=f"{len(rows)} of {len(measured.hour)} cycles",
            hint="new cycles go into a campaign of their own",
        )
    off, trusted = corrections(bundle, measured)
    was = [distance_changes_um(where, moved) for where, moved in measured.moved]
    left = [distance_changes_um(where, moved - by) for (where, moved), by in zip(measured.moved, off, strict=True)]
    seen = changes_left_um(measured, measured.values)
    return ChampionError(
        rms_um=rms(np.concatenate(left)),
        before_um=rms(np.concatenate(was)),
        noise_floor_um=rms(np.concatenate(seen)),
        outside_box_share=float(np.mean(np.array(trusted) < 1.0)),
        n_runs=len(rows),
    )


def heat_held_out(known: Sequence[Mapping[str, Any]], fresh: Sequence[Mapping[str, Any]]) -> HeldOut:
    """Return the error to be expected: with spans of hours left out."""
    return held_out(HELD_OUT)
