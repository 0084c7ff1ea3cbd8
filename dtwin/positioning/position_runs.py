"""A positioning test that was read from a table: its cycles as runs, and what is said of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.positioning.assignments import wrong_form
from dtwin.positioning.table_heads import OWN_SENSOR
from dtwin.positioning.ways import LENGTHS, Scale
from dtwin.schema import Finding, Floats, Run, RunMeta
from dtwin.units import shown_number

_PERIOD_S = 1.0
_LISTED = 4


@dataclass(frozen=True)
class PositionTable:
    """A positioning test.

    ``target_mm`` (targets,): ascending; of an axis that turns in degrees, as ``scale`` says.
    ``forward_um``, ``reverse_um`` (targets, cycles): actual minus target, µm or seconds of arc; NaN where nothing was read.
    ``by_position``: whether the table holds positions, not deviations.
    ``in_order``: whether it names no direction, and the order of its targets told it.
    ``unit_told``: whether it states a unit.
    ``joined_mm``: by how much targets that are taken as one differ from it at most.
    ``read_with``: the instrument, where columns of a report name it.
    ``left_out``: titles of its tables of a single pass, beside those of several cycles.
    ``otherwise``: whether its heads say deviations all the same.
    ``apart``: a column that is not known, and tells rows apart that are counted as cycles.
    """

    target_mm: Floats
    forward_um: Floats
    reverse_um: Floats
    by_position: bool
    in_order: bool = False
    unit_told: bool = True
    joined_mm: float = 0.0
    read_with: str = ""
    left_out: tuple[str, ...] = ()
    otherwise: bool = False
    apart: str = ""
    scale: Scale = LENGTHS


def runs_of(table: PositionTable, path: Path, stated: Mapping[str, Any], said: Sequence[Finding] = ()) -> list[Run]:
    """Return the cycles of a table as runs; ``said`` stands with each."""
    first = int(stated.get("repeat", 1))
    cycles = table.forward_um.shape[1]
    finding = Finding(
        "clock.assumed",
        "info",
        f"the table has no clock; cycles one after the other and a reading every {_PERIOD_S:g} s are assumed",
    )
    scale, joined = table.scale, table.joined_mm * table.scale.per
    if joined:
        text = f"targets that differ by up to {shown_number(joined, 2)} {scale.fine} are taken as one, their mean; deviations are from each one's own"
        said = [*said, Finding("targets.joined", "info", text, {f"off_{scale.figure}": joined})]
    targets = table.target_mm
    position = np.concatenate([targets, targets[::-1]])
    direction = np.array(["forward"] * len(targets) + ["reverse"] * len(targets), dtype=object)
    runs = []
    for cycle in range(cycles):
        error = np.concatenate([table.forward_um[:, cycle], table.reverse_um[::-1, cycle]])
        t_s = (cycle * len(error) + np.arange(len(error))) * _PERIOD_S
        good = np.isfinite(error)
        if not good.any():
            continue
        meta = RunMeta(run_id=str(cycle + 1), kind=scale.kind, repeat=first + cycle, sample_rate_hz=1.0 / _PERIOD_S)
        columns = {"t_s": t_s, scale.position: position, "direction": direction, scale.error: error}
        if table.by_position:
            columns[scale.read] = position + error / scale.per
        samples = {name: values[good] for name, values in columns.items()}
        runs.append(Run(meta, samples, source=str(path), findings=(*said, finding)))
    if not runs:
        raise wrong_form("the table holds no reading", path, "targets alone")
    return runs


def said_of(table: PositionTable) -> Iterator[Finding]:
    """Yield what was assumed, left out, or is not what a reader may take it for."""
    if table.in_order:
        assumed = (
            "the table names no direction: the order of its targets is taken for the way on which they were approached"
        )
        yield Finding(f"{table.scale.kind}.direction_assumed", "warning", assumed)
    if table.otherwise:
        text = "the heads are of deviations, and the values follow the targets: they are read as positions"
        yield Finding(f"{table.scale.kind}.positions", "warning", text)
    if not table.unit_told and table.scale.turn:
        assumed = f"targets, or positions, state no unit: they are taken to be in {table.scale.unit}"
        yield Finding(f"{table.scale.kind}.unit_assumed", "warning", assumed)
    if table.left_out:
        titles = "; ".join(title[:60] for title in table.left_out[:_LISTED])
        several = f"tables of several cycles are read, and those of a single pass beside them are left out: {titles}"
        yield Finding(
            f"{table.scale.kind}.single_pass", "warning", f"{several}. In a file of their own they are a test, too"
        )
    if table.apart:
        told = f"the column {table.apart[:80]} is not read: its rows are counted as cycles of one axis. Call it Axis where they are of several; rows under several feeds or loads are tests of their own"
        yield Finding(f"{table.scale.kind}.told_apart", "warning", told)
    if OWN_SENSOR.search(table.read_with):
        own = f"the readings are those of {table.read_with}, by its name a sensor of the axis itself"
        follows = "they show how the control follows its own sensor, not where the axis is: no accuracy"
        yield Finding(f"{table.scale.kind}.own_sensor", "warning", f"{own}: {follows}. Measure against an instrument")
