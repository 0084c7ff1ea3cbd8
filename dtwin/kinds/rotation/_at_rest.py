"""An axis turned by hand to a few places: what a dial indicator reads there tells run-out and eccentricity, and no error motion."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from dtwin.schema import Finding, Floats, Run
from dtwin.units import shown_number

_FEWEST, _MOST = 4, 36
_WIDEST_DEG = 120.0
_LARGE_UM = 20e3
_BACK = 0.1
"""Of the run-out: by so much a reading differs that is told not to come back."""


@dataclass(frozen=True)
class _AtRest:
    """Whole turns of readings at the same places.

    ``angle_deg`` (places,): ascending. ``read_um`` (turns, places).
    ``once``: amplitude and phase of what comes once per turn, of each turn (turns,), in µm, by least squares.
    ``off_um``: largest difference of a reading that was made again, beyond the last whole turn; NaN without.
    """

    angle_deg: Floats
    read_um: Floats
    once: Floats
    off_um: float

    @property
    def total_um(self) -> Floats:
        """Range of each turn (turns,)."""
        return np.asarray(np.ptp(self.read_um, axis=1))


def _place(angle_deg: float) -> float:
    return round(angle_deg % 360.0, 1) % 360.0


def is_at_rest(angle_deg: Floats) -> bool:
    """Return whether angles are 4 to 36 places all round a turn, as an axis is turned to by hand."""
    places = np.unique([_place(a) for a in angle_deg[np.isfinite(angle_deg)].tolist()])
    gaps = np.diff(places, append=places[:1] + 360.0)
    return _FEWEST <= len(places) <= _MOST and bool(gaps.max() < _WIDEST_DEG)


def at_rest(run: Run) -> _AtRest:
    """Return what was read in whole turns; a place that is read again is of the next one."""
    seen: Counter[float] = Counter()
    turns: list[dict[float, float]] = []
    for angle, um in zip(run.samples["angle_deg"].tolist(), run.samples["displacement_um"].tolist(), strict=True):
        place = _place(angle)
        if seen[place] == len(turns):
            turns.append({})
        turns[seen[place]][place] = um
        seen[place] += 1
    places = sorted(seen)
    whole = [turn for turn in turns if len(turn) == len(places)]
    again = [abs(um - whole[-1][place]) for turn in turns[len(whole) :] for place, um in turn.items()]
    read = np.array([[turn[place] for place in places] for turn in whole])
    turned = np.radians(places)
    design = np.column_stack([np.ones(len(places)), np.cos(turned), np.sin(turned)])
    _, cosine, sine = np.linalg.lstsq(design, read.T, rcond=None)[0]
    return _AtRest(np.array(places), read, cosine + 1j * sine, max(again, default=float("nan")))


def judge_at_rest(run: Run) -> list[Finding]:
    """Return what readings at rest tell, and what is wrong with them."""
    told = at_rest(run)
    total, once = float(told.total_um.mean()), complex(told.once.mean())
    if total == 0.0 or total > _LARGE_UM:
        wrong = (
            "all readings are equal: the indicator does not touch" if total == 0.0 else "the readings span over 20 mm"
        )
        return [Finding("rotation.size", "error", wrong, {"range_um": total})]
    said = (
        f"{len(told.angle_deg)} places of an axis that was turned by hand: the target is off the axis by {shown_number(abs(once))} µm, towards "
        f"{np.degrees(np.angle(once)) % 360.0:z.0f}°, which alone makes a run-out of {shown_number(2.0 * abs(once))} µm; no error motion is known at rest"
    )
    findings = [Finding("rotation.at_rest", "info", said, {"once_um": abs(once), "range_um": total})]
    if told.off_um > _BACK * total:
        back = f"where it was read again after a turn the indicator was off by up to {shown_number(told.off_um)} µm: it moved, or slipped"
        findings.append(Finding("rotation.not_back", "warning", back, {"off_um": told.off_um}))
    return findings
