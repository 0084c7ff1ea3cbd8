"""Closed-loop evidence of a version: measured, computed from the lake, computed again to promote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.kinds.machine import FROM_THE_LAKE, EvidenceRequest, VirtualMachine
from dtwin.kinds.registry import machine_of_type, machines
from dtwin.lake.store import Lake
from dtwin.lifecycle.drift import require_training
from dtwin.lifecycle.train import geometry_of, markdown_table
from dtwin.progress import Progress, silent
from dtwin.report.campaign import evidence_section, evidence_table
from dtwin.report.html import page
from dtwin.schema import Campaign, fresh_name
from dtwin.serve.bundle import Bundle
from dtwin.train.closed_loop import WITH, WITHOUT, Evidence, evidence_of_runs
from dtwin.train.evidence_record import gathered, keep, newest, require_same
from dtwin.train.promotion import promote
from dtwin.train.registry import RegisteredVersion, Registry

if TYPE_CHECKING:
    from dtwin.train.oracle import MeasuredWays

    Looked = MeasuredWays | Evidence


def compute(
    home: Home,
    version: RegisteredVersion,
    without: Sequence[str],
    with_: Sequence[str],
    *,
    notes: Mapping[str, Any] | None = None,
) -> Evidence:
    """Compute evidence from campaigns in the lake and keep it with the version.

    ``home``: lake, registry, and the journal of the serving sessions.
    ``without``, ``with_``: campaigns that were measured without and with it; one that holds both ways is named twice.
    ``notes``: as for :class:`Evidence`.
    Raises ``InputError`` when a campaign is unknown, or of another machine.
    Raises ``GateRefusal`` when the runs do not fit what they are named for, are too few, or do not take turns.
    """
    evidence = _computed(home, version, without, with_, notes or {})
    _keep(Registry(home), version, evidence)
    return evidence


def measure(
    home: Home, version: RegisteredVersion, *, seed: int, plan: Any = None, progress: Progress = silent
) -> Evidence:
    """Measure a virtual machine as :func:`look` does, and keep the evidence that the runs give."""
    return keep_looked(home, version, look(home, version, seed=seed, plan=plan, progress=progress))


def look(home: Home, version: RegisteredVersion, *, seed: int, plan: Any = None, progress: Progress = silent) -> Looked:
    """Measure a virtual machine with and without a version, or predict where nothing is served; nothing is written.

    ``plan``: what the machine is measured by, in the form of its kind; it chooses from what was trained without.
    Raises ``InputError`` when the machine is real: it has to be measured on it; and when no virtual machine of its type
    is known, or none that can be measured with a correction.
    """
    registry = Registry(home)
    geometry = geometry_of(registry, version)
    if not geometry.get("virtual", False):
        raise InputError(
            "what a correction does to a real machine has to be measured on it",
            code="evidence.real",
            where=f"machine {version.machine}",
            hint=f"dtwin campaign --with {version.version} measures by turns with and without the "
            "trial; dtwin evidence computes from any campaigns",
        )
    machine = virtual_of(geometry)
    if machine.offers("prediction"):
        return machine.prediction(home, version, progress)
    bundle = Bundle.from_dict(registry.bundle(version))
    return machine.evidence(EvidenceRequest(registry, version, bundle, geometry, plan, seed, progress))


def keep_looked(home: Home, version: RegisteredVersion, looked: Looked) -> Evidence:
    """Keep evidence; of runs it is computed after they are in the lake."""
    if isinstance(looked, Evidence):
        _keep(Registry(home), version, looked)
        return looked
    return compute_measured(home, version, looked)


def compute_measured(home: Home, version: RegisteredVersion, measured: MeasuredWays) -> Evidence:
    """Bring the runs of a virtual machine into the lake, and compute evidence from them.

    ``version``: whose correction was in force in the runs that say so.
    """
    lake, first = Lake(home.lake), measured.runs[0].meta
    name = fresh_name(f"evidence-{version.machine}-v{version.version}", lake.campaigns())
    geometry = geometry_of(Registry(home), version) | {"virtual": True}
    campaign = Campaign(name, version.machine, first.kind, first.started, geometry)
    lake.commit(campaign, measured.runs)
    return compute(home, version, [name], [name], notes=measured.notes())


def proven(home: Home, version: RegisteredVersion) -> Evidence | None:
    """Return the newest evidence of a version, computed again from its runs; None without any."""
    registry = Registry(home)
    record = newest(registry, version)
    if record is None:
        return None
    campaigns = {way: tuple(record.content["campaigns"].get(way, ())) for way in (WITHOUT, WITH)}
    notes = record.content["notes"]
    machine = machine_of_type(geometry_of(registry, version).get("type"))
    evidence = (
        machine.prediction(home, version, silent)
        if machine is not None and machine.offers("prediction") and not campaigns[WITH]
        else _computed(home, version, campaigns[WITHOUT], campaigns[WITH], notes)
    )
    require_same(record, evidence)
    return evidence


def proven_or_measured(home: Home, version: RegisteredVersion, *, seed: int, progress: Progress = silent) -> Evidence:
    """Return the evidence of a version; a virtual machine without any is measured."""
    return proven(home, version) or measure(home, version, seed=seed, progress=progress)


def promote_proven(
    home: Home, version: RegisteredVersion, comment: str = "", despite: Sequence[str] = (), valid_days: float = 0.0
) -> Path:
    """Make a version champion by its evidence, computed again from its runs.

    The rest is as for :func:`dtwin.train.promotion.promote`; evidence that is not what its runs say is refused, too.
    """
    require_training(home, version)
    registry = Registry(home)
    return promote(
        registry,
        home,
        version,
        geometry=geometry_of(registry, version),
        evidence=proven(home, version),
        despite=despite,
        comment=comment,
        valid_days=valid_days,
    )


def make_champion(
    home: Home, version: RegisteredVersion, comment: str = "", despite: Sequence[str] = (), valid_days: float = 0.0
) -> tuple[Path | None, str]:
    """Return what :func:`promote_proven` does, or None and why it refuses."""
    try:
        return promote_proven(home, version, comment, despite, valid_days), ""
    except GateRefusal as refusal:
        return None, refusal.render()


def _computed(
    home: Home, version: RegisteredVersion, without: Sequence[str], with_: Sequence[str], notes: Mapping[str, Any]
) -> Evidence:
    registry = Registry(home)
    bundle = Bundle.from_dict(registry.bundle(version))
    campaigns = {WITHOUT: tuple(dict.fromkeys(without)), WITH: tuple(dict.fromkeys(with_))}
    virtual = bool(geometry_of(registry, version).get("virtual", False))
    recorded = gathered(home, version.machine, bundle.model_sha256, campaigns, virtual=virtual)
    return evidence_of_runs(
        recorded.runs,
        kind=recorded.kind,
        machine=version.machine,
        model_sha256=bundle.model_sha256,
        campaigns=campaigns,
        notes=notes,
        told=recorded.told,
    )


def virtual_of(geometry: Mapping[str, Any]) -> VirtualMachine:
    """Return the virtual machine of a type, or refuse."""
    machine = machine_of_type(geometry.get("type"))
    if machine is not None:
        return machine
    raise InputError(
        "no virtual machine of this type is known",
        code="evidence.machine",
        where="machine_geometry.type",
        got=str(geometry.get("type", "not stated"))[:40],
        allowed=", ".join(known.type for known in machines() if known.offers("evidence")),
        hint=FROM_THE_LAKE,
    )


def _keep(registry: Registry, version: RegisteredVersion, evidence: Evidence) -> None:
    keep(registry, version, evidence)
    document = evidence.as_dict()
    section = evidence_section(document, evidence.profiles)
    content = page("Closed-loop evidence", f"version {version.version}", [section])
    registry.attach(version, {"evidence.html": content})
    text = f"Closed-loop evidence ({evidence.kind}, {document['clock']}):\n\n"
    text += markdown_table(*evidence_table(document))
    registry.mark(version, {}, description=f"{registry.description(version)}\n\n{text}")
