"""Positioning tests on the virtual lathe, written as campaign folders, or under a program while a correction runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.atomic import write_text, write_toml
from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import told
from dtwin.kinds.linear._plan import LinearPlan, linear_plan
from dtwin.kinds.linear._planned import laser_program
from dtwin.kinds.linear._read import MM_PER
from dtwin.kinds.linear.laser_file import LaserTest, linear_error, write_laser_file
from dtwin.kinds.machine import require_no_campaign
from dtwin.machines.laser_trigger import LaserSetup
from dtwin.machines.lathe import LatheRecording, Motion, NetworkScrew, ThreadScrew, VirtualLathe, Wander, run_program
from dtwin.machines.printed_network import read_network
from dtwin.schema import Finding, Floats
from dtwin.units import UM_PER_MM

TRUTHS = ("published", "mechanism")
_HEAD = {
    "name": "lathe-z",
    "machine": "virtual-lathe",
    "axis": "Z",
    "unit": "in",
    "start": 1.0,
    "end": 40.0,
    "runs": 4,
    "feed_min": 20.0,
    "overshoot": 0.1,
    "axis_low": 0.0,
    "axis_high": 41.0,
    "axes": "XZ",
    "pitch": 0.25,
}


def mapping_plan() -> LinearPlan:
    """Return the published mapping: 1 to 40 in by 0.025 in, four runs, about 20 hours."""
    return linear_plan(_HEAD | {"step": 0.025, "dwell_s": 5.4, "window": 0.01, "laser_dwell_s": 4.0}, "mapping")


def verification_plan() -> LinearPlan:
    """Return the published verification: every 0.52 in, which meets 25 angles of the screw."""
    return linear_plan(_HEAD | {"step": 0.52, "dwell_s": 6.0, "name": "lathe-z-check"}, "check")


def virtual_lathe(truth: str, seed: int) -> VirtualLathe:
    """Return the lathe, with what the published scatter needs of wander, and heating with ``mechanism``.

    ``truth``, one of "published", "mechanism": the printed error of a real lathe, or a screw made of geometry that
    warms up.
    ``seed``: of wander and noise.
    Raises ``InputError`` when there is no such lathe.
    """
    if truth == "published":
        return VirtualLathe(NetworkScrew(read_network()), Wander(), seed)
    if truth == "mechanism":
        return VirtualLathe(ThreadScrew(), Wander(offset_um=2.0, scale_um_per_m=1.0, heating_c=1.2), seed)
    raise InputError("no such lathe", code="simulate.truth", got=truth[:40], allowed=", ".join(TRUTHS))


def laser_setup(plan: LinearPlan) -> LaserSetup:
    """Return the laser's own settings for a plan."""
    return LaserSetup(tuple(plan.mm(t) for t in plan.targets), plan.runs, plan.mm(plan.window), plan.laser_dwell_s)


def motion_of_plan(plan: LinearPlan) -> Motion:
    """Return what the control makes of the plan's program."""
    return run_program(laser_program(plan), plan.axis)


def reverse_at(position_mm: Floats) -> Floats:
    """Return 0 or 1 of the newest motion at each tick, forward before the first."""
    step = np.sign(np.diff(position_mm, prepend=position_mm[0] - 1.0))
    newest = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(step)), 0))
    return np.where(step[newest] < 0.0, 1.0, 0.0)


def simulate_lathe(
    folder: Path, *, plan: LinearPlan | None = None, truth: str = "published", seed: int = 0, quick: bool = False
) -> tuple[int, tuple[Finding, ...]]:
    """Measure the virtual lathe and write a campaign folder.

    ``folder``: gets the program, the laser's file, ``truth.toml`` and, last, ``campaign.toml``.
    ``plan``: what to measure; the published mapping without.
    ``truth``: as for :func:`virtual_lathe`.
    ``quick``: the published verification instead of the mapping.
    Readings taken, and what the laser complained of.
    """
    require_no_campaign(folder)
    chosen = plan or (verification_plan() if quick else mapping_plan())
    lathe = virtual_lathe(truth, seed)
    if chosen.pitch <= 0.0:
        chosen = replace(chosen, pitch=lathe.screw.pitch_mm / MM_PER[chosen.unit])
    recording = lathe.measure(motion_of_plan(chosen), laser_setup(chosen))
    if not recording.triggered.readings:
        alarms = "; ".join(a.message for a in recording.triggered.alarms)
        raise InputError("the laser took no reading", code="lathe.no_reading", got=alarms[:300])
    _write_lathe_campaign(folder, chosen, recording, _truth_of(lathe, truth, seed))
    return len(recording.triggered.readings), recording.triggered.alarms


def _write_lathe_campaign(
    folder: Path, plan: LinearPlan, recording: LatheRecording, truth: dict[str, Any], *, corrected: bool = False
) -> None:
    """Write what the laser recorded as a campaign folder; the campaign file comes last.

    ``corrected``: whether a correction was in force.
    """
    write_text(folder / "program.nc", laser_program(plan), "the program")
    write_laser_file(folder / "laser.txt", _laser_test(plan, recording))
    write_toml(folder / "truth.toml", truth, "the truth")
    period = float(np.median(np.diff(recording.t_s))) if len(recording.t_s) > 1 else 1.0
    geometry = {
        "type": "lathe",
        "virtual": True,
        "corrected": corrected,
        "truth": truth["truth"],
        "screw_pitch_mm": float(f"{plan.mm(plan.pitch):.6g}"),
    }
    instrument = {
        "model": "virtual laser interferometer",
        "length_unit": plan.unit,
        "reading_period_s": round(period, 3),
    }
    run = {"id": plan.axis.lower(), "file": "laser.txt", "condition": {"axis": plan.axis}}
    head = {
        "name": plan.name,
        "machine": plan.machine,
        "kind": "linear",
        "machine_geometry": geometry,
        "instrument": instrument,
    }
    write_campaign_file(folder, head, [run])


def _laser_test(plan: LinearPlan, recording: LatheRecording) -> LaserTest:
    """Return the laser's rows in the plan's unit, with the averages at each target."""
    readings = recording.triggered.readings
    position = np.round([r.target_mm / MM_PER[plan.unit] for r in readings], 5)
    error = recording.error_um / UM_PER_MM / MM_PER[plan.unit]
    shown = np.round(-error - (position - plan.start), 6)
    error = np.round(linear_error(position, shown, plan.start, "decrease"), 6)
    raw = np.column_stack(
        [position, shown, error, np.zeros(len(readings)), recording.air_f, recording.air_inhg, recording.material_f]
    )
    reverse = np.array([r.direction == "reverse" for r in readings])
    return LaserTest(raw, _averages(position, error, reverse), [])


def _truth_of(lathe: VirtualLathe, truth: str, seed: int) -> dict[str, Any]:
    """Return what is true of a lathe as plain values."""
    told: dict[str, Any] = {"truth": truth, "seed": seed}
    told |= {f"wander_{k}": v for k, v in asdict(lathe.wander).items()}
    if isinstance(lathe.screw, ThreadScrew):
        flat = {k: v for k, v in asdict(lathe.screw).items() if not isinstance(v, dict)}
        told |= {f"screw_{k}": v for k, v in flat.items()}
        for name in ("leading", "trailing"):
            form = asdict(getattr(lathe.screw, name))
            told |= {f"screw_{name}_{k}": v for k, v in form.items()}
    return told


def _averages(position: Floats, error: Floats, reverse: np.ndarray[Any, Any]) -> Floats:
    rows = []
    for way in (False, True):
        targets, place = np.unique(position[reverse == way], return_inverse=True)
        sums = np.bincount(place, weights=error[reverse == way])
        averages = np.column_stack([targets, sums / np.bincount(place)])
        rows.append(averages[::-1] if way else averages)
    return np.vstack(rows)


_PERIOD_S = 0.01


class ServedLathe:
    """One axis on its way through a positioning program; the laser looks on.

    ``plan``: what the laser measures; one run of the published verification without.
    ``truth``: as for :func:`dtwin.kinds.linear._simulate.virtual_lathe`.
    """

    period_s = _PERIOD_S
    provides = tuple(told(np.zeros(1), np.zeros(1)))
    channels_hz = 0.0

    def __init__(self, plan: LinearPlan | None, truth: str, seed: int) -> None:
        self._plan = plan or replace(verification_plan(), runs=1)
        self._lathe = virtual_lathe(truth, seed)
        self._told = _truth_of(self._lathe, truth, seed)
        self._motion = motion_of_plan(self._plan)
        begun, ended = self._motion.t_s[0], self._motion.t_s[-1]
        self._t_s = np.arange(begun, ended + _PERIOD_S, _PERIOD_S)
        self._commanded_mm = self._motion.at(self._t_s)
        self._reverse = reverse_at(self._commanded_mm)
        self._offset_um = np.zeros(len(self._t_s))
        self.axes = (self._plan.axis.lower(),)
        self._axis = "xyz".index(self.axes[0])
        self.name = f"virtual lathe, axis {self._plan.axis}"

    @property
    def ticks(self) -> int:
        """Length of the program."""
        return len(self._t_s)

    def state(self, tick: int) -> Mapping[str, float]:
        """Return the commanded position before a tick."""
        here = told(self._commanded_mm[tick : tick + 1], self._reverse[tick : tick + 1])
        return {name: float(values[0]) for name, values in here.items()}

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Take what is in force from the next cycle on: the control reads its inputs once in each."""
        if tick + 1 < len(self._offset_um):
            self._offset_um[tick + 1] = offset_um[self._axis]

    def write(self, folder: Path) -> str:
        """Write what the laser read as a campaign folder; return what was written."""
        screw_mm = self._commanded_mm + self._offset_um / UM_PER_MM
        seen = self._lathe.measure(self._motion, laser_setup(self._plan), self._t_s, screw_mm)
        _write_lathe_campaign(
            folder, replace(self._plan, name=folder.name), seen, self._told, corrected=bool(self._offset_um.any())
        )
        return f"{len(seen.error_um)} readings of the laser"
