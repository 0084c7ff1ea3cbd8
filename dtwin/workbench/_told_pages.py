"""The page of a twin that is told in words and tables: of no path, and of no volume."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go
from fastapi import APIRouter, Request
from starlette.responses import Response

from dtwin.errors import InputError
from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.kinds.volumetric.motions import FAMILIES
from dtwin.kinds.volumetric.twin_report import REPORT
from dtwin.physics.twin import Twin
from dtwin.report.faults import faults, grouped
from dtwin.report.html import Table
from dtwin.report.twin_of_campaigns import contradiction_lines
from dtwin.report.twin_of_kind import report_of
from dtwin.report.twin_of_machine import captioned
from dtwin.twins.machine_twin import MachineComparison, MachineTwin
from dtwin.twins.measured import Comparison
from dtwin.twins.of_kind import AnyTwin
from dtwin.twins.several_campaigns import SeveralComparison
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Bench, Here, bench_of
from dtwin.workbench._pages import drawn, rendered

router = APIRouter()


def told_page(request: Request, name: str, on: str = "") -> Response:
    """Show a twin as its kind tells it: how far it goes, what is missing, and its versions.

    ``on``: other measurements than those of the fit.
    """
    bench = bench_of(request)
    twins = bench.twins_with(name)
    twin = twins.newest(name)
    diagnosis = reading.diagnosis_of(bench, name, twin.version)
    compared, figures = _comparison(bench, name, on)
    parts = [part for part in getattr(twin, "members", ()) if isinstance(part, Twin)]
    return rendered(
        request,
        "told.html",
        title=f"Twin {name}",
        name=name,
        twin=twin,
        on=on,
        campaigns=sorted(name for kind in _kinds_of(bench, twin) for name in bench.campaigns_of(twin.machine, kind)),
        compared=report_of(compared).comparison_text(compared),
        figures=[figure.layout.title.text for figure in figures],
        contradictions=contradiction_lines(twin.as_dict()),
        paths=[c for part in parts for c in part.campaigns],
        faults=grouped(
            [[f] for part in parts for f in faults(part, None, bench.library)], lambda alike: alike[0].group
        ),
        learnable=bench.able_to(twin, "laws"),
        correctable=bench.able_to(twin, "twin_correction"),
        diagnosis=diagnosis,
        told=report_of(diagnosis).diagnosis_text(name, diagnosis) if diagnosis else "",
        parameters=_captioned(twin),
        rungs=twins.history(name),
    )


def _captioned(twin: AnyTwin) -> list[tuple[str, Table]]:
    if isinstance(twin, MachineTwin):
        return captioned(twin)
    return [("Effects, and their sizes", shown) for shown in report_of(twin.as_dict()).twin_section(twin).tables]


def compared_with(bench: Bench, name: str, on: str) -> dict[str, Any]:
    """Return a twin of no path against measurements; without, against those of its fit."""
    return _comparison(bench, name, on)[0]


@router.get("/api/twins/{name}/compared/{number}")
def compared_figure(bench: Here, name: str, number: int, on: str = "") -> Response:
    """Return a figure of a twin of no path against measurements."""
    figures = _comparison(bench, name, on)[1]
    if not 0 <= number < len(figures):
        raise InputError("no such figure", code="page.unknown", where=name, got=str(number), allowed=f"{len(figures)}")
    return drawn(figures[number])


def _comparison(bench: Bench, name: str, on: str) -> tuple[dict[str, Any], list[go.Figure]]:
    """Return a comparison with its figures; those of circles and other paths have a page of their own."""
    twins = bench.twins_with(name)
    twin = twins.newest(name)
    campaigns = [on] if on else twin.campaigns
    made = reading.version_file(bench, name, twin.version).stat().st_mtime_ns
    key = ("compared", name, twin.version, made, *campaigns, *map(bench.stamp, campaigns))

    def compared() -> tuple[dict[str, Any], list[go.Figure]]:
        comparison = twins.compare(name, on or None)
        result = comparison.as_dict()
        each = (
            zip(comparison.parts, result["members"], strict=True)
            if isinstance(comparison, MachineComparison)
            else [(comparison, result)]
        )
        told = [(part, one) for part, one in each if not isinstance(part, Comparison | SeveralComparison)]
        sections = [section for part, one in told for section in report_of(one).comparison_sections(part, one)]
        return result, [figure for section in sections for figure in section.figures]

    return bench.cache.get(key, compared)


def _kinds_of(bench: Bench, twin: AnyTwin) -> list[str]:
    """Return the kinds of campaign that a twin was fitted to."""
    return list(dict.fromkeys(bench.lake.campaign(name).kind for name in twin.campaigns))


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
        terms=REPORT.parameter_table(twin),
        families=FAMILIES.values(),
    )
