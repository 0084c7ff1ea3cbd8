"""Campaigns of the virtual rotor."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.acquire.virtual import EPOCH
from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.kinds.machine import require_no_campaign
from dtwin.machines.rotor import Rotor, RotorLog, RotorParameters
from dtwin.progress import Progress

_MACHINE = "virtual-rotor"
_TYPE = "rotor"
TRUTHS = {
    "unbalance": RotorParameters(unbalance_um=60.0),
    "sound": RotorParameters(),
    "resonance": RotorParameters(unbalance_um=2.0, critical_rpm=9_000.0),
    "balls": RotorParameters(balls_um=1.0),
    "warming": RotorParameters(growth_um=40.0, warm_s=6000.0),
}
# The lowest again at the end: what it differs by is time, not speed.
_SPEEDS_RPM = (600.0, 4800.0, 2400.0, 6000.0, 1200.0, 3600.0, 600.0)
_TURNS, _QUICK_TURNS, _READINGS = 48, 20, 180
_BETWEEN_S = 600.0


def simulate_rotation(
    folder: Path, progress: Progress, *, truth: str = "unbalance", seed: int = 0, quick: bool = False
) -> int:
    """Measure the virtual rotor at seven speeds and write a campaign folder; return how many files.

    Raises ``InputError`` when the folder holds a campaign, or there is no such rotor.
    """
    if truth not in TRUTHS:
        raise InputError("no such rotor", code="simulate.truth", got=truth[:40], allowed=", ".join(TRUTHS))
    require_no_campaign(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rotor, runs = Rotor(TRUTHS[truth], seed), []
    for number, speed in enumerate(_SPEEDS_RPM, start=1):
        log = rotor.run(speed, _QUICK_TURNS if quick else _TURNS, _READINGS, number)
        name = f"{number}-{speed:z.0f}rpm"
        write_text(folder / f"{name}.csv", _table(log), "the log")
        started = (EPOCH + timedelta(seconds=(number - 1) * _BETWEEN_S)).isoformat()
        runs.append({"id": name, "file": f"{name}.csv", "started": started, "condition": {"speed_rpm": speed}})
        rotor.rest(_BETWEEN_S, speed)
        progress(number, len(_SPEEDS_RPM), name)
    head = {
        "name": f"rotor-{truth}",
        "machine": _MACHINE,
        "kind": "rotation",
        "machine_geometry": {"type": _TYPE, "virtual": True, "truth": truth},
        "instrument": {"model": "virtual probes and encoder"},
    }
    write_campaign_file(folder, head, runs)
    return len(_SPEEDS_RPM)


def _table(log: RotorLog) -> str:
    lines = ["t_s,angle_deg,radial_x_um,radial_y_um,axial_um"]
    for t, a, x, y, z in zip(
        *(v.tolist() for v in (log.t_s, log.angle_deg, log.x_um, log.y_um, log.axial_um)), strict=True
    ):
        lines.append(f"{t:z.7f},{a:z.1f},{x:z.3f},{y:z.3f},{z:z.3f}")
    return "\n".join(lines) + "\n"
