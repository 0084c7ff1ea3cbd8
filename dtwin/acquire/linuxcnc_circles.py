"""Circles on a LinuxCNC, measured by its own sampler, as a campaign folder like any other."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.virtual_mill import write_runs
from dtwin.atomic import write_toml
from dtwin.errors import DeviceError, InputError
from dtwin.links.linuxcnc import PERIOD_S, Bridge
from dtwin.machines.linuxcnc.circles import SAMPLE_HZ, Circle, Trace, program, read_samples, traces
from dtwin.machines.linuxcnc.configuration import MillFaults
from dtwin.machines.linuxcnc.instance import LinuxcncSession
from dtwin.schema import PLANES, Campaign, Direction, Plane, Run, RunMeta

MACHINE = "linuxcnc-mill"
DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")
_POLL_S = 0.05
# So often the time of the turns, and so much more: a busy computer slows the control down.
_SLOWEST, _SPARE_S = 10.0, 60.0
# Between a state and the motion that its correction causes: an estimate, four servo periods.
_LINK_DELAY_S = 0.004
_While = Callable[[Callable[[], None], Callable[[], bool]], None]


@dataclass(frozen=True)
class CirclePlan:
    """Which circles are measured, all in one mounting of the bar for each plane and radius.

    ``radii_mm``, ``feeds_mm_min``: crossed with each other; each in both directions.
    """

    planes: tuple[Plane, ...] = ("XY",)
    radii_mm: tuple[float, ...] = (20.0, 40.0)
    feeds_mm_min: tuple[float, ...] = (2000.0, 4000.0, 6000.0)
    repeats: int = 2

    def circles(self, seed: int) -> list[Circle]:
        """Return the circles, feeds and repeats in random order inside every mounting.

        Raises ``InputError`` when a plane is unknown, there is nothing to do, or the machine cannot do it.
        """
        strange = [p for p in self.planes if p not in PLANES]
        if strange or not (self.planes and self.radii_mm and self.feeds_mm_min):
            raise InputError(
                "these circles cannot be planned",
                code="linuxcnc.plan",
                got=", ".join(strange) or "no plane, radius or feed",
                allowed=", ".join(PLANES),
            )
        rng = np.random.default_rng([seed, 23])
        out = []
        for plane in self.planes:
            for radius in self.radii_mm:
                pairs = [feed for _ in range(self.repeats) for feed in self.feeds_mm_min]
                for i in rng.permutation(len(pairs)):
                    out += [Circle(plane, radius, pairs[i], d) for d in DIRECTIONS]
        return out

    @property
    def duration_s(self) -> float:
        """Roughly how long the circles take: a real controller has no time lapse."""
        turns = 1.25 * 2.0 * np.pi * 60.0 * 2.0 * self.repeats * len(self.planes)
        per_feed = sum(r / f for r in self.radii_mm for f in self.feeds_mm_min)
        moves = 0.8 * len(self.planes) * len(self.radii_mm) * len(self.feeds_mm_min)
        return float(turns * per_feed + moves * 2.0 * self.repeats)


def run_circles(session: LinuxcncSession, circles: Sequence[Circle], during: _While | None = None) -> list[Trace]:
    """Run circles on a LinuxCNC while its sampler records, and return whole turns.

    ``circles``: in order.
    ``during``: called with a function that starts the program, and one that tells whether it has ended; returns
    when it has.

    Raises ``DeviceError`` when the control reports something, does not end, or a circle or a sample is missing.
    """
    limit_s = _SLOWEST * sum(_turn_s(c) for c in circles) + _SPARE_S
    (session.folder / "circles.ngc").write_text(program(circles), encoding="ascii")
    with Bridge(session.socket_path) as bridge:
        until_s = time.monotonic() + limit_s

        def begin() -> None:
            bridge.ask(do="run", program="circles.ngc")

        def ended() -> bool:
            if time.monotonic() > until_s:
                raise DeviceError(
                    "LinuxCNC does not end its program",
                    code="linuxcnc.endless",
                    got=f"{len(circles)} circles still run after {limit_s:z.0f} s",
                    hint="run it again on a computer that is less busy",
                )
            return not bridge.ask(do="status")["running"]

        bridge.ask(do="record", file="samples.txt")
        try:
            if during is None:
                begin()
                while not ended():
                    time.sleep(_POLL_S)
            else:
                during(begin, ended)
        finally:
            bridge.ask(do="stop_record")
        if messages := bridge.ask(do="status")["messages"]:
            raise DeviceError("LinuxCNC reports something", code="linuxcnc.message", got="; ".join(messages)[:400])
    return traces(read_samples(session.folder / "samples.txt"), circles)


def _turn_s(circle: Circle) -> float:
    return 2.0 * np.pi * circle.radius_mm * 60.0 / circle.feed_mm_min


def run_of(trace: Trace, run_id: str, repeat: int, setup: str, started: str) -> Run:
    """Return a turn as a run: the bar, what was commanded, what the encoders saw.

    ``repeat``: counts from 1.
    """
    circle = trace.circle
    columns = {"t_s": trace.t_s, "angle_deg": trace.angle_deg, "deviation_um": trace.deviation_um}
    first = PLANES.index(circle.plane)
    for axis in sorted((first, (first + 1) % 3)):
        columns[f"cmd_{'xyz'[axis]}_mm"] = trace.command_mm[:, axis]
        columns[f"act_{'xyz'[axis]}_mm"] = trace.encoder_mm[:, axis]
    meta = RunMeta(
        run_id,
        plane=circle.plane,
        direction=circle.direction,
        radius_mm=circle.radius_mm,
        feed_mm_min=circle.feed_mm_min,
        repeat=repeat,
        setup=setup,
        started=started,
        sample_rate_hz=SAMPLE_HZ,
    )
    return Run(meta, columns)


def _geometry(faults: MillFaults) -> dict[str, Any]:
    """Return what a campaign says of this machine.

    ``faults``: its loops decide how late a correction acts.
    """
    return {
        "type": "mill",
        "controller": "LinuxCNC, simulated time",
        "virtual": True,
        "correction_delay_s": _LINK_DELAY_S + faults.delay_s,
    }


def write_circles(folder: Path, measured: Sequence[Trace], faults: MillFaults, name: str = "linuxcnc") -> None:
    """Write turns as a campaign folder, and what is wrong with the machine in ``truth.toml``.

    ``measured``: in order of measurement.

    Raises ``InputError`` when the folder holds another campaign.
    """
    require_free(folder)
    counts: dict[Circle, int] = {}
    runs = []
    started = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    for number, trace in enumerate(measured, start=1):
        circle = trace.circle
        counts[circle] = counts.get(circle, 0) + 1
        setup = f"{circle.plane.lower()}-r{circle.radius_mm:g}"
        runs.append(run_of(trace, f"r{number:03d}", counts[circle], setup, started))
    write_toml(folder / "truth.toml", asdict(faults), "the truth")
    campaign = Campaign(name=name, machine=MACHINE, machine_geometry=_geometry(faults))
    write_runs(folder, campaign, runs)


def require_free(folder: Path) -> None:
    """Refuse a folder that holds a campaign, before an hour is spent on another one."""
    if (folder / "campaign.toml").exists():
        raise InputError(
            "the folder holds a campaign already", code="linuxcnc.exists", where=str(folder), hint="give another --out"
        )


__all__ = ["DIRECTIONS", "MACHINE", "PERIOD_S", "CirclePlan", "require_free", "run_circles", "run_of", "write_circles"]
