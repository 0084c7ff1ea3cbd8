"""The page of a twin of heat: one page, since there is no path to draw an error along."""

from __future__ import annotations

from fastapi import Request
from starlette.responses import Response

from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.kinds.volumetric.motions import FAMILIES
from dtwin.kinds.volumetric.twin_report import term_table
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import bench_of
from dtwin.workbench._pages import rendered
from dtwin.workbench._told_pages import compared_with


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
