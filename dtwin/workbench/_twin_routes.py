"""Pages about twins: compare, diagnose, versions, report."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from dtwin.errors import InputError
from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin
from dtwin.pipeline.reported_twin import twin_report
from dtwin.report.encoder_share import encoder_section, tells
from dtwin.report.faults import faults, found_faults, grouped, not_told, title_of
from dtwin.report.pdf import pdf_of
from dtwin.report.twin_of_campaigns import contradiction_lines
from dtwin.report.twin_of_kind import report_of, with_nan
from dtwin.report.twin_plots import (
    along_figure,
    harmonics_figure,
    overlay_figure,
    ranked_figure,
    residual_map,
    waterfall_figure,
)
from dtwin.report.twins import found_table, left_of, parameter_table
from dtwin.twins.registration import waiting, waiting_text
from dtwin.twins.verbs import Twins
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Here, bench_of, possible_effects
from dtwin.workbench._pages import download, drawn, in_language, rendered
from dtwin.workbench._plan_routes import experiment_documents, grids_of, plans_zip
from dtwin.workbench._registry_rows import mlflow_page
from dtwin.workbench._told_pages import compared_with, heat_page, told_page

_HARMONICS = 60
router = APIRouter()
_Numbers = Annotated[list[int], Query()]
_Words = Annotated[list[str], Query()]


@router.get("/twins")
def twin_list(request: Request, bench: Here) -> Response:
    """Show all twins."""
    return rendered(
        request,
        "twins.html",
        title="Twins",
        twins=bench.twin_lines(),
        any_campaign=bool(bench.campaigns()),
        left=bench.cache.get(("waiting", bench.twins_version), lambda: waiting_text(waiting(bench.home))),
    )


@router.get("/twins/{name}")
def compare_page(request: Request, bench: Here, name: str, on: str = "") -> Response:
    """Show measured against twin, on the runs of the fit or on others of the machine."""
    if other := _page_of_no_path(request, name, on):
        return other
    view = reading.view(bench, name, on=on)
    whole = bench.twins.newest(name)
    machine = view.twin.machine
    campaigns = bench.campaigns_of(machine)
    worst = reading.both_ways(view, reading.chosen_conditions(view, ())[0])
    return rendered(
        request,
        "compare.html",
        title=f"Twin {name}: compare",
        name=name,
        tab="compare",
        twin=view.twin,
        whole=whole,
        told=contradiction_lines(whole.as_dict()),
        result=view.result,
        labels=view.labels,
        worst=worst,
        conditions=view.obs.conditions,
        floor=reading.floor_of(bench, view),
        parameters=parameter_table(whole),
        campaigns=campaigns,
        on=view.obs.campaign.name,
        kind=view.obs.grid.kind,
        seen=encoder_section(split) if tells(split := view.result["encoder_split"]) else None,
    )


@router.get("/twins/{name}/diagnose")
def diagnose_page(request: Request, bench: Here, name: str) -> Response:
    """Show what is missing."""
    if other := _page_of_no_path(request, name):
        return other
    twin = bench.twins.newest(name)
    diagnosis = reading.diagnosis_of(bench, name, twin.version)
    experiment = diagnosis["next_experiment"] if diagnosis else None
    planned = bool(experiment and experiment["conditions"])
    return rendered(
        request,
        "diagnose.html",
        title=f"Twin {name}: diagnose",
        name=name,
        tab="diagnose",
        twin=twin,
        diagnosis=diagnosis,
        grids=grids_of(experiment) if planned else [],
        found=found_table(diagnosis or {}, bench.library),
        left=left_of(diagnosis or {}),
        reported={f"{c['effect']} {c['axis']}".strip() for group in (diagnosis or {}).get("found", ()) for c in group},
        faults=grouped([[fault] for fault in faults(twin, diagnosis, bench.library)], lambda alike: alike[0].group),
        missing=grouped(found_faults(diagnosis or {}, bench.library), lambda alike: alike[0].group),
        offered=grouped(
            (diagnosis or {}).get("candidates", ()),
            lambda c: bench.library[c["effect"]].group if c["effect"] in bench.library else "",
        ),
        not_told=not_told(diagnosis or {}, bench.library),
        together=report_of(diagnosis).diagnosis_section(name, with_nan(diagnosis))
        if diagnosis and "campaigns" in diagnosis
        else None,
        floor=reading.FLOOR_WORDS[diagnosis["floor_kind"]] if diagnosis else "",
        runs_say=reading.said_together_in(bench, twin.campaign),
    )


@router.get("/twins/{name}/versions")
def versions_page(
    request: Request, bench: Here, name: str, first: int | None = None, second: int | None = None
) -> Response:
    """Show every version, two of them side by side, and what can be added or removed."""
    if other := _page_of_no_path(request, name):
        return other
    twins = bench.twins
    rungs = twins.history(name)
    newest = twins.newest(name)
    right = newest if second is None else twins.newest(name, second)
    left = twins.newest(name, max(1, right.version - 1) if first is None else first)
    rows = [bench.run_rows(campaign) for campaign in bench.able_to(newest, "rows")]
    possible = {e.name: e for mine in rows for e in possible_effects(mine, bench.library)}
    return rendered(
        request,
        "versions.html",
        title=f"Twin {name}: versions",
        name=name,
        tab="versions",
        twin=newest,
        rungs=rungs,
        correctable=bench.able_to(newest, "twin_correction"),
        pair=(left, right),
        effects=possible.values(),
        tables=[parameter_table(v) for v in (left, right)],
        mlflow=[
            mlflow_page(bench.home, r["mlflow"]["model"], r["mlflow"]["model_version"]) if r["mlflow"] else None
            for r in rungs
        ],
    )


@router.get("/twins/{name}/report.{ending}")
def report(bench: Here, name: str, ending: Literal["html", "pdf"], language: str = "en") -> Response:
    """Return the whole story as one file that needs nothing else."""
    twin = bench.twins_with(name).newest(name)
    if not isinstance(twin, Twin):
        comparison, compared = None, compared_with(bench, name, "")
    else:
        comparison = (
            bench.twins.compare(name) if isinstance(twin, SeveralTwin) else reading.view(bench, name).comparison
        )
        compared = comparison.as_dict()
    made = twin_report(bench.home, bench.twins_with(name), bench.library, twin, comparison, compared, language)
    file = f"{in_language(f'{twin.machine}-{name}-v{twin.version}', language)}.{ending}"
    return download(made, file, "text/html") if ending == "html" else download(pdf_of(made), file, "application/pdf")


@router.get("/twins/{name}/next-experiment.toml")
def experiment_plan(request: Request, name: str) -> Response:
    """Return the next experiment as a plan file, when one grid holds it."""
    twin, experiment = _experiment(request, name)
    stem = f"{name}-next"
    first = experiment_documents(stem, twin.machine, experiment)[0]
    return download(tomli_w.dumps(first), f"{stem}.toml", "application/toml")


@router.get("/twins/{name}/next-experiment.zip")
def experiment_programs(request: Request, name: str) -> Response:
    """Return the next experiment as plans and programs."""
    twin, experiment = _experiment(request, name)
    stem = f"{name}-next"
    documents = experiment_documents(stem, twin.machine, experiment)
    return download(plans_zip(documents), f"{stem}.zip", "application/zip")


@router.get("/api/twins/{name}/overlay/{kind}")
def overlay(
    bench: Here,
    name: str,
    kind: str,
    condition: _Numbers = [],  # noqa: B006
    show: _Words = [],  # noqa: B006
    run: _Words = [],  # noqa: B006
    magnification: str = "",
    on: str = "",
) -> Response:
    """Return curves of conditions and runs: polar, over the angle, or their harmonics."""
    view = reading.view(bench, name, on=on)
    floor_um = reading.floor_of(bench, view).um
    chosen = reading.chosen_conditions(view, condition)[:6]
    shown = [w for w in ("measured", "twin", "residual") if w in show] or ["measured", "twin"]
    curves = reading.overlay(view, chosen, shown, run[:12])
    title = view.labels[chosen[0]] if len(chosen) == 1 else f"{len(chosen)} conditions"
    grid = view.obs.grid
    if kind == "angle":
        return drawn(along_figure(curves, title=title, floor_um=floor_um, grid=grid))
    if kind == "harmonics":
        floor = reading.floor_harmonics_um(view)
        whole = {n: c for n, c in curves.items() if np.isfinite(c).all()}
        known = "" if floor is not None else " (noise floor not known: no repeats of full turns)"
        most = _HARMONICS if grid is CIRCLE else grid.n // 2
        return drawn(harmonics_figure(whole, floor, title=f"Harmonics, {title}{known}", most=most))
    if grid is not CIRCLE:
        raise InputError("only circles are drawn as polar plots", code="page.unknown", where=name, got=grid.kind)
    first = view.obs.conditions[chosen[0]]
    factor = decimal(magnification, "the magnification") if magnification else None
    plane = first.plane if len({view.obs.conditions[c].plane for c in chosen}) == 1 else None
    return drawn(
        overlay_figure(
            curves,
            first.radius_mm,
            title=f"{title}, µm",
            floor_um=floor_um,
            magnification=factor,
            slider=False,
            plane=plane,
        )
    )


@router.get("/api/twins/{name}/runs")
def runs(bench: Here, name: str, condition: _Numbers = [], on: str = "") -> dict[str, Any]:  # noqa: B006
    """Return the runs of conditions."""
    view = reading.view(bench, name, on=on)
    chosen = reading.chosen_conditions(view, condition)
    return {"campaign": view.obs.campaign.name, "conditions": chosen, "runs": reading.runs_of(view, chosen)}


@router.get("/api/twins/{name}/map")
def heat_map(bench: Here, name: str, on: str = "") -> Response:
    """Return the mean residual of every condition over the angle."""
    view = reading.view(bench, name, on=on)
    floor_um = reading.floor_of(bench, view).um
    means, grid = view.residual_um, view.obs.grid
    title = "Mean residual"
    return drawn(residual_map(means, view.labels, floor_um=floor_um, title=title, grid=grid))


@router.get("/api/twins/{name}/encoder")
def encoder(bench: Here, name: str, on: str = "") -> Response:
    """Return the error by who can see it, when the controller was logged."""
    split = reading.view(bench, name, on=on).result["encoder_split"]
    if not split:
        raise InputError("the controller was not logged", code="page.unknown", where=name)
    return drawn(encoder_section(split).figures[0])


@router.get("/api/twins/{name}/waterfall")
def waterfall(bench: Here, name: str) -> Response:
    """Return how the error fell from version to version."""
    begun = "set-up only" if isinstance(bench.twins_with(name), Twins) else "no effects"
    return drawn(waterfall_figure(bench.twins.history(name), begun, bench.library))


@router.get("/api/twins/{name}/ranked")
def ranked(bench: Here, name: str) -> Response:
    """Return the candidates by the error predicted after adding each."""
    diagnosis = reading.diagnosis_of(bench, name, bench.twins.newest(name).version)
    if diagnosis is None:
        raise InputError("the twin is not diagnosed yet", code="twin.undiagnosed", where=f"twin {name}")
    return drawn(ranked_figure(with_nan(diagnosis), bench.library))


@router.get("/api/twins/{name}/signature")
def signature(bench: Here, name: str, effect: str, condition: _Numbers = []) -> Response:  # noqa: B006
    """Return what adding an effect would take away, over the residual."""
    diagnosis = reading.diagnosis_of(bench, name, bench.twins.newest(name).version) or {"candidates": []}
    labelled = {f"{c['effect']} {c['axis']}".strip(): c.get("campaign", "") for c in diagnosis["candidates"]}
    view = reading.view(bench, name, on=labelled.get(effect, ""))
    taken = reading.taken_away_um(bench, view, effect)
    chosen = reading.chosen_conditions(view, condition)[0]
    named = title_of(effect, bench.library)
    curves = {"residual": view.residual_um[chosen], f"predicted: {named}": taken[chosen]}
    of = f"{view.obs.campaign.name}, " if labelled.get(effect) else ""
    title = f"What {named} would take away, {of}{view.labels[chosen]}"
    floor_um = reading.floor_of(bench, view).um
    return drawn(along_figure(curves, title=title, floor_um=floor_um, grid=view.obs.grid))


def _page_of_no_path(request: Request, name: str, on: str = "") -> Response | None:
    """Return the page of a twin that has no path to draw an error along; None for one that has."""
    twins = bench_of(request).twins_with(name)
    if isinstance(twins, HeatTwins):
        return heat_page(request, name, on)
    return None if isinstance(twins, Twins) else told_page(request, name, on)


def _experiment(request: Request, name: str) -> tuple[Any, Any]:
    bench = bench_of(request)
    twin = bench.twins.newest(name)
    diagnosis = reading.diagnosis_of(bench, name, twin.version)
    return twin, diagnosis["next_experiment"] if diagnosis else None


_PLAIN = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d{1,3})?")
_GROUPED = re.compile(r"[+-]?\d{1,3}((,\d{3})+(\.\d*)?|(\.\d{3})+(,\d*)?)")
_MOST_CHARACTERS = 40


def decimal(text: str, what: str) -> float:
    """Return the number that a text means; ``0,5`` and ``0.5`` are the same.

    A single comma or point is the decimal sign. When both occur, the last one is, and the
    other one groups thousands, as the same sign twice does.
    """
    plain = re.sub(r"[\s\u00a0\u202f'\u2019]", "", text[: _MOST_CHARACTERS + 1]).replace("\u2212", "-")
    value = math.nan
    if len(plain) <= _MOST_CHARACTERS:
        if _PLAIN.fullmatch(plain):
            value = float(plain.replace(",", "."))
        elif grouped := _GROUPED.fullmatch(plain):
            groups = "," if grouped.group(2) else "."
            value = float(plain.replace(groups, "").replace(",", "."))
    if math.isfinite(value):
        return value
    raise InputError(
        f"{what} is not a number", code="number.invalid", got=text[:_MOST_CHARACTERS], allowed="for example 0.5 or 0,5"
    )
