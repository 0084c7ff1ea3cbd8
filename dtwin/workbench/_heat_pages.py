"""The page of a twin of heat: one page, since there is no path to draw an error along."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from dtwin.kinds.volumetric import FAMILIES, HeatTwins, day_figure, motion_figure, term_table
from dtwin.report.html import Section
from dtwin.report.twin_of_kind import comparison_sections, diagnosis_section, history_section, twin_section
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Bench, bench_of
from dtwin.workbench._pages import drawn, rendered

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
        result=_compared(bench, name, on),
        on=on or twin.campaign,
        campaigns=campaigns,
        diagnosis=reading.diagnosis_of(bench, name, twin.version),
        rungs=twins.history(name),
        terms=term_table(twin),
        families=FAMILIES.values(),
    )


def heat_sections(bench: Bench, name: str) -> list[Section]:
    """Return the whole story of a twin of heat, as ``dtwin twin show --html`` writes it."""
    twins = HeatTwins(bench.home)
    twin = twins.newest(name)
    diagnosis = reading.diagnosis_of(bench, name, twin.version)
    return [
        twin_section(twin),
        *comparison_sections(None, _compared(bench, name, "")),
        *([diagnosis_section(name, diagnosis)] if diagnosis else []),
        history_section(twin, twins.history(name)),
    ]


@router.get("/api/twins/{name}/motions")
def motions(request: Request, name: str, on: str = "") -> Response:
    """Return every error motion at the balls, measured and left."""
    return drawn(motion_figure(_compared(bench_of(request), name, on)))


@router.get("/api/twins/{name}/days")
def days(request: Request, name: str, on: str = "") -> Response:
    """Return the error at the balls day by day."""
    return drawn(day_figure(_compared(bench_of(request), name, on)))


def _compared(bench: Bench, name: str, on: str) -> dict[str, Any]:
    twins = HeatTwins(bench.home)
    twin = twins.newest(name)
    campaign = on or twin.campaign
    made = reading.version_file(bench, name, twin.version).stat().st_mtime_ns
    key = ("heat", name, twin.version, made, campaign, bench.stamp(campaign))
    return bench.cache.get(key, lambda: twins.compare(name, campaign).as_dict())
