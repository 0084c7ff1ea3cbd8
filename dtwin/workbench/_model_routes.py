"""Pages about learned models: what was tried, what the gates say, promote and roll back."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.errors import InputError
from dtwin.progress import Tell
from dtwin.report.html import Table
from dtwin.report.model_plots import comparison_figure, evidence_figure, front_figure, r2_figure
from dtwin.train.promotion_books import LONGEST_COMMENT
from dtwin.workbench import _registry_rows
from dtwin.workbench._bench import Bench, Here
from dtwin.workbench._pages import accepted, drawn, rendered

router = APIRouter()


class _Comment(BaseModel):
    """Why something is promoted or rolled back; kept in the history."""

    comment: str = Field("", max_length=LONGEST_COMMENT)
    trial: bool = False


@router.get("/models")
def model_list(request: Request, bench: Here) -> Response:
    """Show the versions of every machine, and the history of promotions."""
    home = bench.home
    registry = _registry_rows.registry_of(home)
    versions: list[Any] = []
    past: dict[str, list[dict[str, Any]]] = {}
    if registry is not None:
        from dtwin.train.promotion import listed
        from dtwin.train.promotion_books import history

        versions = listed(registry, home)
        past = {m: history(home, m) for m in dict.fromkeys(version.machine for version, _ in versions)}
    return rendered(request, "models.html", title="Models", versions=versions, past=past)


@router.get("/models/{machine}/{version}")
def model_page(request: Request, bench: Here, machine: str, version: str) -> Response:
    """Show a version: candidates, front, gates, evidence."""
    judged = _judged(bench, machine, version)
    from dtwin.report.campaign import evidence_table
    from dtwin.train.promotion import state_of

    evidence = Table(*evidence_table(judged.evidence)) if judged.evidence else None
    number = judged.version.version
    return rendered(
        request,
        "model.html",
        title=f"{machine} version {number}",
        found=judged,
        machine=machine,
        evidence=evidence,
        state=state_of(judged.version, bench.home),
        mlflow=_registry_rows.mlflow_page(bench.home, f"dtwin-{machine}", number),
    )


@router.get("/api/models/{machine}/{version}/{kind}")
def model_figure(bench: Here, machine: str, version: str, kind: str) -> Response:
    """Return a figure of a version: front, latency, r2 or evidence."""
    judged = _judged(bench, machine, version)
    if kind == "front" and judged.front:
        return drawn(front_figure(judged.front, judged.floor_um, judged.floor_dof))
    if kind == "latency":
        return drawn(comparison_figure(judged.candidates, judged.floor_um, judged.floor_dof))
    if kind == "r2":
        return drawn(r2_figure(judged.candidates))
    if kind == "evidence" and judged.evidence:
        return drawn(evidence_figure(judged.evidence))
    raise InputError("there is no such figure", code="page.unknown", got=kind[:40])


@router.post("/api/models/{machine}/{version}/promote")
def promote(bench: Here, machine: str, version: str, why: _Comment) -> JSONResponse:
    """Check a version and make it champion, or put it on trial; the gates decide."""
    registry = _registry_rows.require_registry(bench.home, machine)
    registered = registry.version(machine, version)

    def work(tell: Tell) -> str:
        from dtwin.lifecycle.evidence import promote_proven, proven_or_measured
        from dtwin.lifecycle.train import put_on_trial as on_trial

        address = f"/models/{machine}/{registered.version}"
        if why.trial:
            tell("offline gates")
            on_trial(bench.home, registered, why.comment)
            return address
        tell("evidence from runs with and without correction")
        proven_or_measured(
            bench.home, registered, seed=0, progress=lambda done, total, what: tell(f"{done} of {total}, {what}")
        )
        tell("gates")
        promote_proven(bench.home, registered, why.comment)
        return address

    verb = "Put on trial" if why.trial else "Promote"
    return accepted(bench.jobs.start(f"{verb} {machine} version {registered.version}", work))


@router.post("/api/models/{machine}/rollback")
def roll_back(bench: Here, machine: str, why: _Comment) -> JSONResponse:
    """Bar the champion and go back to the one before it."""
    registry = _registry_rows.require_registry(bench.home, machine)

    def work(tell: Tell) -> str:
        from dtwin.train.promotion import rollback

        tell("restore the previous bundle")
        restored = rollback(registry, bench.home, machine, why.comment)
        return f"/models/{machine}/{restored.version}" if restored else "/models"

    return accepted(bench.jobs.start(f"Roll {machine} back", work))


def _judged(bench: Bench, machine: str, version: str) -> _registry_rows.Judged:
    registry = _registry_rows.require_registry(bench.home, machine)
    registered = registry.version(machine, version)
    # Tags change with every promotion; what they judge does not.
    stamp = json.dumps([dict(registered.tags), registered.aliases], sort_keys=True)
    key = ("model", machine, registered.version, registered.run_id, stamp)
    return bench.cache.get(key, lambda: _registry_rows.judged(registry, machine, registered.version))
