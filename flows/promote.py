"""From a registered version to the served champion, gate by gate."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed

from dtwin.config import home
from dtwin.errors import GateRefusal, InputError
from dtwin.report.campaign import evidence_table
from dtwin.train.registry import RegisteredVersion, Registry
from flows import _artifacts, _tasks


@flow(name="promote", flow_run_name="promote {version}")
def promote_flow(
    version: str = "candidate",
    machine: str | None = None,
    only_trial: bool = False,
    seed: int = 0,
    comment: str = "",
    despite: list[str] | None = None,
) -> dict[str, Any] | State[dict[str, Any]]:
    """Put a version on trial, measure evidence, make it champion.

    A gate's no is an answer, not a failure: the run then ends as ``Refused`` with the reasons.

    Args:
        version: Version number, or ``candidate``.
        machine: Required when several machines have models.
        only_trial: Stop after the trial, for evidence that is measured on a real machine.
        seed: Seed of the virtual machine.
        comment: Why; kept in the history.
        despite: Names of all evidence on record that speaks against the version.
    """
    registry = Registry(home())
    found = registry.version(machine or _only_machine(registry), version)
    result = {"machine": found.machine, "version": found.version, "champion": False, "reason": ""}
    try:
        _tasks.put_on_trial(found, comment)
    except GateRefusal as refusal:
        return _refused(result, refusal.render())
    if only_trial:
        return result
    publish_circles(found, _tasks.evidence(found, seed).as_dict())
    bundle, reason = _tasks.make_champion(found, comment, despite or ())
    if bundle is None:
        return _refused(result, reason)
    publish_champion(found, bundle)
    return result | {"champion": True, "bundle": str(bundle)}


def publish_circles(version: RegisteredVersion, evidence: Mapping[str, Any]) -> None:
    """Leave table and plot of what was measured with and without a version.

    Args:
        version: The version.
        evidence: As ``Evidence.as_dict`` gives it.
    """
    _artifacts.publish_table(
        f"evidence-{version.machine}",
        *evidence_table(evidence),
        f"With and without version {version.version}: {evidence['kind']} evidence, {evidence['clock']}",
    )
    _artifacts.publish_evidence(version.machine, version.version, evidence)


def publish_champion(version: RegisteredVersion, bundle: Path) -> None:
    """Leave which version is served from now on.

    Args:
        version: The version.
        bundle: What is served.
    """
    _artifacts.publish_markdown(
        f"promotion-{version.machine}",
        f"Version {version.version} is the champion: `{bundle}`\n\n"
        + _artifacts.model_link(version.machine, version.version),
        "Promoted",
    )


def publish_refusal(machine: str, reason: str) -> None:
    """Leave why a version was not promoted.

    Args:
        machine, reason: Machine of the version, and the gates' reasons.
    """
    _artifacts.publish_markdown(f"promotion-{machine}", f"```\n{reason}\n```", "Not promoted")


def _refused(result: dict[str, Any], reason: str) -> State[dict[str, Any]]:
    publish_refusal(result["machine"], reason)
    return Completed(name="Refused", message=reason.splitlines()[0], data=result | {"reason": reason})


def _only_machine(registry: Registry) -> str:
    known = registry.machines()
    if len(known) == 1:
        return known[0]
    raise InputError(
        "several machines have models" if known else "no model is registered yet",
        code="models.machine",
        got=", ".join(known) or None,
        hint="name one" if known else "train one first",
    )
