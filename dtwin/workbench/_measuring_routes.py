"""What is under way: campaigns that are being measured, with what the operator is asked, and the progress of work."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import JSONResponse, Response

from dtwin.errors import InputError
from dtwin.pipeline.desk import desks, give_answer
from dtwin.workbench._bench import Here
from dtwin.workbench._pages import rendered

router = APIRouter()


@router.get("/measuring")
def measuring_page(request: Request, bench: Here) -> Response:
    """Show what is asked now."""
    asked = desks(bench.home)
    desks_shown = [
        {"id": name, "name": folder.name, "folder": str(folder), "question": question}
        for name, (folder, question) in asked.items()
    ]
    return rendered(request, "measuring.html", title="Measuring", desks=desks_shown, seen=_open(asked))


@router.get("/api/measuring")
def measuring(bench: Here) -> dict[str, Any]:
    """Return the questions that are open, by the desk's name."""
    return _open(desks(bench.home))


def _open(asked: Mapping[str, tuple[Path, Mapping[str, Any]]]) -> dict[str, Any]:
    return {name: dict(question) for name, (_, question) in asked.items()}


@router.post("/api/measuring/{desk}/{question}/{answer}")
def answered(bench: Here, desk: str, question: str, answer: str) -> JSONResponse:
    """Answer a question."""
    asking = desks(bench.home).get(desk)
    if asking is None:
        raise InputError(
            "no campaign is measured there now", code="campaign.answer", got=desk[:40], hint="reload the page"
        )
    give_answer(asking[0], question, answer)
    return JSONResponse({"answered": answer})


@router.get("/api/jobs/{job_id}")
def progress(bench: Here, job_id: str) -> dict[str, Any]:
    """Say how far a job is."""
    job = bench.jobs.get(job_id)
    if job is None:
        raise InputError(
            "this work is not known here",
            code="page.unknown",
            got=job_id[:40],
            hint="reload the page: what was finished is there",
        )
    return asdict(job)


@router.delete("/api/jobs/{job_id}")
def forget(bench: Here, job_id: str) -> dict[str, Any]:
    """Drop the note of a job that has ended."""
    bench.jobs.forget(job_id)
    return {}
