"""Ball-array campaigns of the lake for a twin, also of several kinds: all error motions that the balls can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, design
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric._identify import FIXED_POSE, Artefact, Balls, Settled
from dtwin.kinds.volumetric._session import REFERENCE_CYCLES, Session, session_in
from dtwin.kinds.volumetric.motions import HeatTerm
from dtwin.lake.store import Lake
from dtwin.progress import silent
from dtwin.schema import Floats
from dtwin.statistics import chi2_tail

_ORDERS = (1, 2)
_MOST_MORE = 3
_ALPHA = 1e-3
_PLACES = 5
_DAY_H = 24.0


@dataclass(frozen=True)
class HeatLoaded:
    """A campaign, ready to look at.

    ``units``, (balls, 3, motions): what a unit of each motion does there, in um.
    ``data``: table versions, number of cycles, and a hash of what was used.
    """

    series: HeatSeries
    balls: tuple[Balls, ...]
    units: tuple[Floats, ...]
    data: Mapping[str, Any]

    def worst_places(self, left: Floats) -> tuple[dict[str, Any], ...]:
        """Return the poses, directions and days in which motions are left most, RMS at the balls.

        What the motions themselves leave, noise and what moves within a cycle, is not in it.

        ``left``, (cycles, motions): what is left of the motions.
        """
        hours = self.series.hour
        squares: dict[tuple[int, int, int], list[Floats]] = {}
        for hour, where, unit, gone in zip(hours, self.balls, self.units, left, strict=True):
            rest = unit @ gone
            for pose in sorted(set(where.pose.tolist())):
                rows = where.pose == pose
                for axis in range(3):
                    key = (int(pose), axis, int((hour - hours[0]) // _DAY_H))
                    squares.setdefault(key, []).append(rest[rows, axis] ** 2)
        size = {key: float(np.sqrt(np.concatenate(parts).mean())) for key, parts in squares.items()}
        worst = sorted(size, key=lambda key: -size[key])[:_PLACES]
        return tuple(
            {
                "pose": pose,
                "what": "balls on the table" if pose == FIXED_POSE else "array",
                "axis": "XYZ"[axis],
                "hours": [float(hours[0]) + _DAY_H * day, float(hours[0]) + _DAY_H * (day + 1)],
                "residual_rms_um": size[pose, axis, day],
            }
            for pose, axis, day in worst
        )


class HeatCampaign:
    """A ball-array campaign: which error motions are identified in its cycles depends on what is asked.

    ``campaign``: name in the lake, or a folder, which is ingested first.
    """

    data: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, home: Home, campaign: str) -> None:
        self._lake, self.campaign = Lake(home.lake), in_lake(home, campaign)
        self.machine = self._lake.campaign(self.campaign).machine
        self._cycles: HeatLoaded | None = None

    def cycles(self, terms: Sequence[HeatTerm]) -> HeatLoaded:
        """Return the usable cycles, with the motions of some terms identified beside the usual ones."""
        wanted = [term.motion for term in terms]
        if self._cycles is None or not set(wanted) <= set(self._cycles.series.names):
            self._cycles = _loaded(self._lake, self.campaign, wanted)
        return self._cycles


def _loaded(lake: Lake, name: str, wanted: Sequence[str]) -> HeatLoaded:
    measured = session_in(lake, name, silent)
    names, settled = _identified(measured, wanted)
    strokes = measured.artefact.strokes_mm
    units = tuple(design(where.position_mm, strokes, names) for where, _ in measured.moved)
    grams, left_ms = [], []
    for unit, session in zip(units, settled, strict=True):
        flat = unit.reshape(-1, len(names))
        grams.append(flat.T @ flat / len(flat))
        left_ms.append(float(((session.moved_um - unit @ session.values) ** 2).mean()))
    thermocouples = dict(zip(measured.sensors, measured.rise_c.T, strict=True))
    offered = {channel: measured.offered_rise(channel) for channel in measured.offered_c}
    begun = dict(zip(measured.sensors, measured.begun_c.tolist(), strict=True))
    begun |= {channel: float(read[:REFERENCE_CYCLES].mean()) for channel, read in measured.offered_c.items()}
    series = HeatSeries(
        name,
        lake.campaign(name).machine,
        measured.hour,
        names,
        np.array([session.values for session in settled]),
        np.array([session.covariance for session in settled]),
        np.array(grams),
        np.array(left_ms),
        {**thermocouples, **offered},
        begun,
        measured.sensors,
    )
    balls = tuple(where for where, _ in measured.moved)
    return HeatLoaded(series, balls, units, lake.provenance(lake.runs(name), len(settled)))


def _identified(measured: Session, wanted: Sequence[str]) -> tuple[tuple[str, ...], list[Settled]]:
    """Return the usual error motions, those wanted, and those that move besides, all identified at once.

    A motion that is left out shows up in the others; one too many makes all of them less certain. So
    the usual ones are joined, one by one, by those that move for sure.
    """
    names = (*COEFFICIENTS, *(n for n in dict.fromkeys(wanted) if n not in COEFFICIENTS))
    settled = _settled(measured, names)
    for _ in range(_MOST_MORE):
        better: list[tuple[float, tuple[str, ...], list[Settled]]] = []
        offered = _tellable(measured, names)
        for more in offered:
            try:
                identified = _settled(measured, (*names, more))
            except InputError:
                # A cycle that lost balls cannot tell it, although the first one can.
                continue
            p, size = _moves(identified)
            if p * len(offered) < _ALPHA:
                better.append((size, (*names, more), identified))
        if not better:
            break
        _, names, settled = max(better, key=lambda b: b[0])
    return names, settled


def _tellable(measured: Session, names: tuple[str, ...]) -> list[str]:
    """Return further error motions that the balls of the first cycle can tell from these."""
    out = []
    for name in (f"E{letter}{axis}{order}" for letter in "XYZABC" for axis in "XZY" for order in _ORDERS):
        if name not in names:
            report = _artefact(measured, (*names, name)).report(measured.moved[0][0])
            if report.rank == report.wanted:
                out.append(name)
    return out


def _artefact(measured: Session, names: tuple[str, ...]) -> Artefact:
    return replace(measured.artefact, held_out=(), names=names, _ready={})


def _settled(measured: Session, names: tuple[str, ...]) -> list[Settled]:
    artefact = _artefact(measured, names)
    return [artefact.settle(where, moved) for where, moved in measured.moved]


def _moves(settled: Sequence[Settled]) -> tuple[float, float]:
    """Return the p-value of the last motion standing still, and how far it moves beyond its noise."""
    values = np.array([session.values[-1] for session in settled])
    noise = np.sqrt([session.covariance[-1, -1] for session in settled])
    ratio = (values - values.mean()) / noise
    power = float(ratio @ ratio)
    return chi2_tail(power, len(values) - 1), power
