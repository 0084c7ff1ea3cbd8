"""Sinusoidal tests on the virtual Z slide, written as campaign folders."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.acquire.signal_files import write_signals
from dtwin.atomic import write_toml
from dtwin.errors import InputError
from dtwin.kinds.machine import require_no_campaign
from dtwin.kinds.sinusoidal._plan import BETWEEN_S, TonePlan
from dtwin.lake.parquet import table_of, write_parquet
from dtwin.machines.turning import (
    MM_PER_UM,
    SERVO_HZ,
    AccelerationChannel,
    AnaloguePath,
    Instruments,
    RoomDrift,
    Slide,
    TurningSlide,
)
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run, RunMeta, SignalGroup

# Of probe, encoder and accelerometer.
SAMPLE_HZ = 1000.0
_BANDWIDTH_HZ = 50.0


def write_tone_campaign(
    folder: Path,
    runs: Iterable[Run],
    told: Mapping[str, Any],
    truth: str,
    name: str,
    machine: str,
    shown: tuple[Progress, int] = (silent, 0),
    *,
    corrected: bool = False,
) -> None:
    """Write tones as a campaign folder; the campaign file comes last.

    ``runs``: the tones; each is written when it comes.
    ``shown``: what to call with (done, total, what), and the total.
    ``corrected``: whether a correction was in force.
    """
    progress, count = shown
    measured = []
    for number, run in enumerate(runs, start=1):
        stem = run.meta.run_id
        write_parquet(folder / f"{stem}.parquet", table_of(run.samples))
        write_signals(folder / f"{stem}.accelerometers.parquet", run.signals[0])
        measured.append(run.meta)
        progress(number, count, stem)
    write_toml(folder / "truth.toml", told, "the truth")
    geometry = {
        "type": "turning",
        "virtual": True,
        "corrected": corrected,
        "truth": truth,
        "z_bandwidth_hz": _BANDWIDTH_HZ,
        "correction_delay_s": AnaloguePath().delay_s,
    }
    head = {
        "name": name,
        "machine": machine,
        "kind": "sinusoidal",
        "machine_geometry": geometry,
        "instrument": {"model": "virtual capacitance probe", "sample_rate_hz": float(SAMPLE_HZ)},
    }
    write_campaign_file(folder, head, [_entry(meta) for meta in measured])


def _entry(meta: RunMeta) -> dict[str, Any]:
    run: dict[str, Any] = {
        "id": meta.run_id,
        "file": f"{meta.run_id}.parquet",
        "signals": f"{meta.run_id}.accelerometers.parquet",
        "repeat": meta.repeat,
        "condition": {
            "axis": "Z",
            "frequency_hz": float(meta.condition["frequency_hz"]),
            "amplitude_um": float(meta.condition["amplitude_um"]),
        },
    }
    return run | ({"covariates": dict(meta.covariates)} if meta.covariates else {})


# Servo ticks to one sample of probe, encoder and accelerometer.
EVERY = round(SERVO_HZ / SAMPLE_HZ)
_GROUP_S = 6.0
# Mean of the room where the slide stands, and the noise of the thermometer in it.
_ROOM_C, _THERMOMETER_C = 20.0, 0.05
# The slide swings in before a group is recorded.
_RUN_UP_S = 0.5
TRUTHS = ("linear", "hardening", "friction")


@dataclass(frozen=True)
class Grid:
    """Groups of a campaign: every amplitude at every frequency."""

    frequencies_hz: tuple[float, ...] = (1.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
    amplitudes_um: tuple[float, ...] = tuple(float(a) for a in range(1, 12))

    @property
    def groups(self) -> list[tuple[float, float]]:
        """Frequency and amplitude of each group, in the order of measuring."""
        return [(f, a) for f in self.frequencies_hz for a in self.amplitudes_um]


PUBLISHED = Grid()
QUICK = Grid((5.0, 15.0, 25.0, 30.0, 35.0, 40.0), (2.0, 5.0, 8.0, 11.0))


def virtual_slide(truth: str) -> Slide:
    """Return the mechanism.

    ``truth``, one of "linear", "hardening", "friction": a linear servo and structure; a joint in the structure that
    grows stiffer under load; friction in the guideway.
    Raises ``InputError`` when there is no such mechanism.
    """
    if truth not in TRUTHS:
        raise InputError("no such slide", code="simulate.truth", got=truth[:40], allowed=", ".join(TRUTHS))
    if truth == "hardening":
        return Slide(hardening=1.35, hardening_um=1.6)
    return Slide(friction_um=0.2) if truth == "friction" else Slide()


def record_group(
    slide: Slide,
    instruments: Instruments,
    frequency_hz: float,
    amplitude_um: float,
    seed: int,
    seconds: float = _GROUP_S,
) -> tuple[dict[str, Floats], SignalGroup]:
    """Command one tone, six seconds without other word, and return what the instruments record.

    Returns ``samples``, ``acceleration``: columns of the run, and the accelerometer's signals, both at 1 kHz from the
    same instant.
    """
    rng = np.random.default_rng(seed)
    machine, channel = TurningSlide(slide), AccelerationChannel(instruments.accelerometer, rng)
    t = np.arange(-round(_RUN_UP_S * SERVO_HZ), round(seconds * SERVO_HZ)) / SERVO_HZ
    swell = np.minimum(1.0, (t + _RUN_UP_S) / (0.5 * _RUN_UP_S))
    command = swell * amplitude_um * np.sin(2.0 * np.pi * frequency_hz * t)
    motion = machine.run(command)
    acceleration = channel.sampled_g(motion, EVERY)
    kept = slice(round(_RUN_UP_S * SERVO_HZ), None, EVERY)
    step = instruments.encoder_um
    tool = motion.tool_um[kept]
    samples = {
        "t_s": t[kept],
        "cmd_z_mm": command[kept] * MM_PER_UM,
        "act_z_mm": np.round(motion.encoder_um[kept] / step) * step * MM_PER_UM,
        "tool_z_mm": (tool + instruments.probe_um * rng.normal(size=len(tool))) * MM_PER_UM,
    }
    signal = acceleration[round(_RUN_UP_S * SAMPLE_HZ) :]
    return samples, SignalGroup("accelerometers", SAMPLE_HZ, {"tool_z_g": signal})


def virtual_runs(grid: Grid, slide: Slide, seed: int, instruments: Instruments | None = None) -> Iterator[Run]:
    """Return the groups of a campaign as runs, without writing anything."""
    seen_by = instruments or Instruments()
    for number, (frequency, amplitude) in enumerate(grid.groups, start=1):
        recorded = record_group(slide, seen_by, frequency, amplitude, seed * 10_007 + number)
        yield tone_run(number, frequency, amplitude, recorded)


def _planned_runs(
    plan: TonePlan, slide: Slide, seed: int, instruments: Instruments | None = None, drift: RoomDrift | None = None
) -> Iterator[Run]:
    """Return the groups of a plan as runs: the slide follows the room, so that repeats differ.

    ``plan``: what is commanded, in which order.
    ``slide``: the mechanism at the room's mean temperature.
    """
    require_own_axis(plan)
    room, seen_by = Room(plan, slide, seed, drift), instruments or Instruments()
    for number, group in enumerate(plan.groups):
        recorded = record_group(
            room.slide(number),
            seen_by,
            group.frequency_hz,
            group.amplitude_um,
            seed * 10_007 + number + 1,
            plan.seconds,
        )
        yield tone_run(
            number + 1, group.frequency_hz, group.amplitude_um, recorded, group.repeat, room.covariates(number)
        )


def require_own_axis(plan: TonePlan) -> None:
    """Refuse a plan that the virtual slide cannot follow."""
    if plan.axis != "Z" or plan.sample_hz != SAMPLE_HZ:
        raise InputError(
            "the virtual slide cannot do this",
            code="simulate.plan",
            got=f"axis {plan.axis}, sample_hz {plan.sample_hz:g}",
            allowed=f"axis Z, sample_hz {SAMPLE_HZ:g}",
        )


class Room:
    """The room of a planned campaign: what the slide is like at each group, and its thermometer.

    ``slide``: the mechanism at the room's mean temperature.
    """

    def __init__(self, plan: TonePlan, slide: Slide, seed: int, drift: RoomDrift | None = None) -> None:
        self._slide, self._drift = slide, drift or RoomDrift()
        started_s = np.arange(plan.count, dtype=np.float64) * (plan.seconds + BETWEEN_S)
        self._rises = self._drift.rises_c(started_s, seed).tolist()
        noise = np.random.default_rng([seed, 37]).normal(size=plan.count)
        self._read_c = [_ROOM_C + rise + _THERMOMETER_C * float(n) for rise, n in zip(self._rises, noise, strict=True)]

    def slide(self, number: int) -> Slide:
        """Return the mechanism at a group, counted from 0."""
        return self._drift.slide_at(self._slide, self._rises[number])

    def covariates(self, number: int) -> dict[str, float]:
        """Return what is logged of the room at a group."""
        return {"room_c": round(self._read_c[number], 2)}


def tone_run(
    number: int,
    frequency_hz: float,
    amplitude_um: float,
    recorded: tuple[dict[str, Floats], SignalGroup],
    repeat: int = 1,
    covariates: Mapping[str, float] | None = None,
) -> Run:
    """Return a recorded tone as a run. ``number``: of the group, from 1."""
    condition: dict[str, float | str] = {"axis": "Z", "frequency_hz": frequency_hz, "amplitude_um": amplitude_um}
    meta = RunMeta(
        f"g{number:03d}",
        kind="sinusoidal",
        condition=condition,
        sample_rate_hz=SAMPLE_HZ,
        repeat=repeat,
        covariates=covariates or {},
    )
    return Run(meta, recorded[0], signals=(recorded[1],))


def simulate_turning(
    folder: Path,
    *,
    truth: str = "linear",
    seed: int = 0,
    quick: bool = False,
    grid: Grid | None = None,
    plan: TonePlan | None = None,
    progress: Progress = silent,
) -> int:
    """Measure a campaign of tones; return the number of groups.

    ``truth``: as for :func:`virtual_slide`.
    ``quick``: 24 groups instead of the published 99.
    ``plan``: groups, repeats and order instead of a grid; the slide then follows the room.
    """
    require_no_campaign(folder)
    slide, seen_by = virtual_slide(truth), Instruments()
    told = {"truth": truth, "seed": seed} | asdict(slide) | asdict(seen_by.accelerometer)
    if plan is None:
        chosen = grid or (QUICK if quick else PUBLISHED)
        runs, count = virtual_runs(chosen, slide, seed, seen_by), len(chosen.groups)
    else:
        room = RoomDrift()
        told |= {f"drift_{k}": v for k, v in asdict(room).items()}
        runs, count = _planned_runs(plan, slide, seed, seen_by, room), plan.count
    name = plan.name if plan else f"slow-tool-servo-{truth}"
    machine = plan.machine if plan else "virtual-turning"
    write_tone_campaign(folder, runs, told, truth, name, machine, (progress, count))
    return count
