"""A positioning campaign to a judged bundle, without a registry, and what the bundle does on the virtual lathe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.ingest import open_source
from dtwin.errors import InputError
from dtwin.kinds.linear._bundle import deployed_bundle, is_positioning_bundle, printed_pair
from dtwin.kinds.linear._evidence import ExactCorrection, looped, measured
from dtwin.kinds.linear._gates import positioning_gates
from dtwin.kinds.linear._models import MM_PER_IN, Averages, PositionModel, averages_of
from dtwin.kinds.linear._plan import LinearPlan, linear_plan
from dtwin.kinds.linear._report import before_after_figures
from dtwin.kinds.linear._simulate import verification_plan, virtual_lathe
from dtwin.kinds.linear._training import fit_pair, flanks_from, screw_of, serving_bundle
from dtwin.machines.lathe import VirtualLathe, Wander
from dtwin.machines.printed_network import MAPPED_MM, PITCH_IN, read_network
from dtwin.plan_file import plan_settings, read_plan_file
from dtwin.positioning.matrix import LinearTest, linear_test
from dtwin.schema import Floats
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import load_bundle
from dtwin.statistics import rms
from studies.judged_bundle import JudgedBundle


@dataclass(frozen=True)
class _Fitted(JudgedBundle):
    """A fitted equation, judged."""

    figures: Mapping[str, Any]


def fitted(campaign: Path | None, model: str, seed: int) -> _Fitted:
    """Fit an equation to a positioning campaign, and judge it.

    ``campaign``: campaign folder; None for the printed networks.
    ``model``: ``flanks``, ``pair`` or ``printed``.
    Raises ``InputError`` when the campaign has too few targets in a turn of the screw, or none at whole turns.
    """
    if campaign is None or model == "printed":
        network = read_network()
        bundle = deployed_bundle(printed_pair(network), "lathe-printed", "published-lathe")
        verdicts = positioning_gates(bundle, PITCH_IN * MM_PER_IN, MAPPED_MM)
        return _Fitted(bundle, verdicts, {"from": network.source})
    machine, test = campaign_test(campaign)
    screw = screw_of(test, str(campaign))
    averages = averages_of(test)
    pair = fit_pair(averages, screw, seed)
    chosen = pair if model == "pair" else flanks_from(pair, averages, screw)
    equation = serving_bundle(chosen, machine, screw, test.axis)
    assert equation is not None
    figures = _figures(chosen, averages, screw.phases)
    return _Fitted(equation, positioning_gates(equation, screw.pitch_mm, screw.reach_mm), figures)


def campaign_test(folder: Path) -> tuple[str, LinearTest]:
    """Return the machine and the readings of a positioning campaign."""
    campaign, sources, _ = open_source(folder)
    runs = [run for part, _ in sources for run in part]
    campaign.of_kind("linear", str(folder))
    usable = [run for run in runs if set(run.samples["direction"]) == {"forward", "reverse"}]
    bad = [run.meta.run_id for run in usable if any(f.severity == "error" for f in run.findings)]
    if not usable or bad:
        raise InputError(
            "the campaign cannot be used",
            code="lathe.campaign",
            where=str(folder),
            got=", ".join(bad)[:80] or "no run in both directions",
            hint=f"dtwin check {folder}",
        )
    axes = sorted({str(run.meta.condition.get("axis", "Z")) for run in usable})
    if len(axes) > 1:
        raise InputError(
            "the campaign holds several axes",
            code="lathe.campaign",
            where=str(folder),
            got=", ".join(axes),
            allowed="one",
            hint="a folder for each axis",
        )
    return campaign.machine, linear_test(usable)


def _figures(model: PositionModel, averages: Averages, phases: int) -> dict[str, Any]:
    direction, position, error = averages.stacked()
    rest: Floats = error - model.error_um(direction, position)
    return {
        "targets": len(averages.position_mm),
        "screw_phases": phases,
        "rms_left_um": round(rms(rest), 3),
        "largest_left_um": round(float(np.max(np.abs(rest))), 3),
    }


def before_and_after(path: Path, truth: str, seed: int, plan: Path | None = None) -> dict[str, Any]:
    """Return figures of the virtual lathe without a bundle and with it in the loop; of the published plan without one.

    ``path``: of the bundle.

    ``truth``: as for :func:`dtwin.kinds.linear._simulate.virtual_lathe`.
    """
    chosen = plan_or_published(plan)
    bundle = positioning_bundle(path)
    lathe = virtual_lathe(truth, seed)
    before = before_after_figures(measured(lathe, chosen))
    after = looped(lathe, chosen, bundle)
    calm = VirtualLathe(lathe.screw, Wander(0.0, 0.0, reading_um=0.0, quantum_um=0.0), seed)
    floor = before_after_figures(measured(lathe, chosen, ExactCorrection(lathe)))
    return {
        "clock": "machine clock, 10 ms cycle, one cycle late",
        "before": before,
        "after": after.figures,
        "after_without_wander": looped(calm, chosen, bundle).figures,
        "perfect_correction": floor,
        "ticks": after.ticks,
        "guard": after.guard,
        "largest_step_um": after.largest_step_um,
    }


def positioning_bundle(path: Path) -> Bundle:
    """Return the bundle of a file; it is refused when it corrects no position."""
    bundle = load_bundle(path).bundle
    if not is_positioning_bundle(bundle):
        raise InputError(
            "the bundle does not correct a position",
            code="lathe.bundle",
            where=str(path),
            got=", ".join(bundle.tick_inputs)[:120],
            allowed="position_mm, perhaps direction_1",
            hint="dtwin lathe fit",
        )
    return bundle


def plan_or_published(plan: Path | None) -> LinearPlan:
    """Return the plan of a file, that of the published lathe without one."""
    return verification_plan() if plan is None else read_linear_plan(plan)


def read_linear_plan(path: Path) -> LinearPlan:
    """Read a plan file of kind ``linear``.

    ``path``: TOML with one table ``[plan]``: ``kind = "linear"`` and the attributes of a plan.
    Raises ``InputError`` with the first rule that is broken.
    """
    return linear_plan(plan_settings(read_plan_file(path), str(path)), str(path))
