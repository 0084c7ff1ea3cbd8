"""Pages about what was measured, and the way in for new files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response

from dtwin.acquire.amending import amend, leave_out
from dtwin.errors import InputError
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.physics.tone_grid import TONE, tone_row
from dtwin.physics.volumetric.motions import FAMILIES
from dtwin.pipeline.measuring import ingest
from dtwin.report.plots import error_figure, polar_figure, spectrum_figure
from dtwin.schema import Floats, Run
from dtwin.workbench import campaigns
from dtwin.workbench.bench import Bench, bench_of
from dtwin.workbench.jobs import Tell
from dtwin.workbench.pages import accepted, drawn, rendered
from dtwin.workbench.reading import campaign_floor
from dtwin.workbench.uploads import MAX_TRAY_BYTES, sources

router = APIRouter()
_NOISE_QUANTILE = 3.0


class Told(BaseModel):
    """What is told of a table that lies alone; empty fields are not told."""

    machine: str = Field("", max_length=100)
    campaign: str = Field("", max_length=100)
    plane: str = Field("", max_length=10)
    radius_mm: float | None = None
    feed_mm_min: float | None = None
    direction: str = Field("", max_length=10)
    axis: str = Field("", max_length=10)

    def as_dict(self) -> dict[str, Any]:
        """Return what was told, named as in campaign.toml."""
        return {name: value for name, value in self if value not in ("", None)}


class Amendment(BaseModel):
    """What is stated anew of a campaign, or of one run."""

    field: str = Field(max_length=120)
    value: str = Field("", max_length=400)
    run: str = Field("", max_length=100)
    because: str = Field(max_length=500)


class Reason(BaseModel):
    """Why a run is left out, or taken in again."""

    because: str = Field(max_length=500)


@router.get("/campaigns")
def campaign_list(request: Request) -> Response:
    """Show all campaigns."""
    bench = bench_of(request)
    rows = bench.run_rows()
    version = bench.lake_version
    found = bench.cache.get(("overviews", version), lambda: campaigns.overviews(rows))
    return rendered(
        request, "campaigns.html", title="Campaigns", campaigns=found,
        limit_mb=MAX_TRAY_BYTES // 1024**2,
    )  # fmt: skip


@router.get("/campaigns/{name}")
def campaign_page(request: Request, name: str) -> Response:
    """Show a campaign with its runs, and what can be done with it."""
    bench = bench_of(request)
    rows = _rows(bench, name)
    version = bench.lake_version
    overview = bench.cache.get(("overview", name, version), lambda: campaigns.overview(name, rows))
    findings = bench.cache.get(
        ("findings", name, version), lambda: campaigns.grouped_findings(rows)
    )
    rungs = {twin: bench.twins.history(twin) for twin in bench.twin_names()}
    fitted = [twin for twin, found in rungs.items() if found and found[-1]["campaign"] == name]
    return rendered(
        request, "campaign.html", title=f"Campaign {name}", campaign=overview, runs=rows,
        findings=findings, effects=campaigns.possible_effects(rows, bench.library),
        families=FAMILIES.values(), suggested=_free_name(list(rungs), overview.machine), fitted=fitted,
    )  # fmt: skip


@router.get("/campaigns/{name}/runs/{run_id}")
def run_page(request: Request, name: str, run_id: str) -> Response:
    """Show one run."""
    bench = bench_of(request)
    row = _row(bench, name, run_id)
    return rendered(
        request, "run.html", title=f"Run {run_id}", campaign=name, row=row,
        findings=campaigns.findings_of(row),
    )  # fmt: skip


@router.get("/api/campaigns/{name}/runs/{run_id}/{kind}")
def run_figure(request: Request, name: str, run_id: str, kind: str) -> Response:
    """Return a figure of a run: polar, angle, time or spectrum; along a travel or tone ``along``."""
    bench = bench_of(request)
    row = _row(bench, name, run_id)
    key = ("run", name, run_id, row["content_sha256"], row["metadata_version"])
    run = bench.cache.get(key, lambda: bench.lake.load(row, signals=False))
    if kind == "along":
        return drawn(_along(run))
    angle, left = _centred(run)
    curves = {run_id: (angle, left)}
    title = f"{run_id}: error after centre and radius"
    if kind == "spectrum":
        return drawn(_spectrum(run_id, left, run.meta.sample_rate_hz))
    floor_um = campaign_floor(bench, name).um
    if kind == "polar":
        radius = float(run.meta.radius_mm or 100.0)
        return drawn(polar_figure(curves, radius, title=title, floor_um=floor_um))
    if kind == "time":
        curves = {run_id: (np.asarray(run.samples["t_s"], float)[_window(run)], left)}
        return drawn(error_figure(curves, title=title, floor_um=floor_um, x_title="time, s"))
    return drawn(error_figure(curves, title=title, floor_um=floor_um))


@router.post("/api/trays")
def new_tray(request: Request) -> dict[str, str]:
    """Open a tray for files."""
    return {"tray": bench_of(request).trays.new()}


@router.put("/api/trays/{tray}")
async def receive(request: Request, tray: str, name: str) -> JSONResponse:
    """Take one file into a tray."""
    size = await bench_of(request).trays.receive(tray, name, request.stream())
    return JSONResponse({"bytes": size})


@router.post("/api/trays/{tray}/ingest")
async def ingest_tray(request: Request, tray: str, told: Told | None = None) -> JSONResponse:
    """Ingest what a tray holds."""
    bench = bench_of(request)
    trays = bench.trays
    folder = trays.folder(tray)

    def work(tell: Tell) -> str:
        try:
            return _ingested(bench, folder, {} if told is None else told.as_dict(), tell)
        finally:
            trays.drop(tray)

    return accepted(await run_in_threadpool(bench.jobs.start, "Ingest", work))


@router.post("/api/campaigns/{name}/amend")
def amend_campaign(request: Request, name: str, wanted: Amendment) -> JSONResponse:
    """State anew what was stated wrongly; raw values never change."""
    bench = bench_of(request)
    bench.lake.campaign(name)

    def work(tell: Tell) -> str:
        tell("judge the runs again")
        runs = [wanted.run] if wanted.run else []
        amend(bench.lake, name, [f"{wanted.field}={wanted.value}"], wanted.because, runs=runs)
        return f"/campaigns/{name}"

    return accepted(bench.jobs.start(f"Amend {name}", work))


@router.post("/api/campaigns/{name}/runs/{run_id}/{verb}")
def leave_run_out(
    request: Request, name: str, run_id: str, verb: Literal["leave-out", "restore"], why: Reason
) -> JSONResponse:
    """Leave a run out of every figure, twin and report, or take it in again."""
    bench = bench_of(request)
    _row(bench, name, run_id)

    def work(tell: Tell) -> str:
        tell("keep the record")
        leave_out(bench.lake, name, [run_id], why.because, out=verb == "leave-out")
        return f"/campaigns/{name}"

    return accepted(bench.jobs.start(f"{verb} {run_id}", work))


def _ingested(bench: Bench, folder: Path, told: Mapping[str, Any], tell: Tell) -> str:
    tell("look at the files")
    names = []
    for source in sources(folder):

        def count(done: int, total: int, what: str, source: Path = source) -> None:
            tell(f"{source.name}: {done} of {total} files")

        alone = told if source.suffix.lower() in (".csv", ".parquet") else None
        names.append(ingest(source, bench.home, count, alone).campaign)
    for name in dict.fromkeys(names):
        tell(f"prepare the pages of {name}")
        campaign_floor(bench, name)
    return f"/campaigns/{names[0]}" if len(set(names)) == 1 else "/campaigns"


def _rows(bench: Bench, name: str) -> list[Any]:
    rows = [row for row in bench.run_rows() if row["campaign"] == name]
    if not rows:
        bench.lake.campaign(name)
    return rows


def _row(bench: Bench, name: str, run_id: str) -> Any:
    for row in _rows(bench, name):
        if row["run_id"] == run_id:
            return row
    raise InputError(
        "no such run in the campaign", code="page.unknown", where=name, got=run_id[:100]
    )


def _window(run: Run) -> slice:
    return slice(*run.window) if run.window is not None else slice(None)


def _centred(run: Run) -> tuple[Floats, Floats]:
    window = _window(run)
    if not {"angle_deg", "deviation_um"} <= set(run.samples):
        raise InputError(
            "only runs of circular tests are drawn here",
            code="run.kind",
            where=run.meta.run_id,
            got=run.meta.kind,
            allowed="circular",
        )
    angle = np.asarray(run.samples["angle_deg"], float)[window]
    deviation = np.asarray(run.samples["deviation_um"], float)[window]
    radius = float(run.meta.radius_mm or 100.0)
    return angle, residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))


def _along(run: Run) -> Any:
    """Draw a sweep over its positions, and a tone over the phase of its command."""
    title = f"{run.meta.run_id}: error as measured"
    if run.meta.kind == "sinusoidal":
        reduced = tone_row(run, 0.0)
        curves = {"tool minus command": (TONE.points, reduced.y_um)}
        return error_figure(curves, title=title, x_title="phase of the command, deg")
    if not {"position_mm", "direction", "error_um"} <= set(run.samples):
        raise InputError(
            "this run has no error over a path", code="run.kind", where=run.meta.run_id,
            got=run.meta.kind, allowed="linear, sinusoidal",
        )  # fmt: skip
    position, error = (np.asarray(run.samples[n], float) for n in ("position_mm", "error_um"))
    ways = np.asarray(run.samples["direction"])
    curves = {str(way): (position[ways == way], error[ways == way]) for way in np.unique(ways)}
    return error_figure(curves, title=title, x_title="position, mm")


def _spectrum(run_id: str, left_um: Floats, rate_hz: float) -> Any:
    n = left_um.size
    window = np.hanning(n)
    amplitude = 2.0 * np.abs(np.fft.rfft((left_um - left_um.mean()) * window)) / window.sum()
    # Lines of noise alone are Rayleigh distributed; the median is not moved by a few true lines.
    upper = amplitude[n // 4 :]
    floor = _NOISE_QUANTILE * float(np.median(upper)) / float(np.sqrt(np.log(4.0)))
    return spectrum_figure(
        np.asarray(np.fft.rfftfreq(n, 1.0 / rate_hz), dtype=np.float64), amplitude, floor,
        title=f"{run_id}: spectrum of one run (its upper half gives the noise; one run has no "
        "repeats)",
    )  # fmt: skip


def _free_name(taken: list[str], machine: str) -> str:
    number = 1
    while (name := machine if number == 1 else f"{machine}-{number}") in taken:
        number += 1
    return name
