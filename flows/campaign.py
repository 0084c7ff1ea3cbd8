"""Measure a campaign on a machine: hand out programs, record, take and judge what arrives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow, get_run_logger

from dtwin.config import home
from dtwin.pipeline.campaign_job import CampaignRequest
from dtwin.pipeline.desk import Desk
from dtwin.plan import advice, duration_s, read_plan
from dtwin.train.registry import Registry
from flows import _artifacts, _tasks
from flows._paths import confined
from flows.promote import publish_circles


@flow(name="campaign", flow_run_name="campaign {plan_file}")
def campaign_flow(
    plan_file: Path,
    inbox: Path,
    out: Path | None = None,
    sensors: Path | None = None,
    robot: str | None = None,
    with_version: str | None = None,
    settle_s: float = 10.0,
) -> dict[str, Any]:
    """Measure a plan test by test and ingest it; run it again to go on.

    What to do next stands in the run's log, in an artifact and on the workbench's page
    *Measuring*, where it is answered; a file that arrives in the inbox is an answer, too.

    Args:
        plan_file: Plan of circles.
        inbox: Folder that the ball bar's program saves its files in.
        out: Campaign folder; by default below ``DTWIN_HOME/campaigns``.
        sensors: Channel file of accelerometers to record meanwhile.
        robot: Address of a UR controller to record meanwhile.
        with_version: Version on trial, or champion: every test is measured without and with it, by turns, and its
            evidence computed.
        settle_s: Seconds for which a file must stand still before it is taken.
    """
    plan = read_plan(confined(plan_file))
    moving_s, total_s = duration_s(plan)
    _artifacts.publish_findings(
        f"{plan.name}-plan",
        [("", finding.as_dict()) for finding in advice(plan)],
        f"{len(plan.tests)} tests, {plan.n_runs} runs, {moving_s / 60:z.0f} min of motion, "
        f"{total_s / 60:z.0f} min in all: what the plan cannot tell",
    )
    logger = get_run_logger()

    def show(line: str) -> None:
        logger.info("%s", line)
        _artifacts.publish_markdown(f"next-{plan.name}", f"```\n{line}\n```", "What to do next")

    request = CampaignRequest(
        plan, confined(inbox), out and confined(out), sensors and confined(sensors), robot, with_version, settle_s
    )
    found = _tasks.measure_on_machine(request, lambda folder: Desk(folder, show, lambda: None))
    _artifacts.publish_table(
        f"measured-{plan.name}",
        ("tests", "measured now", "kept", "put aside", "runs added", "folder"),
        [
            [
                found["measured"] + found["kept"],
                found["measured"],
                found["kept"],
                found["set_aside"],
                found["added"],
                found["folder"],
            ]
        ],
        f"Measured on {plan.machine}",
    )
    if found["evidence"] is not None:
        version = Registry(home()).version(plan.machine, found["version"])
        publish_circles(version, found["evidence"])
    return found
