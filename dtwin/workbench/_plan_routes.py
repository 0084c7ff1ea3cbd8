"""Pages about tests of a machine that are planned, as files, too, and what changed since the last one."""

from __future__ import annotations

import io
import os
import secrets
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any, Literal
from urllib.parse import parse_qsl

import tomli_w
from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.atomic import make_folder, write_text
from dtwin.errors import DtwinError, InputError
from dtwin.kinds.registry import kind_named
from dtwin.machine_record import read_record
from dtwin.pipeline.planned_tests import (
    draft_of,
    drafting_kinds,
    drop_plan,
    foretold,
    keep_plan,
    kept_plan,
    kept_plans,
    measured_by,
    with_settings,
)
from dtwin.pipeline.sheet_changes import last_changes, sheet_changes
from dtwin.plan_file import planned_document
from dtwin.progress import Tell
from dtwin.report.changes import change_table, changes_text, changes_title
from dtwin.report.faults import title_of
from dtwin.schema import DEFAULT_KIND
from dtwin.units import UNITS, shown_unit
from dtwin.workbench._bench import Bench, Here
from dtwin.workbench._pages import accepted, begun, download, rendered

router = APIRouter()
_COMPARED = 3
# Of more measuring a page does not compute what it would show: of 540 min of circles it takes 5 s and half a gigabyte.
_LONGEST_S = 12 * 3600.0
_LONGEST, _MOST_SETTINGS = 400, 60
# Of plans of hours, too, which no column of a measurement counts in.
# A feed of a linear plan is in its own unit a minute.
_UNITS = {"um_h": "um/h", **UNITS, "h": "h", "min": "unit/min"}
_Ending = Literal["toml", "zip"]


class _PlanTold(BaseModel):
    """A plan as the form's address holds it: ``kind`` and settings."""

    query: str = Field(max_length=4000)


@router.get("/machines/{name}/plan")
def plan_page(request: Request, bench: Here, name: str) -> Response:
    """Show the form of a test, how long it takes, what it would show, and what it could not tell apart."""
    kind, told = _told(request.url.query)
    draft = draft_of(bench.home, name, kind)
    kind = str(draft["plan"].get("kind", kind or DEFAULT_KIND))
    forecast: Mapping[str, Any] | None = None
    refused = ""
    try:
        document = with_settings(draft, told)
        forecast = foretold(bench.home, document, bench.library, _LONGEST_S)
    except DtwinError as error:
        document, refused = draft, error.render()
    shown = {} if forecast is None else _shown(bench, forecast)
    return rendered(
        request,
        "plan.html",
        200 if forecast is not None else 400,
        title=f"Plan a test of {name}",
        machine=name,
        kind=kind,
        kinds=drafting_kinds(),
        fields=[
            _field(key, told.get(key) if refused else None, value)
            for table in document.values()
            for key, value in table.items()
            if key not in ("kind", "machine")
        ],
        query=request.url.query or f"kind={kind}",
        found=forecast,
        refused=refused,
        with_programs=kind_named(kind).offers("programs"),
        foreseen=kind_named(kind).offers("foreseen"),
        compared=kind_named(kind).offers("sheet"),
        **shown,
    )


@router.get("/machines/{name}/plan.{ending}")
def plan_files(request: Request, bench: Here, name: str, ending: _Ending) -> Response:
    """Return what the form says as a plan file, or as plan file and programs."""
    kind, told = _told(request.url.query)
    return _files(with_settings(draft_of(bench.home, name, kind), told), ending)


@router.get("/machines/{name}/plans/{plan}.{ending}")
def kept_files(bench: Here, name: str, plan: str, ending: _Ending) -> Response:
    """Return a plan that was kept as its file, or as plan file and programs."""
    return _files(kept_plan(bench.home, plan), ending)


@router.post("/api/machines/{name}/plans")
def start_test(bench: Here, name: str, wanted: _PlanTold) -> JSONResponse:
    """Have a test measured at once on a virtual machine; else keep its plan until a campaign answers it."""
    kind, told = _told(wanted.query)
    document = with_settings(draft_of(bench.home, name, kind), told)
    planned_document(document, "the plan")
    virtual = measured_by(bench.home, document) is not None

    def work(tell: Tell) -> str:
        if not virtual:
            keep_plan(bench.home, document)
            return f"/machines/{name}#planned"
        tell("measured by the flow simulate and ingested; dtwin up shows its run")
        campaign = _measured(bench, name, document)
        tell("compared with the last test of its kind")
        try:
            sheet_changes(bench.home, campaign)
        except InputError:  # The first of its kind, or one without figures: its page shows what it is.
            return f"/campaigns/{campaign}"
        return f"/machines/{name}/changes?campaign={campaign}"

    return accepted(bench.jobs.start(f"Test of {name}", work))


@router.post("/api/machines/{name}/plans/{plan}/drop")
def take_back(bench: Here, name: str, plan: str) -> JSONResponse:
    """Take a plan back."""
    return begun(bench, f"Take back {plan}", f"/machines/{name}#planned", lambda: drop_plan(bench.home, plan))


@router.get("/machines/{name}/changes")
def changes_page(request: Request, bench: Here, name: str, campaign: str = "") -> Response:
    """Show the figures of a test beside those of another one of its kind."""
    other = request.query_params.get("with", "")
    compared = sheet_changes(bench.home, campaign, other, name) if campaign else last_changes(bench.home, name)
    same = [one.name for one in bench.campaigns() if (one.machine, one.kind) == (name, compared["kind"])]
    return rendered(
        request,
        "changes.html",
        title=f"What changed in {name}",
        machine=name,
        found=compared,
        told=changes_text(compared)[1:],
        head=change_table(compared)[0],
        rows=list(zip(compared["figures"], change_table(compared)[1], strict=True)),
        campaigns=same,
    )


def planned_of(bench: Bench, machine: str) -> list[dict[str, Any]]:
    """Return the plans of a machine, each with how its campaign compares with the last one."""
    plans = bench.home.plans
    stamp = tuple(sorted((path.name, path.stat().st_mtime_ns) for path in plans.glob("*.toml")))
    if not stamp:
        return []
    record = read_record(bench.home, machine)
    key = ("planned", machine, stamp, repr(record), *bench.lake_version)
    return bench.cache.get(key, lambda: _compared_plans(bench, machine))


def _compared_plans(bench: Bench, machine: str) -> list[dict[str, Any]]:
    plans = kept_plans(bench.home, machine)
    answered = [one for one in plans if one["answer"]][:_COMPARED]
    for one in answered:
        try:
            one["compared"] = changes_title(sheet_changes(bench.home, one["answer"]))
        except InputError as error:
            one["compared"] = ""
            one["not_compared"] = error.message
    return plans


def _told(query: str) -> tuple[str, dict[str, str]]:
    """Return the kind of a test, empty for that of the last one, and the settings that the address of its form holds."""
    if query.count("&") >= _MOST_SETTINGS:
        raise InputError("more settings than a plan has", code="plan.setting", allowed=f"up to {_MOST_SETTINGS}")
    told = {key: value[:_LONGEST] for key, value in parse_qsl(query, keep_blank_values=True)}
    return told.pop("kind", ""), told


def _files(document: Mapping[str, Any], ending: _Ending) -> Response:
    name = str(document["plan"]["name"])
    if ending == "toml":
        planned_document(document, name)
        return download(tomli_w.dumps(document), f"{name}.toml", "application/toml")
    return download(plans_zip([document]), f"{name}.zip", "application/zip")


def _measured(bench: Bench, machine: str, document: Mapping[str, Any]) -> str:
    """Have the command measure a plan: a flow wants a process of its own. Return the campaign."""
    file = bench.folder / "plans" / f"{secrets.token_hex(8)}.toml"
    make_folder(file.parent)
    write_text(file, tomli_w.dumps(dict(document)), "the plan")
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "dtwin", "machine", "measure", machine, str(file), "--json"],
            env=os.environ | {"DTWIN_HOME": str(bench.home.root)},
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        file.unlink(missing_ok=True)
    if done.returncode != 0:
        raise InputError("the test was not measured", code="plan.measured", where=machine, got=done.stderr[-1500:])
    return str(document["plan"]["name"])


def _field(key: str, typed: str | None, value: Any) -> dict[str, Any]:
    """Return a setting for the form: its name in words, and what stands in its field."""
    suffix = next((end for end in _UNITS if key.endswith(f"_{end}")), "")
    words = key.removesuffix(f"_{suffix}").replace("_", " ") + (f", {shown_unit(_UNITS[suffix])}" if suffix else "")
    listed = isinstance(value, list)
    shown = ", ".join(_plain(part) for part in value) if listed else _plain(value)
    return {"name": key, "label": words, "value": shown if typed is None else typed, "listed": listed}


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _shown(bench: Bench, forecast: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a test would show: effects that are seen at their ordinary size, the others, those hidden, groups alike."""
    sizes = forecast["detectable"] or []

    def words(label: str) -> str:
        return title_of(label, bench.library)

    seen = [{**one, "title": words(one["label"])} for one in sizes if one["amplitude"] is not None]
    return {
        "seen": [one for one in seen if one["amplitude"] <= one["typical"]],
        "larger": [one for one in seen if one["amplitude"] > one["typical"]],
        "hidden": [words(one["label"]) for one in sizes if one["amplitude"] is None],
        "alike": [[words(label) for label in group] for group in forecast["alike"] or []],
    }


_Grid = dict[str, Any]


def grids_of(experiment: Mapping[str, Any] | None) -> list[_Grid]:
    """Return the fewest grids that hold exactly the proposed conditions.

    ``experiment``: ``next_experiment`` of a diagnosis.
    """
    if not experiment or not experiment["conditions"]:
        raise InputError(
            "no run is proposed that could be planned",
            code="experiment.none",
            hint="diagnose the twin; a plan is offered when runs would separate candidates",
        )
    directions: dict[tuple[str, float, float], list[str]] = {}
    for c in experiment["conditions"]:
        place = (c["plane"], c["radius_mm"], c["feed_mm_min"])
        directions.setdefault(place, []).append(c["direction"])
    feeds: dict[tuple[str, float, tuple[str, ...]], list[float]] = {}
    for (plane, radius, feed), ways in directions.items():
        feeds.setdefault((plane, radius, tuple(sorted(ways))), []).append(feed)
    places: dict[tuple[tuple[float, ...], tuple[str, ...]], list[tuple[str, float]]] = {}
    for (plane, radius, ways_), speeds in feeds.items():
        places.setdefault((tuple(sorted(speeds)), ways_), []).append((plane, radius))
    grids: list[_Grid] = []
    for (speeds_, ways_), here in places.items():
        grids += [
            {
                "plane": planes,
                "radius_mm": radii,
                "feed_mm_min": list(speeds_),
                "repeats": int(experiment["repeats"]),
                "directions": list(ways_),
            }
            for planes, radii in _products(here)
        ]
    return grids


def experiment_documents(name: str, machine: str, experiment: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return the content of the plan files of an experiment.

    ``name``, ``machine``: names of the campaign and of the machine.
    ``experiment``: ``next_experiment`` of a diagnosis.
    """
    grids = grids_of(experiment)
    stems = [name] if len(grids) == 1 else [f"{name}-{number}" for number in range(1, len(grids) + 1)]
    return [
        {"plan": {"name": stem, "machine": machine, "seed": 1}, "grid": grid}
        for stem, grid in zip(stems, grids, strict=True)
    ]


def plans_zip(documents: Iterable[Mapping[str, Any]]) -> bytes:
    """Return plan files and the motion programs of each as one archive; ``documents``: what they hold."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for document in documents:
            stem = str(document["plan"]["name"])
            planned = planned_document(document, stem)
            kind = kind_named(planned.kind)
            archive.writestr(f"{stem}.toml", tomli_w.dumps(document))
            control = kind.controls[0] if kind.controls else ""
            for file, text in kind.programs(planned, control).items():
                archive.writestr(f"{stem}/{file}", text)
    return out.getvalue()


def _products(here: list[tuple[str, float]]) -> list[tuple[list[str], list[float]]]:
    planes = sorted({plane for plane, _ in here})
    radii = sorted({radius for _, radius in here})
    if set(here) == set(product(planes, radii)):
        return [(planes, radii)]
    return [([plane], sorted(r for p, r in here if p == plane)) for plane in planes]
