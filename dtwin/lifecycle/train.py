"""Train, register, judge, put on trial."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.acquire.amending import amendment_findings
from dtwin.config import Home
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.lifecycle.drift import require_training
from dtwin.progress import StageProgress, silent
from dtwin.report.campaign import comparison_table, training_section
from dtwin.report.html import page
from dtwin.train.dataset import require_uncorrected
from dtwin.train.gates import Verdict
from dtwin.train.promotion import check_version, trial, verdict_lines
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE, worse_in_sample
from dtwin.train.twin_band import with_held_out_band

if TYPE_CHECKING:
    from dtwin.train.results import Training
    from dtwin.train.symbolic import Engine


@dataclass(frozen=True)
class Registered:
    """A training that is in the registry."""

    training: Training
    version: RegisteredVersion
    verdicts: list[Verdict]


def train(
    home: Home, campaign: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Registered:
    """Train every candidate on a campaign, log them, register the proposed one.

    Raises ``InputError`` when a correction was in force while it was measured, or it cannot be used otherwise.
    Raises ``StoreError`` when the registry cannot be written, before a training that would be lost.
    """
    Registry(home)
    return registered(home, trained(home, campaign, seed=seed, engine=engine, progress=progress), progress)


def trained(
    home: Home, campaign: str, *, seed: int = 1, engine: Engine | None = None, progress: StageProgress = silent
) -> Training:
    """Train every candidate on a campaign; nothing is written."""
    lake = Lake(home.lake)
    known = lake.campaign(campaign)
    require_uncorrected(known)
    training = kind_named(known.kind).training()(lake, campaign, seed=seed, engine=engine, progress=progress)
    amended = [f.message for f in amendment_findings(lake.runs(campaign, left_out=True))]
    told = *training.report.told, *worse_in_sample(training.report.candidates), *amended
    candidates = tuple(with_held_out_band(c) for c in training.report.candidates)
    return replace(training, report=replace(training.report, told=told, candidates=candidates))


def registered(home: Home, training: Training, progress: StageProgress = silent) -> Registered:
    """Log the candidates of a training, register the proposed one, and judge it by the offline gates."""
    progress("log and register", 0, 1, "")
    report = training.report
    registry = Registry(home)
    title = f"Training on {report.campaign}"
    overview = page(title, report.machine, [training_section(report)])
    ids = registry.log_training(report, {"comparison.html": overview})
    proposed = report.candidate(report.proposed)
    version = registry.register(report, ids[proposed.name], proposed)
    registry.attach(
        version,
        {
            "geometry.json": json.dumps(dict(training.geometry), default=str),
            CONDITIONS_FILE: json.dumps(training.conditions),
        },
    )
    _, verdicts = check_version(registry, version)
    description = _description(training, verdicts)
    registry.mark(version, {}, description=description)
    registry.note(
        ids[""], f"{description}\n\nThe candidates are the runs below this one; pictures are in its artifacts."
    )
    progress("log and register", 1, 1, f"version {version.version}")
    return Registered(training, registry.version(report.machine, version.version), verdicts)


def put_on_trial(home: Home, version: RegisteredVersion, comment: str = "") -> Path:
    """Put a version on trial; offline gates decide."""
    require_training(home, version)
    registry = Registry(home)
    return trial(registry, home, version, geometry=geometry_of(registry, version), comment=comment)


def geometry_of(registry: Registry, version: RegisteredVersion) -> dict[str, Any]:
    """Return the machine's geometry that a version was trained with."""
    return registry.read_json(version, "geometry.json")


def _description(training: Training, verdicts: list[Verdict]) -> str:
    report = training.report
    proposed = report.candidate(report.proposed)
    held_out = proposed.held_out
    digits = 1 if held_out.rms_um >= 1.0 else 3
    tables = ", ".join(f"{name} {version}" for name, version in report.table_versions.items() if version >= 0)
    lines = [
        f"The candidate {proposed.name} for {report.machine}, trained on `{report.campaign}` "
        f"({report.n_runs} runs{f'; versions of the tables: {tables}' if tables else ''}).",
        "",
        f"Left out by {held_out.group}: {report.rms_before_um:z.1f} → {held_out.rms_um:z.{digits}f} µm "
        f"RMS (R² {held_out.r2:z.3f}); noise floor {report.noise_floor_text}.",
        "",
        *(f"- {line}" for line in report.told),
        "",
        markdown_table(*comparison_table(report.candidates)),
        "",
        "Offline gates:",
        "",
        *(f"- {line}" for line in verdict_lines(verdicts)),
    ]
    return "\n".join(lines)


def markdown_table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table as the registry's page shows it."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)
