"""Measure a campaign on the virtual cobot and bring it into the lake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow

from dtwin.config import home
from dtwin.pipeline.demo import quick_size
from dtwin.plan import advice, duration_s, read_plan, training_plan
from flows import _artifacts, _tasks
from flows._paths import confined
from flows.ingest import publish_ingest


@flow(name="simulate")
def simulate_flow(
    plan_file: Path | None = None, quick: bool = False, out: Path | None = None, seed: int = 0, to_lake: bool = True
) -> dict[str, Any]:
    """Measure a campaign on the virtual cobot; run it again to continue.

    Parameters
    ----------
    plan_file : Path, optional
        Plan; without it the 81-test plan.
    quick : bool
        Without a plan file: twelve tests instead.
    out : Path, optional
        Campaign folder; by default below ``DTWIN_HOME/campaigns``.
    seed : int
        Seed of the machine.
    to_lake : bool
        Whether to ingest it afterwards.
    """
    own = quick_size().plan if quick else training_plan()
    plan = own if plan_file is None else read_plan(confined(plan_file))
    moving_s, total_s = duration_s(plan)
    _artifacts.publish_findings(
        f"{plan.name}-plan",
        [("", finding.as_dict()) for finding in advice(plan)],
        f"{len(plan.tests)} tests, {plan.n_runs} runs, {moving_s / 60:z.0f} min of motion, "
        f"{total_s / 60:z.0f} min in all: what the plan cannot tell",
    )
    done = _tasks.measure(plan, confined(out) if out is not None else home().campaigns / plan.name, seed)
    result: dict[str, Any] = {
        "campaign": plan.name,
        "folder": str(done.folder),
        "measured": done.measured,
        "kept": done.kept,
        "raw_bytes": done.raw_bytes,
    }
    if to_lake:
        report = _tasks.ingest(done.folder)
        publish_ingest([report])
        result |= {"added": len(report.added), "unchanged": len(report.unchanged)}
    return result
