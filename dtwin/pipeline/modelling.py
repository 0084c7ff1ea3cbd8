"""Train, register, judge, promote."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError
from dtwin.report.campaign import (
    comparison_table,
    evidence_section,
    evidence_table,
    training_section,
)
from dtwin.report.html import page
from dtwin.schema import Campaign
from dtwin.serve.bundle import Bundle
from dtwin.store import Lake
from dtwin.train.gates import Verdict
from dtwin.train.promotion import check_version, promote, trial, verdict_lines
from dtwin.train.registry import EVIDENCE_FILE, RegisteredVersion, Registry

if TYPE_CHECKING:
    from dtwin.train.evidence import Evidence, EvidencePlan
    from dtwin.train.symbolic import Engine
    from dtwin.train.training import Training

CONDITIONS_FILE = "conditions.json"
StageProgress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Registered:
    """A training that is in the registry.

    Attributes
    ----------
    training : Training
        Candidates and data.
    version : RegisteredVersion
        The proposed candidate.
    verdicts : list of Verdict
        Offline gates on it.
    """

    training: Training
    version: RegisteredVersion
    verdicts: list[Verdict]


def train(
    home: Home,
    campaign: str,
    *,
    seed: int = 1,
    engine: Engine | None = None,
    progress: StageProgress | None = None,
) -> Registered:
    """Train every candidate on a campaign, log them, register the proposed one.

    Parameters
    ----------
    home : Home
        Lake and registry.
    campaign : str
        Campaign in the lake.
    seed : int
        Seed of everything random.
    engine : Engine, optional
        Free symbolic search.
    progress : callable, optional
        Called with (stage, done, total, what).

    Raises
    ------
    InputError
        When a correction was in force while it was measured, or it cannot be used otherwise.
    """
    lake = Lake(home.lake)
    known = lake.campaign(campaign)
    require_uncorrected(known)
    training = _training_of(known.kind)(lake, campaign, seed=seed, engine=engine, progress=progress)
    report = training.report
    if progress is not None:
        progress("log and register", 0, 1, "")
    registry = Registry(home)
    title = f"Training on {campaign}"
    overview = page(title, report.machine, [training_section(report)])
    ids = registry.log_training(report, {"comparison.html": overview})
    proposed = report.candidate(report.proposed)
    version = registry.register(report, ids[proposed.name], proposed, "")
    registry.attach(
        version,
        {
            "geometry.json": json.dumps(dict(training.geometry), default=str),
            CONDITIONS_FILE: json.dumps(training.conditions),
        },
    )
    _, verdicts = check_version(registry, version)
    registry.mark(version, {}, description=_description(training, verdicts))
    if progress is not None:
        progress("log and register", 1, 1, f"version {version.version}")
    return Registered(training, registry.version(report.machine, version.version), verdicts)


def require_uncorrected(campaign: Campaign) -> None:
    """Refuse a campaign that was measured under a correction.

    Parameters
    ----------
    campaign : Campaign
        What an equation would be made of.

    Raises
    ------
    InputError
        When its geometry says so.
    """
    if campaign.machine_geometry.get("corrected", False):
        raise InputError(
            "a correction was in force during this campaign: it shows what that left, not the machine",
            code="train.corrected", where=campaign.name, got="corrected = true",
            hint="use a campaign without; dtwin twin fit shows what is left of this one",
        )  # fmt: skip


def measure_evidence(
    home: Home,
    version: RegisteredVersion,
    geometry: Mapping[str, Any],
    *,
    seed: int,
    plan: EvidencePlan | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Evidence:
    """Measure compensated against uncompensated circles on the virtual cobot and keep them.

    Parameters
    ----------
    home : Home
        Registry.
    version : RegisteredVersion
        What to serve.
    geometry : mapping
        The machine's geometry; it must be a virtual one.
    seed : int
        Seed of the machine.
    plan : EvidencePlan, optional
        Circles; without, one radius of every plane that was trained, at feeds that were and
        were not.
    progress : callable, optional
        Called with (done, total, what).

    Raises
    ------
    InputError
        When the machine is real: its circles have to be measured on it.
    """
    if not geometry.get("virtual", False):
        raise InputError(
            "what a correction does to a real machine has to be measured on it",
            code="evidence.real",
            where=f"machine {version.machine}",
            hint="serve the trial, measure with and without it, and give the file to "
            "dtwin promote --evidence",
        )
    from dtwin.train.evidence import plan_within, virtual_evidence

    registry = Registry(home)
    bundle = Bundle.from_dict(registry.bundle(version))
    if plan is None:
        trained = registry.read_json(version, CONDITIONS_FILE)
        plan = plan_within([(str(p), float(r), float(f)) for p, r, f in trained])
    if geometry.get("type") == "mill":
        evidence = _on_the_mill(bundle, geometry, seed=seed, plan=plan, progress=progress)
    else:
        evidence = virtual_evidence(
            bundle,
            seed=seed,
            tcp_mm=np.asarray(geometry.get("tcp_mm", [0.0, 0.0, 0.0]), float),
            plan=plan,
            progress=progress,
        )
    found = evidence.as_dict()
    section = evidence_section(found, evidence.profiles)
    registry.attach(
        version,
        {
            EVIDENCE_FILE: json.dumps(found, indent=1),
            "evidence.html": page("Closed-loop evidence", f"version {version.version}", [section]),
        },
    )
    before = registry.description(version)
    registry.mark(version, {}, description=before + "\n\n" + _evidence_markdown(found))
    return evidence


def evidence_for(
    home: Home, version: RegisteredVersion, *, seed: int,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return closed-loop evidence of the virtual machine that a version was trained on.

    Parameters
    ----------
    home : Home
        Registry.
    version : RegisteredVersion
        The version.
    seed : int
        Seed of the machine.
    progress : callable, optional
        Called with (done, total, what).

    Raises
    ------
    InputError
        When the machine is real: it has to be measured on it.
    """
    geometry = geometry_of(Registry(home), version)
    own_way = _evidence_of(str(geometry.get("type"))) if geometry.get("virtual") else None
    if own_way is not None:
        return own_way(home, version, geometry, seed=seed, progress=progress)
    return measure_evidence(home, version, geometry, seed=seed, progress=progress).as_dict()


def _training_of(kind: str) -> Callable[..., Training]:
    """Return what trains a kind of campaign; each brings libraries that the others do without."""
    if kind == "sinusoidal":
        from dtwin.train.tone_training import train_tones

        return train_tones
    if kind == "linear":
        from dtwin.train.positioning_training import train_positioning

        return train_positioning
    if kind == "volumetric":
        from dtwin.pipeline.volumetric_training import train_volumetric

        return train_volumetric
    from dtwin.train.training import train_campaign

    return train_campaign


def _evidence_of(machine_type: str) -> Callable[..., dict[str, Any]] | None:
    """Return what moves a type of virtual machine, None for those that run circles."""
    if machine_type == "turning":
        from dtwin.pipeline.turning_evidence import measure_tone_evidence

        return measure_tone_evidence
    if machine_type == "lathe":
        from dtwin.pipeline.lathe_evidence import measure_lathe_evidence

        return measure_lathe_evidence
    if machine_type == "volumetric":
        from dtwin.pipeline.volumetric_evidence import measure_volumetric_evidence

        return measure_volumetric_evidence
    return None


def _on_the_mill(
    bundle: Bundle,
    geometry: Mapping[str, Any],
    *,
    seed: int,
    plan: EvidencePlan,
    progress: Callable[[int, int, str], None] | None,
) -> Evidence:
    from dtwin.acquire.virtual_mill import virtual_mill
    from dtwin.train.mill_evidence import mill_evidence

    if "hidden" not in geometry:
        raise InputError(
            "no virtual mill of this machine can be moved from here",
            code="evidence.mill",
            got=f"machine_geometry {', '.join(geometry)}",
            allowed="a campaign of dtwin simulate --machine mill",
            hint="dtwin demo mill measures its own evidence; else give a file to --evidence",
        )
    return mill_evidence(
        bundle,
        partial(virtual_mill, str(geometry["hidden"])),
        seed=seed,
        plan=replace(plan, repeats=max(plan.repeats, 3)),
        delay_s=float(geometry["correction_delay_s"]),
        progress=progress,
    )


def put_on_trial(home: Home, version: RegisteredVersion, comment: str = "") -> Path:
    """Put a version on trial; offline gates decide.

    Parameters
    ----------
    home : Home
        Registry and bundles.
    version : RegisteredVersion
        The version.
    comment : str
        Why.
    """
    registry = Registry(home)
    return trial(registry, home, version, geometry=geometry_of(registry, version), comment=comment)


def make_champion(
    home: Home,
    version: RegisteredVersion,
    evidence: Mapping[str, Any] | None,
    comment: str = "",
) -> tuple[Path | None, str]:
    """Make a version champion, or return why not.

    Parameters
    ----------
    home : Home
        Registry and bundles.
    version : RegisteredVersion
        The version.
    evidence : mapping or None
        Closed-loop evidence.
    comment : str
        Why; kept in the history.

    Returns
    -------
    path, reason : tuple
        The served bundle, or None and the reasons.
    """
    registry = Registry(home)
    geometry = geometry_of(registry, version)
    try:
        return promote(
            registry, home, version, geometry=geometry, evidence=evidence, comment=comment
        ), ""
    except GateRefusal as refusal:
        return None, refusal.render()


def geometry_of(registry: Registry, version: RegisteredVersion) -> dict[str, Any]:
    """Return the machine's geometry that a version was trained with."""
    found: dict[str, Any] = registry.read_json(version, "geometry.json")
    return found


def evidence_of(registry: Registry, version: RegisteredVersion) -> dict[str, Any] | None:
    """Return the closed-loop evidence that is kept with a version, None without any."""
    try:
        found: dict[str, Any] = registry.read_json(version, EVIDENCE_FILE)
    except InputError:
        return None
    return found


def _description(training: Training, verdicts: list[Verdict]) -> str:
    report = training.report
    proposed = report.candidate(report.proposed)
    held_out = proposed.held_out
    digits = 1 if held_out.rms_um >= 1.0 else 3
    lines = [
        f"**{proposed.name}** for {report.machine}, trained on `{report.campaign}` "
        f"({report.n_runs} runs, table versions {dict(report.table_versions)}).",
        "",
        f"Held-out by {held_out.group}: {report.rms_before_um:.1f} -> {held_out.rms_um:.{digits}f} um "
        f"RMS (R2 {held_out.r2:.3f}); noise floor {report.noise_floor_text}.",
        "",
        *(f"- {line}" for line in report.told),
        "",
        _markdown(*comparison_table(report.candidates)),
        "",
        "Offline gates:",
        "",
        *(f"- {line}" for line in verdict_lines(verdicts)),
    ]
    return "\n".join(lines)


def _evidence_markdown(evidence: Mapping[str, Any]) -> str:
    return f"Closed-loop evidence ({evidence['kind']}, {evidence['clock']}):\n\n" + _markdown(
        *evidence_table(evidence)
    )


def _markdown(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)
