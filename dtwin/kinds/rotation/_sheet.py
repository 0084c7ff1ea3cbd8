"""Test sheet of a turning axis after ISO 230-7, and its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dtwin.kinds.kind import Drawing
from dtwin.kinds.rotation._at_rest import at_rest
from dtwin.kinds.rotation._heads import AT_REST, figure_of
from dtwin.kinds.rotation._runout import groups_in, is_over_speed
from dtwin.kinds.rotation._turns import Turns, Value, figures_of, filtered, once_of, synchronous_um, turns_of
from dtwin.report.plots import error_figure, lacks_columns, polar_figure
from dtwin.report.sheet import Characteristic, Part, Sheet, pooled, repeated, sound_runs
from dtwin.report.uncertainty import Circumstances, Contribution
from dtwin.schema import Floats, Run

if TYPE_CHECKING:
    import plotly.graph_objects as go

_READING_UM = 0.5
_MOST_DRAWN = 40
_RADIUS_MM = 100.0
_BASIS = {
    "turns": "what blocks of neighbouring turns differ by (unit of replication: the block, of six or fewer turns the turn)",
    "table": "what run-outs at one speed differ by (unit of replication: the row, pooled over speeds)",
    "rest": "what turns by hand differ by (unit of replication: the turn)",
}


def rotation_sheet(runs: Sequence[Run], under: Circumstances) -> Sheet:
    """Evaluate every probe at every speed."""
    parts: list[Part] = []
    notes: list[str] = []
    tables: list[Part] = []
    by_hand: list[Part] = []
    for run in runs:
        notes += sound_runs([run])[1]
        sound = not any(f.severity == "error" for f in run.findings)
        if is_over_speed(run):
            tables += pooled(_over_speed(run, under, sound))
            continue
        if run.meta.condition.get("form") == AT_REST:
            by_hand.append(Part(f"{run.meta.run_id}, at rest", (run.meta.run_id,), _still(run, under), sound))
            continue
        turns = turns_of(run)
        if turns is None:
            notes.append(f"{run.meta.run_id} is not evaluated: it has no whole turn.")
            continue
        parts.append(Part(_title(run), (run.meta.run_id,), _figures(turns, under), sound))
    forms = (("turns", parts), ("table", tables), ("rest", by_hand))
    basis = "; ".join(_BASIS[form] for form, there in forms if there)
    tables += by_hand
    told = [c.symbol for part in tables for c in part.characteristics]
    headline = "S" if parts else "TIR" if "TIR" in told or not told else told[0]
    return Sheet("ISO 230-7, axes of rotation", headline, (*parts, *tables), basis, tuple(notes))


def _figures(turns: Turns, under: Circumstances) -> tuple[Characteristic, ...]:
    f = figures_of(turns)
    once = "axial once per turn, amplitude" if turns.axial else "once per turn, of the target"
    named: tuple[tuple[str, str, Value], ...] = (
        ("TIR", "total run-out", f.total),
        ("e", once, f.once_amplitude),
        ("S", "synchronous error motion", f.synchronous),
        *((("R", "residual synchronous error motion", f.residual),) if turns.axial else ()),
        ("A", "asynchronous error motion", f.asynchronous),
    )
    return tuple(
        _characteristic(symbol, name, value, under) for symbol, name, value in named if math.isfinite(value.um)
    )


def _still(run: Run, under: Circumstances) -> tuple[Characteristic, ...]:
    told = at_rest(run)
    figures = (
        repeated("TIR", f"run-out at rest, of {len(told.angle_deg)} places", told.total_um.tolist()),
        repeated("e", "once per turn, of the target", np.abs(told.once).tolist()),
    )
    return tuple(
        replace(figure, contributions=_contributions(figure.symbol, figure.value_um, under)) for figure in figures
    )


def _characteristic(symbol: str, name: str, value: Value, under: Circumstances) -> Characteristic:
    known = value.blocks > 1 and math.isfinite(value.block_um)
    dof = float(value.blocks - 1) if known else 0.0
    return Characteristic(
        symbol, name, value.um, value.blocks, value.block_um, dof, contributions=_contributions(symbol, value.um, under)
    )


def _contributions(symbol: str, value_um: float, under: Circumstances) -> tuple[Contribution, ...]:
    reading, *share = under.probe(_READING_UM, value_um)
    # An amplitude is half a difference of two readings.
    return (replace(reading, standard_um=reading.standard_um / 2) if symbol == "e" else reading, *share)


def _over_speed(run: Run, under: Circumstances, sound: bool) -> list[Part]:
    out = []
    symbol, name = figure_of(str(run.meta.condition.get("probe", "")))
    for group in groups_in(run):
        told = repeated(symbol, name, [float(v) for v in group.runout_um])
        told = replace(told, contributions=_contributions(symbol, told.value_um, under))
        out.append(Part(f"{run.meta.run_id}, {group.speed_rpm:z.5g} rpm", (run.meta.run_id,), (told,), sound))
    return out


def _title(run: Run) -> str:
    told = run.meta.condition.get("speed_rpm")
    return f"{run.meta.run_id}, {told:.5g} rpm" if isinstance(told, int | float) else run.meta.run_id


def rotation_figure(runs: Sequence[Run]) -> go.Figure:
    """Draw a run as the polar picture of the standard, a table as its run-outs over speed."""
    if runs[0].meta.condition.get("form") == AT_REST:
        return _by_places(runs[0])
    return _over_table(runs[0]) if is_over_speed(runs[0]) else _polar(runs[0])


def _by_places(run: Run) -> go.Figure:
    told = at_rest(run)
    level = float(told.read_um.mean())
    fine = np.linspace(0.0, 360.0, 121)
    once = complex(told.once.mean()) * np.exp(-1j * np.radians(fine))
    curves = {"read": (told.angle_deg, told.read_um.mean(axis=0) - level), "once per turn": (fine, once.real)}
    return error_figure(curves, title=f"{run.meta.run_id}: at rest", x_title="angle, deg", y_title="reading, µm")


def _over_table(run: Run) -> go.Figure:
    groups = groups_in(run)
    speed = np.array([g.speed_rpm for g in groups])
    mean = np.array([float(g.runout_um.mean()) for g in groups])
    curves = {run.meta.run_id: (speed, mean)}
    symbol, name = figure_of(str(run.meta.condition.get("probe", "")))
    return error_figure(
        curves,
        title=f"{'Run-out' if symbol == 'TIR' else 'Error motion'} over speed, mean of repeats",
        x_title="speed, rpm",
        y_title=f"{name}, µm",
    )


def _polar(run: Run) -> go.Figure:
    turns = turns_of(run)
    if turns is None:
        return error_figure({}, title=f"{run.meta.run_id}: no whole turn")
    every, mean = _curves(turns)
    order = np.argsort(turns.angle_deg)
    closed = np.append(turns.angle_deg[order], turns.angle_deg[order][0] + 360.0)
    thin = np.linspace(0, turns.n - 1, min(turns.n, _MOST_DRAWN)).round().astype(int)
    # One line over all turns: asynchronous motion is the width of the band.
    angle = np.concatenate([closed + 360.0 * n for n in range(len(thin))])
    band = np.concatenate([np.append(row[order], row[order][0]) for row in every[thin]])
    curves = {"turns": (angle, band), "synchronous": (closed, np.append(mean[order], mean[order][0]))}
    return polar_figure(curves, _RADIUS_MM, title=f"{run.meta.run_id}: turns, and their mean")


def _curves(turns: Turns) -> tuple[Floats, Floats]:
    """Return turns and their mean as error motion: without what comes once per turn where that is the target's."""
    mean = synchronous_um(turns)[0]
    every = filtered(turns.moved_um)
    if not turns.axial:
        wave = once_of(every.mean(axis=0), turns.angle_deg) * np.exp(-1j * np.radians(turns.angle_deg))
        every = every - wave.real
    return every - every.mean(), mean


def _drawn(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    _require(run)
    return rotation_figure([run])


def _require(run: Run) -> None:
    if not ({"angle_deg", "displacement_um"} <= set(run.samples) or is_over_speed(run)):
        raise lacks_columns(run, "displacement over an angle", "angle_deg, displacement_um; or speed_rpm, runout_um")


def _over_angle(run: Run, floor_um: Callable[[], float]) -> go.Figure:
    _require(run)
    if not _has_angles(run):
        return rotation_figure([run])
    turns = turns_of(run)
    if turns is None:
        return error_figure({}, title=f"{run.meta.run_id}: no whole turn")
    order = np.argsort(turns.angle_deg)
    low, high = (of(turns.read_um, axis=0)[order] for of in (np.min, np.max))
    middle = turns.read_um.mean(axis=0)[order]
    at = turns.angle_deg[order]
    level = middle.mean()
    curves = {"mean of turns": (at, middle - level), "lowest": (at, low - level), "highest": (at, high - level)}
    return error_figure(
        curves,
        title=f"{run.meta.run_id}: reading over the angle, features included",
        x_title="angle, deg",
        y_title="reading, µm",
    )


def _has_angles(run: Run) -> bool:
    """Tell whether a run is read over the angle, of which its test sheet has another picture."""
    return not is_over_speed(run) and run.meta.condition.get("form") != AT_REST


DRAWINGS = (
    Drawing("polar", "Synchronous and asynchronous error motion", 560, _drawn, half=True, in_sheet=True),
    Drawing("angle", "Reading over the angle", 460, _over_angle, half=True, fits=_has_angles),
)
