"""The page of a twin of heat: one page, since there is no path to draw an error along."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from dtwin.errors import InputError
from dtwin.kinds.volumetric import FAMILIES, HeatTwins, day_figure, motion_figure, term_table
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import bench_of
from dtwin.workbench._pages import drawn, rendered
from dtwin.workbench._told_pages import compared_with

router = APIRouter()


def heat_page(request: Request, name: str, on: str = "") -> Response:
    """Show a twin of heat: how far it goes, what is missing, and its versions.

    ``on``: other measurements than those of the fit.
    """
    bench = bench_of(request)
    twins = HeatTwins(bench.home)
    twin = twins.newest(name)
    campaigns = bench.campaigns_of(twin.machine)
    return rendered(
        request,
        "heat.html",
        title=f"Twin {name}",
        name=name,
        twin=twin,
        result=compared_with(bench, name, on),
        on=on or twin.campaign,
        campaigns=campaigns,
        diagnosis=reading.diagnosis_of(bench, name, twin.version),
        rungs=twins.history(name),
        terms=term_table(twin),
        families=FAMILIES.values(),
    )


@router.get("/api/twins/{name}/motions")
def motions(request: Request, name: str, on: str = "") -> Response:
    """Return every error motion at the balls, measured and left."""
    return drawn(motion_figure(_compared(request, name, on)))


@router.get("/api/twins/{name}/days")
def days(request: Request, name: str, on: str = "") -> Response:
    """Return the error at the balls day by day."""
    return drawn(day_figure(_compared(request, name, on)))


def _compared(request: Request, name: str, on: str) -> dict[str, Any]:
    bench = bench_of(request)
    if not isinstance(bench.twins_with(name), HeatTwins):
        raise InputError("the twin is not one of heat", code="page.unknown", where=name, hint="begin at /twins")
    return compared_with(bench, name, on)
