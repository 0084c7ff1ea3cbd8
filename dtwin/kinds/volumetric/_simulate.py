"""Ball-array campaigns of the virtual mill that heat deforms, written as campaign folders, or touching its balls while a correction runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.acquire.signal_files import write_signals
from dtwin.errors import InputError
from dtwin.kinds.machine import require_no_campaign
from dtwin.kinds.volumetric._plan import BallPlan
from dtwin.lake.parquet import table_of, write_parquet
from dtwin.machines.thermal_network import SCHEDULES
from dtwin.machines.volumetric import (
    AZIMUTHS_DEG,
    BALL_S,
    CYCLE_S,
    FIXED_BALLS_MM,
    HELD_OUT_POSES,
    READING_S,
    STROKES_MM,
    BallReadings,
    VolumetricMill,
    VolumetricParameters,
    array_balls,
)
from dtwin.progress import Progress
from dtwin.schema import Floats, SignalGroup

_MACHINE = "virtual-volumetric-mill"
_QUICK_EVERY = 3
# Where the thermocouples sit: stuck on the castings, or every second one sunk into them.
TRUTHS = {"surface": VolumetricParameters(), "pockets": VolumetricParameters(pocket_1=0.85)}


def simulate_volumetric(
    folder: Path,
    progress: Progress,
    *,
    schedule: str = "training",
    seed: int = 0,
    quick: bool = False,
    parameters: VolumetricParameters | None = None,
    plan: BallPlan | None = None,
    test: str = "",
) -> int:
    """Measure the virtual mill for days and write a campaign folder.

    ``folder``: gets two files for each cycle, and, last, ``campaign.toml``.
    ``schedule``, one of "training", "validation": what heats the machine: 234 h in spring, or 169 h in another order in
    a warmer season.
    ``seed``: of the machine; both campaigns of one machine need the same.
    ``quick``: every third cycle only.
    ``plan``: hours, and how often; the array and its poses are the machine's own.
    ``test``: what scatters is of its own in a test of another name.
    Returns cycles that were measured.
    Raises ``InputError`` when the folder holds a finished campaign, or there is no such schedule.
    """
    require_no_campaign(folder)
    if schedule not in SCHEDULES:
        raise InputError("no such schedule", code="simulate.schedule", got=schedule[:40], allowed=", ".join(SCHEDULES))
    mill = VolumetricMill(SCHEDULES[schedule], parameters or VolumetricParameters(), seed, test)
    cycles = _planned_cycles(plan, mill) if plan else range(0, mill.cycles, _QUICK_EVERY if quick else 1)
    folder.mkdir(parents=True, exist_ok=True)
    name, machine = (plan.name, plan.machine) if plan else (f"volumetric-{schedule}", _MACHINE)
    for done, cycle in enumerate(cycles):
        _write_cycle(folder, cycle, mill.measure(cycle), mill)
        progress(done + 1, len(cycles), f"hour {cycle}")
    _write_campaign_file(folder, name, machine, list(cycles), mill, corrected=False)
    return len(cycles)


def _write_ball_campaign(
    folder: Path,
    name: str,
    machine: str,
    cycles: Sequence[int],
    readings: Sequence[BallReadings],
    mill: VolumetricMill,
    *,
    corrected: bool,
) -> None:
    """Write cycles that were measured as a campaign folder; the campaign file comes last.

    ``cycles``: hours at which they began.
    ``corrected``: whether a correction was in force.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for cycle, reading in zip(cycles, readings, strict=True):
        _write_cycle(folder, cycle, reading, mill)
    _write_campaign_file(folder, name, machine, list(cycles), mill, corrected=corrected)


def parameters_of(truth: str) -> VolumetricParameters:
    """Return what the virtual mill is like by name, ``surface`` or ``pockets``.

    Raises ``InputError`` when there is no such mill.
    """
    if truth not in TRUTHS:
        raise InputError("no such virtual mill", code="simulate.truth", got=truth[:40], allowed=", ".join(TRUTHS))
    return TRUTHS[truth]


def _planned_cycles(plan: BallPlan, mill: VolumetricMill) -> range:
    """Return the hours at which cycles begin."""
    own = {
        "balls": len(array_balls(1)),
        "poses": len(AZIMUTHS_DEG),
        "table_balls": len(FIXED_BALLS_MM),
        "ball_s": BALL_S,
    }
    asked = {name: getattr(plan, name) for name in own}
    if asked != own or plan.every_h != int(plan.every_h) or plan.hours > mill.cycles:
        raise InputError(
            "the virtual mill cannot do this",
            code="simulate.plan",
            got=", ".join(f"{k} {v:g}" for k, v in asked.items()) + f", every_h {plan.every_h:g}, hours {plan.hours:g}",
            allowed=", ".join(f"{k} {v:g}" for k, v in own.items())
            + f", every_h in whole hours, hours up to {mill.cycles}",
        )
    return range(0, plan.cycles * int(plan.every_h), int(plan.every_h))


def _write_cycle(folder: Path, cycle: int, readings: BallReadings, mill: VolumetricMill) -> None:
    stem = f"c{cycle:03d}"
    write_parquet(folder / f"{stem}.parquet", table_of(_columns(readings)))
    for name, columns in (("thermocouples", mill.thermocouples_c(cycle)), ("control", mill.control_c(cycle))):
        write_signals(folder / f"{stem}.{name}.parquet", SignalGroup(name, 1.0 / READING_S, columns))


def _columns(readings: BallReadings) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {"t_s": readings.t_s - readings.t_s[0]}
    for i, axis in enumerate("xyz"):
        columns[f"{axis}_mm"] = readings.nominal_mm[:, i]
        columns[f"error_{axis}_um"] = np.round(readings.error_um[:, i], 3)
    columns["pose_1"] = readings.pose.astype(float)
    columns["ball_1"] = readings.ball.astype(float)
    return columns


def _write_campaign_file(
    folder: Path, name: str, machine: str, cycles: list[int], mill: VolumetricMill, *, corrected: bool
) -> None:
    geometry = {
        "type": "volumetric",
        "virtual": True,
        "schedule": mill.schedule.name,
        "seed": mill.seed,
        **dict([("truth", name) for name, parameters in TRUTHS.items() if parameters == mill.parameters]),
        "corrected": corrected,
        "chain": "XZY",
        **{f"stroke_{axis}_mm": list(reach) for axis, reach in STROKES_MM.items()},
        "poses": len(AZIMUTHS_DEG),
        "held_out_poses": list(HELD_OUT_POSES),
        "pose_repeat_um": float(f"{1.5 * mill.parameters.repeat_um:g}"),
    }
    instrument = {"model": "virtual ball array, probe and thermocouples"}
    runs = [
        {
            "id": stem,
            "file": f"{stem}.parquet",
            "signals": [f"{stem}.thermocouples.parquet", f"{stem}.control.parquet"],
            "repeat": 1,
            "condition": {"time_h": float(cycle)},
        }
        for cycle, stem in ((cycle, f"c{cycle:03d}") for cycle in cycles)
    ]
    head = {
        "name": name,
        "machine": machine,
        "kind": "volumetric",
        "machine_geometry": geometry,
        "instrument": instrument,
    }
    write_campaign_file(folder, head, runs)


_PERIOD_S = 0.02
# From one ball to the next, and at rest before the probe touches; nothing moves between.
_TRAVEL, _REST = 50, 50
_BALL = _TRAVEL + _REST
_CYCLES, _QUICK_CYCLES = 24, 6


class ServedMill:
    """Cycles of a ball array on a mill in the course of its days.

    States are sent while the mill goes to a ball and rests there; the time between is left out.

    ``plan``: hours, and how often; three days, every third hour, without.
    ``truth``: where its thermocouples sit.
    ``schedule``: as for :func:`dtwin.kinds.volumetric._simulate.simulate_volumetric`.
    ``quick``: six cycles, where there is no plan.
    """

    name = "virtual three-axis mill"
    period_s = _PERIOD_S
    axes = ("x", "y", "z")
    channels_hz = 0.0

    def __init__(self, plan: BallPlan | None, truth: str, schedule: str, seed: int, *, quick: bool) -> None:
        self._mill = VolumetricMill(SCHEDULES[schedule], parameters_of(truth), seed)
        self._machine = plan.machine if plan else _MACHINE
        n = _QUICK_CYCLES if quick else _CYCLES
        self._cycles: Sequence[int] = (
            _planned_cycles(plan, self._mill) if plan else range(0, _QUICK_EVERY * n, _QUICK_EVERY)
        )
        self._balls = [self._mill.measure(cycle) for cycle in self._cycles]
        places = np.concatenate([readings.nominal_mm for readings in self._balls])
        self._to_mm = places
        self._from_mm = np.vstack([places[:1], places[:-1]])
        self._at_s = np.concatenate([readings.t_s for readings in self._balls])
        self._temperatures = [self._read(cycle) for cycle in self._cycles]
        self._per_cycle = len(self._balls[0].t_s)
        self.provides = ("x_mm", "y_mm", "z_mm", *self._temperatures[0])
        self._offset_um = np.zeros((len(places), 3))

    @property
    def ticks(self) -> int:
        """Length of the program."""
        return len(self._to_mm) * _BALL

    def state(self, tick: int) -> Mapping[str, float]:
        """Return the commanded place, and temperatures when the mill sets out for a ball."""
        ball, within = divmod(tick, _BALL)
        share = min((within + 1) / _TRAVEL, 1.0)
        x, y, z = (self._from_mm[ball] + share * (self._to_mm[ball] - self._from_mm[ball])).tolist()
        now_s = float(self._at_s[ball]) - (_BALL - 1 - within) * _PERIOD_S
        figures = {"timestamp_s": now_s, "x_mm": x, "y_mm": y, "z_mm": z}
        if within == 0:
            number = ball // self._per_cycle
            since_s = max(now_s - self._cycles[number] * CYCLE_S, 0.0)
            row = int(since_s / READING_S)
            figures |= {name: float(values[row]) for name, values in self._temperatures[number].items()}
        return figures

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Take what is in force; the last of a ball is there when the probe touches."""
        self._offset_um[tick // _BALL] = offset_um

    def write(self, folder: Path) -> str:
        """Write the readings as a campaign folder; return what was written."""
        parts = np.split(self._offset_um, len(self._balls))
        # The scales read less where the correction lets the machine go further.
        readings = [
            replace(ball, error_um=ball.error_um - offset) for ball, offset in zip(self._balls, parts, strict=True)
        ]
        _write_ball_campaign(
            folder,
            folder.name,
            self._machine,
            self._cycles,
            readings,
            self._mill,
            corrected=bool(self._offset_um.any()),
        )
        return f"{len(readings)} cycles of the ball array"

    def _read(self, cycle: int) -> dict[str, Floats]:
        return {**self._mill.thermocouples_c(cycle), **self._mill.control_c(cycle)}
