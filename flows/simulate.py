"""Measure a campaign on a virtual machine, bring it into the lake, and say what changed since the last one."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from prefect import flow

from dtwin.config import home
from dtwin.errors import InputError
from dtwin.kinds.kind import Planned
from dtwin.kinds.machine import Request
from dtwin.kinds.registry import kind_named, machine_named
from dtwin.pipeline.sheet_changes import sheet_changes
from dtwin.plan import advice, duration_s, quick_training_plan
from dtwin.plan_file import planned_campaign
from dtwin.report.changes import change_table, changes_title
from flows import _artifacts, _tasks
from flows._paths import confined
from flows.ingest import publish_ingest


@flow(name="simulate", flow_run_name="simulate {machine}")
def simulate_flow(
    plan_file: Path | None = None,
    quick: bool = False,
    out: Path | None = None,
    seed: int = 0,
    to_lake: bool = True,
    machine: str = "cobot",
    options: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Measure a campaign on a virtual machine; run it again to continue.

    Args:
        plan_file: Plan; without it the 81-test plan of the cobot.
        quick: Without a plan file: twelve tests instead.
        out: Campaign folder; by default below ``DTWIN_HOME/campaigns``.
        seed: Seed of the machine.
        to_lake: Whether to ingest it afterwards; then its figures are compared with those of the last such test, where
            there is one.
        machine: Virtual machine, as ``dtwin simulate --machine`` names it; another than the cobot needs a plan file.
        options: Of the machine, as ``dtwin simulate`` takes them; the usual ones without.
    """
    found = machine_named(machine)
    if plan_file is None and machine != "cobot":
        raise InputError("this machine is measured by a plan file", code="simulate.plan", got=machine)
    planned = _planned(found.kind, quick) if plan_file is None else planned_campaign(confined(plan_file), found.kind)
    name = str(planned.summary["name"])
    _artifacts.publish_findings(
        f"{name}-plan",
        [("", finding.as_dict()) for finding in planned.findings],
        f"{'; '.join(planned.lines)}: what the plan cannot tell",
    )
    folder = confined(out) if out is not None else home().campaigns / name
    done = _tasks.simulated(machine, Request(folder, seed, False, planned.plan, found.chosen(options or {})))
    result: dict[str, Any] = {**done.payload, "campaign": name}
    if to_lake:
        report = _tasks.ingest(folder)
        publish_ingest([report])
        result |= {"added": len(report.added), "unchanged": len(report.unchanged)}
        with suppress(InputError):  # The first one, or of a kind without a test sheet.
            changes = sheet_changes(home(), name)
            _artifacts.publish_table(f"changes-{name}", *change_table(changes), changes_title(changes))
    return result


def _planned(kind: str, quick: bool) -> Planned:
    """Return the cobot's usual plan, or twelve tests of it."""
    usual = kind_named(kind).usual_plan()
    if not quick:
        return usual
    plan = quick_training_plan()
    told = f"{plan.name}: {len(plan.tests)} tests, {plan.n_runs} runs"
    return Planned(kind, plan, {"name": plan.name}, duration_s(plan)[1], list(advice(plan)), (told,))
