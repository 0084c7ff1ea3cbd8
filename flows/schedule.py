"""Scheduled training, and all flows as deployments that the Prefect page can start."""

from __future__ import annotations

from inspect import cleandoc
from typing import Any

from prefect import Flow, flow
from prefect.client.schemas.objects import State
from prefect.deployments.runner import RunnerDeployment
from prefect.states import Completed
from prefect.types.entrypoint import EntrypointType

from flows import _artifacts, _tasks
from flows.campaign import campaign_flow
from flows.cell import cell_flow
from flows.diagnose import diagnose_flow, publish_drift
from flows.ingest import ingest_flow
from flows.nightly import nightly_flow
from flows.papers import paper_flows
from flows.promote import promote_flow
from flows.recheck import recheck_flow
from flows.simulate import simulate_flow
from flows.train import publish_training, train_flow

_AT_NIGHT = "0 2 * * *"


@flow(name="scheduled-training", flow_run_name="scheduled-training")
def scheduled_training_flow(seed: int = 1) -> dict[str, Any] | State[dict[str, Any]]:
    """Train when the lake has new runs, compare with the champion, promote nothing.

    Without new runs the run ends as ``Skipped`` with the reason.

    Args:
        seed: Seed of everything random.
    """
    done = _tasks.scheduled_training(seed)
    result = done.as_dict()
    _artifacts.publish_table(
        "scheduled-training",
        ("campaign", "what was made of it"),
        list(done.campaigns.items()),
        f"{done.outcome}: {done.reason}",
    )
    for check in done.drift:
        if check.error is not None:
            publish_drift(check)
    if done.registered is not None:
        publish_training(done.registered)
        _publish_comparison(result)
    if done.outcome == "skipped":
        return Completed(name="Skipped", message=done.reason, data=result)
    return result


def deployments(cron: str | None) -> list[RunnerDeployment]:
    """Return every flow as a deployment, with a tag by which the page filters; some have their times.

    Args:
        cron: When to train and to check champions; the night is at two. None for only when somebody starts them.
    """
    times = {scheduled_training_flow: cron, recheck_flow: cron, nightly_flow: _AT_NIGHT if cron else None}
    return [
        RunnerDeployment.from_flow(
            known,
            known.name,
            cron=times.get(known),
            # The page describes parameters beside their fields.
            description=cleandoc(known.__doc__ or "").partition("\n\nArgs:")[0],
            tags=[tag],
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        for tag, some in _FLOWS.items()
        for known in some
    ]


_FLOWS: dict[str, tuple[Flow[..., Any], ...]] = {
    "measure": (campaign_flow, simulate_flow, ingest_flow, cell_flow),
    "learn": (train_flow, scheduled_training_flow, promote_flow),
    "watch": (diagnose_flow, recheck_flow, nightly_flow),
    "papers": paper_flows,
}


def _publish_comparison(result: dict[str, Any]) -> None:
    comparison = result.get("comparison")
    verdict = comparison["verdict"] if comparison else "There is no champion to compare with"
    lines = [
        f"## Version {result['version']} of {result['machine']} waits for a reviewer",
        "",
        f"{verdict}.",
        "",
        _artifacts.model_link(result["machine"], result["version"]),
        "",
        f"Next: `dtwin promote {result['version']} --machine {result['machine']}`",
    ]
    _artifacts.publish_markdown(f"review-{result['machine']}", "\n".join(lines), "Candidate against champion")
