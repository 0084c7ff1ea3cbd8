"""Closed-loop evidence for a correction of a position: the laser looks on days with and without it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.acquire.linear_matrix import LinearTest
from dtwin.acquire.virtual_lathe import verification_plan, virtual_lathe
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.linear_plan import LinearPlan, better_step
from dtwin.pipeline.lathe_compensation import PERIOD_S, exact_correction, looped, measured
from dtwin.report.campaign import evidence_table
from dtwin.report.html import Section, Table, page
from dtwin.report.model_plots import evidence_figure
from dtwin.serve.bundle import Bundle
from dtwin.statistics import t_quantile
from dtwin.train.positioning_bundle import is_positioning_bundle
from dtwin.train.registry import EVIDENCE_FILE, RegisteredVersion, Registry

DAYS = 3
_TARGETS = 60
_WAYS = ("forward", "reverse")
Progress = Callable[[int, int, str], None]


def lathe_evidence(
    bundle: Bundle, truth: str, plan: LinearPlan, *, seed: int, progress: Progress | None = None
) -> dict[str, Any]:
    """Measure a plan on several days with a bundle, and on as many others without.

    Every day has its own drift and noise; the laser's zero is arbitrary, so the mean over both
    directions is taken out.

    Parameters
    ----------
    bundle : Bundle
        Corrects a position.
    truth : str
        As for :func:`dtwin.acquire.virtual_lathe.virtual_lathe`.
    plan : LinearPlan
        What the laser reads.
    seed : int
        Of the first day.
    progress : callable, optional
        Called with (done, total, what).

    Returns
    -------
    dict
        In the form that the gates read: each direction is a condition, errors are RMS over the
        targets, ``oracle_um`` what an exact map would leave.
    """
    days: dict[str, list[dict[str, float]]] = {"before": [], "after": [], "oracle": []}
    acted: list[dict[str, int]] = []
    for day in range(DAYS):
        first = 1000 * (seed + 1) + 10 * day
        lathe = virtual_lathe(truth, first)
        days["before"].append(_rms_um(measured(lathe, plan)))
        days["oracle"].append(_rms_um(measured(lathe, plan, exact_correction(lathe))))
        served = looped(virtual_lathe(truth, first + 1), plan, bundle)
        days["after"].append(_rms_um(served.test))
        acted.append(served.guard)
        if progress is not None:
            progress(day + 1, DAYS, "days")
    return {
        "kind": "virtual", "clock": "machine clock, 10 ms cycle, one cycle late",
        "bundle_sha256": bundle.sha256, "delays": {"one cycle of the loop": PERIOD_S},
        "conditions": [_condition(way, days, acted, plan.axis) for way in _WAYS],
    }  # fmt: skip


def measure_lathe_evidence(
    home: Home, version: RegisteredVersion, geometry: Mapping[str, Any], *, seed: int,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Measure evidence for a registered version and keep it with the version.

    Parameters
    ----------
    home : Home
        Registry.
    version : RegisteredVersion
        The version.
    geometry : mapping
        Of a virtual lathe: ``truth`` names its error.
    seed : int
        Of the days.
    progress : callable, optional
        Called with (done, total, what).

    Raises
    ------
    InputError
        When the version does not correct a position.
    """
    registry = Registry(home)
    bundle = Bundle.from_dict(registry.bundle(version))
    if not is_positioning_bundle(bundle):
        raise InputError(
            "the bundle does not correct a position", code="lathe.bundle", got=bundle.name
        )
    logged = registry.metrics(version)
    reach = logged["mapped_from_in"], logged["mapped_to_in"]
    plan = evidence_plan(reach, logged["screw_pitch_in"], version.machine)
    truth = str(geometry.get("truth", ""))
    found = lathe_evidence(bundle, truth, plan, seed=seed, progress=progress)
    section = Section(
        "With and without the correction",
        [
            f"{found['kind'].capitalize()} evidence, {found['clock']}: {plan.count} targets every "
            f"{plan.step:g} in, {DAYS} days with and {DAYS} others without; the oracle is an exact map "
            "on the days without."
        ],
        tables=[Table(*evidence_table(found))],
        figures=[evidence_figure(found, "Error over the targets, RMS; bars: 95 % over days")],
    )
    registry.attach(
        version,
        {
            EVIDENCE_FILE: json.dumps(found, indent=1),
            "evidence.html": page("Closed-loop evidence", f"version {version.version}", [section]),
        },
    )
    return found


def evidence_plan(reach_in: tuple[float, float], pitch_in: float, machine: str) -> LinearPlan:
    """Return a test over the mapped travel whose step meets the screw at many angles.

    Parameters
    ----------
    reach_in : tuple of float
        Mapped travel.
    pitch_in : float
        Travel in one turn of the screw.
    machine : str
        Of the plan.
    """
    low, high = (round(end, 4) for end in reach_in)
    span = round(high - low, 4)
    head = replace(
        verification_plan(), name="evidence", machine=machine, start=low, end=high, runs=1,
        step=span / _TARGETS, axis_low=low - 1.0, axis_high=high + 1.0, pitch=pitch_in,
    )  # fmt: skip
    step = better_step(head, span / 8.0) or head.step
    return replace(head, step=step, window=min(head.window, step / 4.0))


def _rms_um(test: LinearTest) -> dict[str, float]:
    both = {"forward": test.forward_um, "reverse": test.reverse_um}
    middle = float(np.mean(np.hstack(list(both.values()))))
    return {way: float(np.sqrt(np.mean((errors - middle) ** 2))) for way, errors in both.items()}


def _condition(
    way: str, days: Mapping[str, list[dict[str, float]]], acted: list[dict[str, int]], axis: str
) -> dict[str, Any]:
    values = {name: np.array([day[way] for day in found]) for name, found in days.items()}
    half = t_quantile(0.975, DAYS - 1) / math.sqrt(DAYS)
    ci = {name: half * float(v.std(ddof=1)) for name, v in values.items()}
    mean = {name: float(v.mean()) for name, v in values.items()}
    ticks = sum(sum(guard.values()) for guard in acted)
    outside = sum(guard.get("outside_box", 0) for guard in acted)
    return {
        "axis": axis, "approached": way, "trained": True,
        "before_um": mean["before"], "after_um": mean["after"],
        "before_ci_um": ci["before"], "after_ci_um": ci["after"],
        "floor_um": float(values["before"].std(ddof=1)), "oracle_um": mean["oracle"],
        "n_runs": DAYS, "reduction": 1.0 - mean["after"] / mean["before"],
        "worse": mean["after"] - mean["before"] > math.hypot(ci["before"], ci["after"]),
        "acted": {"outside_box": outside / max(ticks, 1)},
    }  # fmt: skip
