"""One night of a fleet, as lists of what is late, failed and changed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow

from dtwin.config import home
from dtwin.fleet.alerts import fleet_view
from flows import _artifacts, _tasks
from flows._paths import confined


@flow(name="nightly", flow_run_name="nightly")
def nightly_flow(folder: Path | None = None, seed: int = 0) -> dict[str, Any]:
    """Take in what arrived, diagnose what is new, check champions, and tell what is late, failed or changed.

    The work is done where ``DTWIN_ENGINE`` says. Nothing is promoted; a champion that harms is withdrawn.

    Args:
        folder: Where new measurements arrive.
        seed: Seed of virtual machines and of what is drawn.
    """
    night = _tasks.night(None if folder is None else confined(folder), seed)
    _artifacts.publish_table(
        "to-look-at",
        ("sort", "about", "what"),
        [[alert.sort, alert.about, alert.text] for alert in night.alerts],
        "What is late, failed or changed; worst sort first",
    )
    _artifacts.publish_table(
        "fleet",
        ("machine", "campaign", "systematic µm", "floor µm", "found"),
        [
            [
                m["machine"],
                m["campaign"],
                *map(_um, (m["systematic_rms_um"], m["noise_floor_um"])),
                ", ".join(m["found"]),
            ]
            for m in fleet_view(home())
        ],
        "The newest diagnosis of each machine, the largest systematic error over its floor first",
    )
    return night.as_dict()


def _um(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
