"""Progress of work."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Request

from dtwin.errors import InputError
from dtwin.workbench._bench import bench_of

router = APIRouter()


@router.get("/api/jobs/{job_id}")
def progress(request: Request, job_id: str) -> dict[str, Any]:
    """Say how far a job is."""
    job = bench_of(request).jobs.get(job_id)
    if job is None:
        raise InputError(
            "this work is not known here",
            code="page.unknown",
            got=job_id[:40],
            hint="reload the page: what was finished is there",
        )
    return asdict(job)


@router.delete("/api/jobs/{job_id}")
def forget(request: Request, job_id: str) -> dict[str, Any]:
    """Drop the note of a job that has ended."""
    bench_of(request).jobs.forget(job_id)
    return {}
