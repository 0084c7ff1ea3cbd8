"""Test sheet of circular tests after ISO 230-4: both directions, their figures and their picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.circular._across_runs import with_spoilt_told
from dtwin.physics.circular import bidirectional_figures, fit_circle, fit_common_circle, residual_um
from dtwin.report.plots import polar_figure
from dtwin.report.sheet import Characteristic, Part, Sheet, pooled, repeated, sound_runs
from dtwin.report.uncertainty import Circumstances, Contribution, off_line_um
from dtwin.schema import Floats, Run

if TYPE_CHECKING:
    import plotly.graph_objects as go

_WAYS = ("CCW", "CW")
_READING_UM = 0.7
_LENGTH_UM = 1.0
_ASLANT_MM = 0.2
_WHOLE_DEG = 350.0
"""Less than this is an arc; a circle may lack what a window or a lost sample took."""


def circular_sheet(runs: Sequence[Run], under: Circumstances) -> Sheet:
    """Evaluate every condition of a campaign.

    ``runs``: with ``angle_deg`` and ``deviation_um``; runs with an error of quality are left out where there are
    others, and named.
    """
    conditions: dict[tuple[str, float, float], list[Run]] = {}
    notes = []
    for run in with_spoilt_told(runs):
        m = run.meta
        if m.radius_mm is None or m.direction is None:
            notes.append(f"{m.run_id} is not evaluated: it has no radius or direction.")
        elif any(finding.code == "angle.short" for finding in run.findings):
            notes.append(f"{m.run_id} is not evaluated: angle.short.")
        else:
            conditions.setdefault((m.plane or "", m.radius_mm, m.feed_mm_min or 0.0), []).append(run)
    parts = []
    arcs: set[str] = set()
    for (plane, radius_mm, feed), members in sorted(conditions.items()):
        title = f"{plane} R{radius_mm:g}" + (f" F{feed:g}" if feed else "")
        kept: list[Run] = []
        for way in _WAYS:
            evaluated, said = sound_runs([r for r in members if r.meta.direction == way])
            kept += evaluated
            notes += said
        sound = not any(f.severity == "error" for run in kept for f in run.findings)
        try:
            figures = _figures(kept, radius_mm)
        except InputError as error:
            notes.append(f"{title} is not evaluated: {error.message}.")
            continue
        arc_deg = min((_arc_deg(run) for run in kept), default=360.0)
        if arc_deg < _WHOLE_DEG:
            arcs.add(title)
            notes.append(
                f"{title}: arcs of {arc_deg:z.0f}° tell centre and radius badly; ISO 230-4 has F about a least-squares centre, "
                "and D, of whole circles only: no limit of theirs is decided."
            )
        told = tuple(_with_contributions(c, radius_mm, under) for c in figures)
        parts.append(Part(title, tuple(r.meta.run_id for r in kept), told, sound))
    basis = "what runs of one condition differ by (unit of replication: the run, pooled over conditions)"
    told_parts = tuple(_of_an_arc(part) if part.title in arcs else part for part in pooled(parts))
    return Sheet("ISO 230-4, circular test", "G(b)", told_parts, basis, tuple(notes))


def _figures(runs: Sequence[Run], radius_mm: float) -> tuple[Characteristic, ...]:
    characteristics: list[Characteristic] = []
    for way in _WAYS:
        each = [_centred_um(run.arc, radius_mm) for run in runs if run.meta.direction == way]
        if each:
            words = "counter-clockwise" if way == "CCW" else "clockwise"
            characteristics += [
                repeated(f"G({way})", f"circular deviation, {words}", [float(np.ptp(e)) for e in each]),
                repeated(f"Fmax({way})", "largest radial deviation", [float(e.max()) for e in each]),
                repeated(f"Fmin({way})", "smallest radial deviation", [float(e.min()) for e in each]),
            ]
    pairs = [bidirectional_figures(up.arc, down.arc, radius_mm) for up, down in _pairs(runs)]
    if pairs:
        characteristics += [
            repeated(
                "G(b)", "bi-directional circular deviation", [p.circular_deviation_common_centre_um for p in pairs]
            ),
            repeated("H", "radial hysteresis", [p.hysteresis_um for p in pairs]),
            repeated("D", "mean bi-directional radial deviation", [p.mean_bidirectional_radius_um for p in pairs]),
        ]
    return tuple(characteristics)


def _arc_deg(run: Run) -> float:
    """Return how much of a turn the samples go over: all but their largest gap."""
    around = np.sort(run.arc[0] % 360.0)
    return 360.0 - float(np.diff(around, append=around[0] + 360.0).max())


def _of_an_arc(part: Part) -> Part:
    """Return the figures of an arc: radii without uncertainty, for repeats do not show what the arc hides."""

    def told(c: Characteristic) -> Characteristic:
        return replace(c, deviation_um=math.nan, dof=0.0) if _is_radius(c.symbol) else c

    return replace(part, characteristics=tuple(map(told, part.characteristics)))


def _is_radius(symbol: str) -> bool:
    return symbol == "D" or symbol.startswith("F")


def _with_contributions(c: Characteristic, radius_mm: float, under: Circumstances) -> Characteristic:
    """Say what makes a figure uncertain: differences of readings by the instrument, radii by their length, too."""
    contributions = [under.reading(_READING_UM), *under.environment(c.repeats)]
    if _is_radius(c.symbol):
        length = under.stated("calibration_um", _LENGTH_UM)
        aslant = under.stated("height_difference_mm", _ASLANT_MM)
        contributions += [
            Contribution(
                "calibrated length", length.value / 2, length.basis("µm (k = 2)"), assumed=length.assumed, zero=True
            ),
            Contribution(
                "set-up",
                off_line_um(aslant.value, radius_mm),
                f"height difference of the balls {aslant.basis('mm at most')}",
                assumed=aslant.assumed,
            ),
            *under.length(radius_mm / 1000.0),
        ]
    return replace(c, contributions=tuple(contributions))


def _centred_um(arc: tuple[Floats, Floats], radius_mm: float) -> Floats:
    """Return the radial deviation about the circle's own centre, shape (n,)."""
    circle = fit_circle(*arc, radius_mm)
    return residual_um(*arc, radius_mm, circle) + circle.radius_change_um


def _pairs(runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Return the runs of both directions that belong together: same set-up, in their order."""
    pairs = []
    for setup in dict.fromkeys(run.meta.setup for run in runs):
        ways = [[r for r in runs if r.meta.setup == setup and r.meta.direction == way] for way in _WAYS]
        ordered = [sorted(way, key=lambda r: r.meta.repeat) for way in ways]
        pairs += list(zip(*ordered, strict=False))
    return pairs


def both_ways_figure(runs: Sequence[Run]) -> go.Figure:
    """Draw the first run of each direction about one centre."""
    pairs = _pairs(runs)
    shown = list(pairs[0]) if pairs else list(runs[:1])
    radius = float(shown[0].meta.radius_mm or 0.0)
    arcs = [run.arc for run in shown]
    circle = fit_common_circle(arcs, radius)
    curves = {
        f"{run.meta.direction} ({run.meta.run_id})": (
            arc[0],
            residual_um(*arc, radius, circle) + circle.radius_change_um,
        )
        for run, arc in zip(shown, arcs, strict=True)
    }
    title = "Radial deviation about one centre" if len(shown) == 2 else "Radial deviation, centre removed"
    return polar_figure(curves, radius, title=title, plane=shown[0].meta.plane)
