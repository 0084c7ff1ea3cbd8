"""Which cause makes how much of the error, on the measured paths and along a program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.lifecycle.gcode_program import MAX_BYTES, plain
from dtwin.lifecycle.program_budget import of_circles, program_budget, program_lines, program_table
from dtwin.physics.effect import Effect
from dtwin.pipeline.kept import keep, kept_already
from dtwin.report.error_budget import SURE, budget_table, remedies, unexplained_line
from dtwin.report.faults import in_titles, undecided_lines
from dtwin.report.html import Table
from dtwin.twins.budget_spread import spread_budget
from dtwin.twins.of_kind import paths_of
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Bench, Here
from dtwin.workbench._pages import begun, rendered

_KEPT = "programs"
router = APIRouter()


class _ProgramRequest(BaseModel):
    """A program, and where the centre of the measured circles lies in its coordinates, mm."""

    program: str = Field(max_length=MAX_BYTES)
    file: str = Field("", max_length=200)
    x_mm: float = Field(0.0, gt=-1e6, lt=1e6)
    y_mm: float = Field(0.0, gt=-1e6, lt=1e6)
    z_mm: float = Field(0.0, gt=-1e6, lt=1e6)


@router.get("/twins/{name}/budget")
def budget_page(request: Request, bench: Here, name: str, on: str = "") -> Response:
    """Show what each cause makes of the error of measured paths, and of the program that was evaluated last."""
    view = reading.view(bench, name, on=on)
    whole = paths_of(bench.home, bench.library, name)
    budget, spread = bench.cache.get(("budget", *view.key), lambda: spread_budget(view.twin, view.obs, whole.terms))
    diagnosis = reading.diagnosis_of(bench, name, whole.version)
    program = kept_already(bench.home, _KEPT, name)
    return rendered(
        request,
        "budget.html",
        title=f"Twin {name}: budget",
        name=name,
        twin=whole,
        on=view.obs.campaign.name,
        campaigns=bench.campaigns_of(whole.machine, view.obs.campaign.kind),
        measured=budget_table(budget, spread),
        sure=SURE,
        remedies=remedies(budget),
        doubts=undecided_lines(diagnosis, bench.library),
        unexplained=unexplained_line(budget),
        program=program and {**program, "table": Table(program["head"], _titled(program["rows"], bench.library))},
    )


def _titled(rows: Sequence[Sequence[str]], library: Mapping[str, Effect]) -> list[list[str]]:
    """Return rows with titles in place of names for commands."""
    return [[in_titles(cause, library), *figures] for cause, *figures in rows]


@router.post("/api/twins/{name}/program")
def evaluate_program(bench: Here, name: str, wanted: _ProgramRequest) -> JSONResponse:
    """Evaluate a program with the newest version of a twin."""
    twin = of_circles(paths_of(bench.home, bench.library, name))
    where = wanted.file or "the program"
    text = plain(wanted.program.encode(), where)

    def work() -> None:
        origin_mm = np.array([wanted.x_mm, wanted.y_mm, wanted.z_mm])
        budget = program_budget(twin, text, origin_mm=origin_mm, where=where)
        _keep(bench, name, program_table(budget), program_lines(budget), file=where, version=twin.version)

    return begun(bench, f"Budget of {where}", f"/twins/{name}/budget", work, "follow the program")


def _keep(bench: Bench, name: str, shown: Table, lines: list[str], **about: Any) -> None:
    keep(bench.home, _KEPT, name, "", {"head": list(shown.head), "rows": shown.rows, "lines": lines, **about})
