"""What a campaign on a machine needs besides its plan: programs, head of its file, the journal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.acquire.ingest import ingest
from dtwin.acquire.instruments import recorders
from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.lake.store import Lake
from dtwin.pipeline._campaign_steps import Step, by_turns, circle_steps
from dtwin.pipeline._machine_campaign import Job, measure_campaign
from dtwin.pipeline.desk import Desk, enter_desk
from dtwin.plan import Plan
from dtwin.serve.bundle import Bundle
from dtwin.serve.controller_kind import is_virtual
from dtwin.serve.pointer import on_trial
from dtwin.serve.served_time import correction_in_force, serving_now

if TYPE_CHECKING:
    # Imported where a version is measured: without one a campaign begins two seconds earlier.
    from dtwin.train.registry import RegisteredVersion


@dataclass(frozen=True)
class CampaignRequest:
    """What to measure, and where.

    ``inbox``: folder that the reference instrument's program writes to.
    ``out``: campaign folder; by default below ``DTWIN_HOME/campaigns``.
    ``sensors``: channel file of the accelerometers.
    ``robot``: address of a UR controller to record.
    ``version``: version whose correction is measured by turns with and without, or its alias.
    ``settle_s``: time for which a file must stand still.
    """

    plan: Plan
    inbox: Path
    out: Path | None = None
    sensors: Path | None = None
    robot: str | None = None
    version: str | None = None
    settle_s: float = 10.0


def run_request(
    home: Home, request: CampaignRequest, desk_of: Callable[[Path], Desk], asked: Callable[[], bool]
) -> dict[str, Any]:
    """Measure a campaign, bring it into the lake, and with a version compute its evidence.

    ``desk_of``: returns the operator's desk for a campaign folder.
    Returns, JSON-ready: what :func:`measure_campaign` returns, ``added`` runs, and ``evidence``.
    """
    plan = request.plan
    version = _version(home, request)
    name = plan.name if version is None else f"{plan.name}-v{version.version}"
    job = Job(
        name=name,
        machine=plan.machine,
        folder=request.out or home.campaigns / name,
        inbox=request.inbox,
        steps=circle_steps(plan) if version is None else _by_turns(home, plan, version),
        head=_campaign_head(home, plan.machine, request.robot, version),
        instruments=partial(recorders, request.sensors, request.robot),
        in_force=correction_in_force(home, plan.machine),
        serving_now=partial(serving_now, home, plan.machine),
        settle_s=request.settle_s,
    )
    if job.inbox.resolve().is_relative_to(job.folder.resolve()):
        raise InputError(
            "the instrument must not write into the campaign folder itself",
            code="campaign.inbox",
            where=str(job.inbox),
            hint="let it write somewhere else; its files are copied",
        )
    enter_desk(home, job.folder)
    outcome = measure_campaign(job, desk_of(job.folder), asked)
    report = ingest(job.folder, Lake(home.lake))
    outcome |= {"added": len(report.added), "unchanged": len(report.unchanged), "evidence": None}
    if version is not None:
        from dtwin.lifecycle.evidence import compute

        evidence = compute(home, version, [name], [name])
        outcome |= {"version": version.version, "evidence": evidence.as_dict()}
    return outcome


def _campaign_head(
    home: Home, machine: str, robot: str | None = None, version: RegisteredVersion | None = None
) -> dict[str, Mapping[str, Any]]:
    """Return what the campaign file says of machine and instrument, as far as it is known.

    ``robot``: address of its controller, which is asked whether it is a real one.
    ``version``: says most; else the newest campaign of the machine.
    """
    head: dict[str, dict[str, Any]] = {}
    if version is not None:
        from dtwin.lifecycle.train import geometry_of
        from dtwin.train.registry import Registry

        head["machine_geometry"] = geometry_of(Registry(home), version)
    else:
        lake = Lake(home.lake)
        rows = lake.runs(machine=machine)
        if rows:
            known = lake.campaign(max(rows, key=lambda row: str(row["ingested"]))["campaign"])
            head = {"machine_geometry": dict(known.machine_geometry), "instrument": dict(known.instrument)}
    geometry = head.setdefault("machine_geometry", {})
    geometry.pop("corrected", None)
    if robot is not None and is_virtual(robot):
        geometry["virtual"] = True
    return {name: content for name, content in head.items() if content}


def _version(home: Home, request: CampaignRequest) -> RegisteredVersion | None:
    if request.version is None:
        return None
    from dtwin.train.registry import Registry

    return Registry(home).version(request.plan.machine, request.version)


def _by_turns(home: Home, plan: Plan, version: RegisteredVersion) -> tuple[Step, ...]:
    """Return the steps for a version that may be served."""
    from dtwin.train.registry import Registry

    if on_trial(plan.machine, home) == int(version.version):
        model = "trial"
    elif "champion" in version.aliases:
        model = "latest"
    else:
        raise GateRefusal(
            "the version is neither on trial nor champion: nothing would serve it",
            code="campaign.version",
            where=f"machine {plan.machine}",
            got=version.version,
            hint=f"dtwin promote {version.version} --machine {plan.machine} --trial",
        )
    bundle = Bundle.from_dict(Registry(home).bundle(version))
    serve = f"dtwin serve --machine {plan.machine} --model {model}, with the options of its link"
    return by_turns(plan, bundle.model_sha256, serve)
