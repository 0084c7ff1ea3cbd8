"""Days of ball arrays and thermocouples as error motions and temperatures, cycle by cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from dtwin.acquire.campaign_name import in_lake
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.volumetric._heat_series import require_temperatures
from dtwin.kinds.volumetric._identify import Artefact, Balls, Identified, averaged_balls
from dtwin.kinds.volumetric._spoilt import spoilt_in, stroke_mm
from dtwin.lake.store import Lake
from dtwin.progress import Progress
from dtwin.schema import Floats, Run, of_one_way
from dtwin.units import is_number

_SENSORS = "thermocouples"
PLAUSIBLE_C = (-20.0, 90.0)
"""What a sound sensor on a machine may read; a broken wire reads more or less."""
REFERENCE_CYCLES = 3
Strokes = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Session:
    """A campaign, cycle by cycle, as differences to its first cycles.

    ``hour``, shape (cycles,): begin of each cycle.
    ``artefact``: how readings become error motions.
    ``moved``, of (Balls, ndarray): where each cycle measured, and how the tool point moved there.
    ``found``: error motions of each cycle.
    ``sensors``: thermocouples with plausible readings in every cycle.
    ``dropped``: temperatures that were read in some cycles only.
    ``rise_c``, shape (cycles, sensors): their means over the cycle.
    ``begun_c``, shape (sensors,): what they read in the reference.
    ``offered_c``, shape (cycles,): other temperatures that were logged: means over the cycle, as they were read.
    """

    campaign: str
    hour: Floats
    artefact: Artefact
    moved: tuple[tuple[Balls, Floats], ...]
    found: tuple[Identified, ...]
    sensors: tuple[str, ...]
    rise_c: Floats
    begun_c: Floats
    offered_c: Mapping[str, Floats]
    dropped: tuple[str, ...] = ()

    @property
    def values(self) -> Floats:
        """Error motions, shape (cycles, coefficients)."""
        return np.array([found.values for found in self.found])

    def offered_rise(self, channel: str) -> Floats:
        """Return an offered temperature since the reference, shape (cycles,)."""
        values = self.offered_c[channel]
        return values - values[:REFERENCE_CYCLES].mean()

    def rise_of(self, names: Sequence[str]) -> Floats:
        """Return temperatures by name, shape (cycles, names).

        Raises ``InputError`` when one was not measured here, or has gaps.
        """
        require_temperatures(names, self.sensors, self.campaign, self.sensors)
        return self.rise_c[:, [self.sensors.index(name) for name in names]]

    def begun_of(self, names: Sequence[str]) -> Floats:
        """Return what thermocouples read in the reference, by name, shape (names,)."""
        return self.begun_c[[self.sensors.index(name) for name in names]]


def session(home: Home, campaign: str, progress: Progress) -> Session:
    """Identify the error motions of every cycle of a campaign.

    ``campaign``: name in the lake, or a folder, which is ingested first.
    Raises ``InputError`` when it is of another kind, or its balls cannot tell the error motions.
    """
    return session_in(Lake(home.lake), in_lake(home, campaign), progress)


def session_in(lake: Lake, name: str, progress: Progress) -> Session:
    """Identify the error motions of every cycle of a campaign that is in the lake."""
    known = lake.campaign(name).of_kind("volumetric")
    every = [run for run in lake.iterate(name) if not any(f.severity == "error" for f in run.findings)]
    runs = of_one_way(every)
    hour_by_run = hours_of(runs)
    runs.sort(key=lambda run: hour_by_run[run.meta.run_id])
    if len(runs) <= REFERENCE_CYCLES:
        raise InputError(
            "too few usable cycles",
            code="volumetric.cycles",
            where=name,
            got=str(len(runs)),
            allowed=f"more than {REFERENCE_CYCLES}",
            hint=f"dtwin check: what is wrong with {name}",
        )
    artefact = _artefact(known.machine_geometry, name)
    cycles = [balls_of(run) for run in runs]
    sound = spoilt_in(cycles).kept(cycles, REFERENCE_CYCLES + 1)
    runs, balls = [runs[n] for n, _ in sound], [cycle for _, cycle in sound]
    _require_poses(artefact.held_out, balls, name)
    reference = averaged_balls(balls[:REFERENCE_CYCLES])
    moved = tuple(artefact.variation_um(cycle, reference) for cycle in balls)
    artefact = artefact.with_noise_of(moved)
    identified = []
    for number, (where, by) in enumerate(moved):
        identified.append(artefact.identify(where, by))
        progress(number + 1, len(moved), f"identify {runs[number].meta.run_id}")
    table, dropped = _temperatures(runs)
    inside = {n: t for n, (group, t) in table.items() if group == _SENSORS}
    if not inside:
        raise InputError(
            "no thermocouple has readings in every cycle",
            code="volumetric.sensors",
            where=name,
            hint=f'a signal group "{_SENSORS}" with columns that end in _c',
        )
    absolute = np.column_stack(list(inside.values()))
    begun = absolute[:REFERENCE_CYCLES].mean(axis=0)
    return Session(
        name,
        np.array([hour_by_run[run.meta.run_id] for run in runs]),
        artefact,
        moved,
        tuple(identified),
        tuple(inside),
        absolute - begun,
        begun,
        {n: t for n, (group, t) in table.items() if group != _SENSORS},
        dropped,
    )


def _artefact(geometry: Mapping[str, Any], where: str) -> Artefact:
    if str(geometry.get("chain", "XZY")) != "XZY":
        raise InputError(
            "only machines that carry Y on Z on X can be identified",
            code="volumetric.chain",
            where=where,
            got=str(geometry.get("chain"))[:20],
            allowed="XZY",
        )
    strokes: Strokes = {axis: stroke_mm(geometry, axis, where) for axis in "xyz"}
    return Artefact(strokes, *poses_told(geometry, where))


def poses_told(geometry: Mapping[str, Any], where: str) -> tuple[tuple[int, ...], float]:
    """Return the poses that are held out, and how well the array comes back to a pose, um; infinity where that is not told."""
    held_out, repeat_um = geometry.get("held_out_poses", []), geometry.get("pose_repeat_um", np.inf)
    for name, value, sound, allowed in (
        (
            "held_out_poses",
            held_out,
            isinstance(held_out, list | tuple) and all(is_number(pose) and pose == int(pose) for pose in held_out),
            "whole numbers as pose_1 has them, such as [3, 6]",
        ),
        (
            "pose_repeat_um",
            repeat_um,
            repeat_um == np.inf or (is_number(repeat_um) and repeat_um > 0.0),
            "a number of µm above 0",
        ),
    ):
        if not sound:
            raise InputError(
                "a setting of the ball array cannot be read",
                code="volumetric.poses",
                where=f"{where} machine_geometry.{name}",
                got=str(value)[:60],
                allowed=allowed,
                hint=f"dtwin amend NAME --set 'machine_geometry.{name}=…' --because WHY changes it in the lake",
            )
    return tuple(map(int, held_out)), float(repeat_um)


def _require_poses(held_out: Sequence[int], cycles: Sequence[Balls], where: str) -> None:
    """Refuse poses to hold out that no ball has: nothing would be held out."""
    there = sorted({int(pose) for balls in cycles for pose in balls.pose})
    absent = [pose for pose in held_out if pose not in there]
    if absent:
        raise InputError(
            "a pose that is to be held out was not measured",
            code="volumetric.poses",
            where=f"{where} machine_geometry.held_out_poses",
            got=", ".join(map(str, absent[:5])),
            allowed=", ".join(map(str, there[:20])),
            hint="dtwin amend NAME --set 'machine_geometry.held_out_poses=…' --because WHY changes it in the lake",
        )


def hours_of(runs: Sequence[Run]) -> dict[str, float]:
    """Return the hour of each cycle: as stated, else by when runs began, else their number in the order of the campaign."""
    told = hours_told(runs)
    return dict(zip((run.meta.run_id for run in runs), told or [float(n) for n in range(len(runs))], strict=True))


def hours_told(runs: Sequence[Run]) -> list[float] | None:
    """Return the hour of each cycle as stated, else by when runs began; None where one says neither."""
    if all("time_h" in run.meta.condition for run in runs):
        return [float(run.meta.condition["time_h"]) for run in runs]
    try:
        began = [datetime.fromisoformat(run.meta.started).timestamp() / 3600.0 for run in runs]
    except ValueError:
        return None
    return [hour - min(began) for hour in began]


def balls_of(run: Run) -> Balls:
    """Return the readings of a cycle."""
    place, error = (
        np.stack([run.samples[name.format(axis)] for axis in "xyz"], axis=1).astype(float)
        for name in ("{}_mm", "error_{}_um")
    )
    pose, ball = (np.rint(run.samples[name]).astype(np.int64) for name in ("pose_1", "ball_1"))
    return Balls(place, error, pose, ball)


def _temperatures(runs: Sequence[Run]) -> tuple[dict[str, tuple[str, Floats]], tuple[str, ...]]:
    """Return group and mean over each cycle of every temperature that has plausible readings in half of each cycle or more, and the names of the others."""
    means: dict[str, list[float]] = {}
    groups: dict[str, str] = {}
    for run in runs:
        for group in run.signals:
            for name, values in group.columns.items():
                if name.endswith("_c"):
                    groups.setdefault(name, group.name)
                    sound = values[(values >= PLAUSIBLE_C[0]) & (values <= PLAUSIBLE_C[1])]
                    enough = 2 * len(sound) >= len(values) > 0
                    means.setdefault(name, []).append(float(np.mean(sound)) if enough else float("nan"))
    everywhere = {n: values for n, values in means.items() if len(values) == len(runs) and np.isfinite(values).all()}
    return {n: (groups[n], np.array(values)) for n, values in everywhere.items()}, tuple(
        n for n in means if n not in everywhere
    )
