"""Campaigns of the virtual mill, as folders that anybody could have brought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.atomic import write_text, write_toml
from dtwin.errors import InputError
from dtwin.kinds.machine import require_no_campaign
from dtwin.machines.mill import Moment, VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters
from dtwin.plan import Plan
from dtwin.progress import Progress, silent
from dtwin.schema import PLANES, Campaign, Direction, Floats, Plane, Run, RunMeta

_FEEDS_MM_MIN = (1000.0, 2000.0, 4000.0)
_RADII_MM = (50.0, 150.0)
_REPEATS = 3
_COOL_DOWN_S = 1800.0
PERIOD_S = 0.002
_DIRECTIONS: tuple[Direction, Direction] = ("CCW", "CW")
_HIDDEN = ("backlash", "wobble", "servo", "none")
_DECIMALS = {"t_s": 5, "angle_deg": 5, "deviation_um": 4}
# What the control logs: a hundredth of a micrometre, as linear scales and resolvers give it.
_LOG_DECIMALS = 5


def tutorial_mill(hidden: str = "backlash") -> MillParameters:
    """Return a mill with two known faults and one that its twin is not told of.

    ``hidden``, one of "backlash", "wobble", "servo", "none": ``backlash``: play in the drive of the X axis. ``wobble``:
    five waves per turn that grow with the feed, which no effect of the library describes. ``servo``: the X axis lags
    behind its command, and its encoder sees it; the play in Y and what rings when Y breaks away, no encoder sees.
    Raises ``InputError`` when there is no such fault.
    """
    if hidden not in _HIDDEN:
        raise InputError(
            "the virtual mill has no such fault", code="simulate.hidden", got=hidden[:40], allowed=", ".join(_HIDDEN)
        )
    made = MillParameters(squareness_um_m={"XY": 30.0}).with_axis("X", scale_ppm=25.0)
    if hidden == "servo":
        made = made.with_axis("X", feed_forward=0.98)
        return made.with_axis("Y", play_um=3.0, mode_hz=12.0, breakaway_mm=2e-3)
    return made.with_axis("X", play_um=3.0) if hidden == "backlash" else made


def virtual_mill(hidden: str = "backlash", **settings: Any) -> VirtualMill:
    """Return the mill of the tutorials, with a fault of ``tutorial_mill`` and further attributes of ``VirtualMill``."""
    disturbance = _wobble if hidden == "wobble" else None
    return VirtualMill(tutorial_mill(hidden), disturbance=disturbance, **settings)


def _geometry_of_mill(hidden: str) -> dict[str, Any]:
    """Return what a campaign of the virtual mill says of its machine.

    ``hidden``: its fault; closed-loop evidence is measured on the same machine.
    """
    # An offset is not fed forward: it arrives through the position loop.
    return {
        "type": "mill",
        "virtual": True,
        "hidden": hidden,
        "correction_delay_s": 1.0 / tutorial_mill(hidden).x.position_gain_1_s + PERIOD_S,
    }


def _standard_tests(seed: int, *, planes: Sequence[Plane] = PLANES) -> list[CircularTest]:
    """Return the recommended set of circles: feeds crossed in every set-up, in random order.

    ``planes``: planes; each with two radii.
    """
    rng = np.random.default_rng([seed, 17])
    out: list[CircularTest] = []
    for plane in planes:
        for radius in _RADII_MM:
            pairs = [(feed, repeat) for repeat in range(1, _REPEATS + 1) for feed in _FEEDS_MM_MIN]
            for feed, repeat in [pairs[i] for i in rng.permutation(len(pairs))]:
                for direction in _DIRECTIONS:
                    # One stop in the middle of the session: heat goes back, drift does not.
                    halfway = len(out) == len(planes) * len(_RADII_MM) * len(pairs)
                    out.append(
                        CircularTest(
                            plane=plane,
                            direction=direction,
                            radius_mm=radius,
                            feed_mm_min=feed,
                            repeat=repeat,
                            setup=f"{plane.lower()}-r{radius:g}",
                            pause_s=_COOL_DOWN_S if halfway else 0.0,
                        )
                    )
    return out


def _planned_tests(plan: Plan) -> list[CircularTest]:
    """Return the circles of a plan in its order."""
    return [
        CircularTest(test.plane, direction, test.radius_mm, test.feed_mm_min, test.repeat, test.setup)
        for test in plan.tests
        for direction in plan.directions
    ]


def simulate_mill(
    folder: Path,
    *,
    seed: int = 0,
    quick: bool = False,
    hidden: str = "backlash",
    plan: Plan | None = None,
    progress: Progress = silent,
) -> list[Run]:
    """Measure the virtual mill and write a campaign folder.

    ``folder``: folder to write; what is wrong with the mill is in its ``truth.toml``.
    ``quick``: one plane instead of three.
    ``hidden``: fault that nobody is told of.
    ``plan``: circles to measure, under its names of campaign and machine; the recommended set without.

    Raises ``InputError`` when the folder holds another campaign.
    """
    require_no_campaign(folder)
    mill = virtual_mill(hidden, seed=seed)
    usual = PLANES[:1] if quick else PLANES
    runs = mill.measure(_standard_tests(seed, planes=usual) if plan is None else _planned_tests(plan))
    name, machine = (f"mill-{hidden}", "virtual-mill") if plan is None else (plan.name, plan.machine)
    campaign = Campaign(name=name, machine=machine, machine_geometry=_geometry_of_mill(hidden))
    write_campaign(folder, campaign, runs, mill.parameters, progress)
    return runs


def write_campaign(
    folder: Path, campaign: Campaign, runs: Sequence[Run], truth: MillParameters, progress: Progress = silent
) -> None:
    """Write runs of the virtual mill as a campaign folder, with what is wrong in ``truth.toml``.

    ``folder``: folder to write; the campaign file comes last.
    """
    told: dict[str, Any] = {k: v for k, v in asdict(truth).items() if _plain(v)}
    told |= {letter: asdict(getattr(truth, letter)) for letter in "xyz"}
    told["squareness_um_m"] = dict(truth.squareness_um_m)
    write_toml(folder / "truth.toml", told, "the truth")
    write_runs(folder, campaign, runs, progress)


def write_runs(folder: Path, campaign: Campaign, runs: Sequence[Run], progress: Progress = silent) -> None:
    """Write circular runs as a campaign folder.

    ``folder``: folder to write; the campaign file comes last.
    """
    for number, run in enumerate(runs):
        _write_samples(folder / f"{run.meta.run_id}.csv", run)
        progress(number + 1, len(runs), run.meta.run_id)
    head = {
        "name": campaign.name,
        "machine": campaign.machine,
        "kind": campaign.kind,
        "machine_geometry": dict(campaign.machine_geometry),
    }
    write_campaign_file(folder, head, [_entry(run.meta) for run in runs])


def _wobble(moment: Moment) -> Floats:
    return 1.5 * moment.test.feed_mm_min / 2000.0 * np.cos(5.0 * moment.angle_rad + 0.3)


def _plain(value: object) -> bool:
    return isinstance(value, int | float | str)


def _entry(meta: RunMeta) -> dict[str, Any]:
    return {
        "id": meta.run_id,
        "file": f"{meta.run_id}.csv",
        "plane": meta.plane,
        "radius_mm": meta.radius_mm,
        "feed_mm_min": meta.feed_mm_min,
        "direction": meta.direction,
        "repeat": meta.repeat,
        "setup": meta.setup,
        "started": meta.started,
        "covariates": dict(meta.covariates),
    }


def _write_samples(path: Path, run: Run) -> None:
    decimals = [_DECIMALS.get(name, _LOG_DECIMALS) for name in run.samples]
    line = ",".join(f"%.{places}f" for places in decimals) + "\n"
    rows = np.column_stack(list(run.samples.values())).tolist()
    text = ",".join(run.samples) + "\n" + "".join(line % tuple(row) for row in rows)
    write_text(path, text, "a run")
