"""Pages about what was measured, and the way in for new files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import HTMLResponse, JSONResponse, Response

from dtwin.acquire.amending import amend, leave_out
from dtwin.errors import InputError
from dtwin.kinds.kind import Drawing
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import campaign_of
from dtwin.pipeline.campaign_certificate import certificate
from dtwin.pipeline.home_catalogue import overview
from dtwin.pipeline.kept import findings_of, grouped_findings
from dtwin.report.pdf import pdf_of
from dtwin.report.sheet import budget_rows, notes_beside
from dtwin.schema import Run, fresh_name
from dtwin.workbench._bench import Bench, Here, possible_effects
from dtwin.workbench._pages import begun, download, drawn, in_language, rendered
from dtwin.workbench._reading import campaign_floor, campaign_sheet_of
from dtwin.workbench._uploads import MAX_TRAY_BYTES

router = APIRouter()
_ON_A_PAGE = 100
_SHUT_OFF = (
    "sandbox allow-scripts allow-modals; default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "img-src data: blob:"
)


class _Amendment(BaseModel):
    """What is stated anew of a campaign, or of one run."""

    field: str = Field(max_length=120)
    value: str = Field("", max_length=400)
    run: str = Field("", max_length=100)
    because: str = Field(max_length=500)


class _Reason(BaseModel):
    """Why a run is left out, or taken in again."""

    because: str = Field(max_length=500)


@router.get("/campaigns")
def campaign_list(request: Request, bench: Here, find: str = "", page: int = 1) -> Response:
    """Show campaigns, so many on a page; ``find`` is a part of their name, machine or kind."""
    every, wanted = bench.campaigns(), find.strip().casefold()
    matching = (
        [one for one in every if wanted in f"{one.name} {one.machine} {one.kind}".casefold()] if wanted else every
    )
    pages = max(-(-len(matching) // _ON_A_PAGE), 1)
    page = min(max(page, 1), pages)
    return rendered(
        request,
        "campaigns.html",
        title="Campaigns",
        campaigns=matching[(page - 1) * _ON_A_PAGE : page * _ON_A_PAGE],
        find=find,
        page=page,
        pages=pages,
        found=len(matching),
        there=len(every),
        limit_mb=MAX_TRAY_BYTES // 1024**2,
    )


@router.get("/campaigns/{name}")
def campaign_page(request: Request, bench: Here, name: str, part: int | None = None) -> Response:
    """Show a campaign: its test sheet, its runs, and what can be done with it."""
    rows = bench.run_rows(name)
    version = bench.lake_version
    line = bench.cache.get(("overview", name, version), lambda: overview(name, rows))
    twins = bench.twin_lines()
    kind = kind_named(line.kind)
    paths = kind.offers("rows")
    sheet = campaign_sheet_of(bench, name, line.machine) if kind.offers("sheet") else None
    together = sheet["findings"] if sheet else []
    findings = bench.cache.get(("findings", name, version), lambda: grouped_findings(rows, together))
    if part is None:
        part = _worst_part(sheet)
    shown = sheet["parts"][part] if sheet and 0 <= part < len(sheet["parts"]) else None
    return rendered(
        request,
        "campaign.html",
        title=f"Campaign {name}",
        campaign=line,
        runs=rows,
        findings=findings,
        worst=_worst_of(findings),
        kind=kind,
        instrument=campaign_of(rows).instrument,
        sheet=sheet,
        notes=notes_beside(sheet) if sheet else [],
        part=part,
        shown=shown,
        budgets=[(c, budget_rows(c)) for c in (shown or {}).get("characteristics", ()) if c.get("budget")],
        paths=paths,
        effects=possible_effects(rows, bench.library) if paths else kind.effects.values(),
        suggested=fresh_name(line.machine, [twin.name for twin in twins]),
        fitted=[twin.name for twin in twins if name in twin.campaigns],
    )


def _worst_of(findings: Sequence[Mapping[str, Any]]) -> str:
    """Return the worst severity of findings, empty where the data are sound."""
    return next((s for s in ("error", "warning") if any(f["severity"] == s for f in findings)), "")


def _worst_part(sheet: Mapping[str, Any] | None) -> int:
    """Return the condition that decided on the whole sheet; the first where nothing is decided."""
    verdicts = [one["verdict"] for one in (sheet or {}).get("parts", ())]
    return verdicts.index(sheet["verdict"]) if sheet and sheet["verdict"] in verdicts else 0


@router.get("/api/campaigns/{name}/sheet/{part}")
def sheet_figure(bench: Here, name: str, part: int) -> Response:
    """Return the picture of one condition of the test sheet."""
    rows = bench.run_rows(name)
    kind = kind_named(rows[0]["kind"])
    parts = campaign_sheet_of(bench, name, rows[0]["machine"])["parts"]
    if not 0 <= part < len(parts):
        raise InputError("there is no such condition", code="page.unknown", where=name, got=str(part))
    wanted = set(parts[part]["runs"])
    runs = [bench.lake.load(row, signals=False) for row in rows if row["run_id"] in wanted]
    return drawn(kind.sheet_figure(runs))


@router.get("/campaigns/{name}/certificate.{ending}")
def certificate_file(bench: Here, name: str, ending: Literal["html", "pdf"], language: str = "en") -> Response:
    """Return the certificate of a campaign, to sign: as a page, or printed.

    Its scripts stand in the page, which is shut off from the workbench: another origin, and no requests.
    """
    made = certificate(bench.home, name, language)
    if ending == "pdf":
        return download(pdf_of(made), f"{in_language(name, language)}.pdf", "application/pdf")
    return HTMLResponse(made, headers={"Content-Security-Policy": _SHUT_OFF})


@router.get("/campaigns/{name}/runs/{run_id}")
def run_page(request: Request, bench: Here, name: str, run_id: str) -> Response:
    """Show one run."""
    row = _row(bench, name, run_id)
    kind = kind_named(row["kind"])
    sheet = campaign_sheet_of(bench, name, row["machine"]) if kind.offers("sheet") else {"parts": []}
    part = next((n for n, one in enumerate(sheet["parts"]) if run_id in one["runs"]), -1)
    findings = findings_of(row)
    return rendered(
        request,
        "run.html",
        title=f"Run {run_id}",
        campaign=name,
        row=row,
        kind=kind,
        findings=findings,
        worst=_worst_of(findings),
        suggested=fresh_name(row["machine"], [twin.name for twin in bench.twin_lines()]),
        sheet=sheet,
        notes=notes_beside(sheet) if part >= 0 else [],
        part=part,
        shown=sheet["parts"][part] if part >= 0 else None,
        drawings=_drawings_of(bench, name, row, in_sheet=part >= 0),
    )


@router.get("/api/campaigns/{name}/runs/{run_id}/{figure}")
def run_figure(bench: Here, name: str, run_id: str, figure: str) -> Response:
    """Return a figure of a run: one of the drawings of its kind."""
    row = _row(bench, name, run_id)
    drawings = {drawing.name: drawing for drawing in kind_named(row["kind"]).drawings}
    if figure not in drawings:
        raise InputError(
            "there is no such figure of the run",
            code="page.unknown",
            where=run_id,
            got=figure[:40],
            allowed=", ".join(drawings),
        )
    return drawn(drawings[figure].draw(_run_of(bench, name, row), lambda: campaign_floor(bench, name).um))


def _drawings_of(bench: Bench, name: str, row: Mapping[str, Any], *, in_sheet: bool) -> list[Drawing]:
    """Return the pictures of a run that its page shows beside that of its test sheet."""
    kind = kind_named(row["kind"])
    every = kind.drawings if kind.offers("drawings") else ()
    beside = [d for d in every if not (in_sheet and d.in_sheet)]
    return [d for d in beside if d.fits is None or d.fits(_run_of(bench, name, row))]


def _run_of(bench: Bench, name: str, row: Mapping[str, Any]) -> Run:
    key = ("run", name, row["run_id"], row["content_sha256"], row["metadata_version"])
    return bench.cache.get(key, lambda: bench.lake.load(row, signals=False))


@router.post("/api/campaigns/{name}/amend")
def amend_campaign(bench: Here, name: str, wanted: _Amendment) -> JSONResponse:
    """State anew what was stated wrongly; raw values never change."""
    bench.lake.campaign(name)
    stated, runs = [f"{wanted.field}={wanted.value}"], [wanted.run] if wanted.run else []
    change = partial(amend, bench.lake, name, stated, wanted.because, runs=runs)
    return begun(bench, f"Amend {name}", f"/campaigns/{name}", change, "judge the runs again")


@router.post("/api/campaigns/{name}/runs/{run_id}/{verb}")
def leave_run_out(
    bench: Here, name: str, run_id: str, verb: Literal["leave-out", "restore"], why: _Reason
) -> JSONResponse:
    """Leave a run out of every figure, twin and report, or take it in again."""
    _row(bench, name, run_id)
    change = partial(leave_out, bench.lake, name, [run_id], why.because, out=verb == "leave-out")
    return begun(bench, f"{verb} {run_id}", f"/campaigns/{name}", change, "keep the record")


def _row(bench: Bench, name: str, run_id: str) -> Any:
    for row in bench.run_rows(name):
        if row["run_id"] == run_id:
            return row
    raise InputError("no such run in the campaign", code="page.unknown", where=name, got=run_id[:100])
