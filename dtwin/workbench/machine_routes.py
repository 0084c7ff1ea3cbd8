"""Pages about machines: what is known of each, its tests over time, and what happened to it."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.machine_record import EVENTS, MachineRecord, read_record, record_from, with_event, write_record
from dtwin.pipeline.machine_history import machine_history, machine_overviews
from dtwin.report.history_plots import history_figure
from dtwin.workbench.bench import Bench, bench_of
from dtwin.workbench.pages import accepted, drawn, rendered
from dtwin.workbench.reading import campaign_sheet_of
from dtwin.workbench.uploads import MAX_TRAY_BYTES

router = APIRouter()


class EventTold(BaseModel):
    """What happened; an empty day is today."""

    what: str = Field(max_length=40)
    on: str = Field("", max_length=10)
    note: str = Field("", max_length=400)


class ToleranceTold(BaseModel):
    """The largest value that a figure may have, in µm."""

    symbol: str = Field(max_length=40)
    high_um: float


@router.get("/machines")
def machine_list(request: Request) -> Response:
    """Show all machines; what their tests say is filled in afterwards, for it may take long the first time."""
    found = machine_overviews(bench_of(request).home)
    return rendered(request, "machines.html", title="Machines", machines=found, limit_mb=MAX_TRAY_BYTES // 1024**2)


@router.get("/machines/{name}")
def machine_page(request: Request, name: str) -> Response:
    """Show one machine."""
    found = _history(bench_of(request), name)
    return rendered(request, "machine.html", title=f"Machine {name}", machine=found, known_events=EVENTS)


@router.get("/api/machines/{name}/summary")
def summary(request: Request, name: str) -> dict[str, Any]:
    """Return what the last test of a machine says, and its values so far."""
    tests = [test for test in _history(bench_of(request), name)["tests"] if test["figure"]]
    last = tests[-1] if tests else None
    values = [test["value_um"] for test in tests if last is not None and test["figure"] == last["figure"]]
    return {"last": None if last is None else {**last, "sheet": None}, "values_um": values}


@router.get("/api/machines/{name}/history")
def history(request: Request, name: str) -> Response:
    """Return the picture of a machine's tests over time."""
    found = _history(bench_of(request), name)
    return drawn(history_figure(found["tests"], found["events"]))


@router.post("/api/machines/{name}/event")
def tell_event(request: Request, name: str, told: EventTold) -> JSONResponse:
    """Note what happened to a machine."""
    bench = bench_of(request)
    _history(bench, name)

    def work(tell: Any) -> str:
        with_event(bench.home, name, told.what, told.on, told.note)
        return f"/machines/{name}"

    return accepted(bench.jobs.start(f"Note for {name}", work))


@router.post("/api/machines/{name}/tolerance")
def tell_tolerance(request: Request, name: str, told: ToleranceTold) -> JSONResponse:
    """State the largest value that a figure may have."""
    bench = bench_of(request)
    known = read_record(bench.home, name) or MachineRecord(name)
    document = known.as_dict()
    document["tolerances"] |= {told.symbol: told.high_um}
    record = record_from(name, document, name)

    def work(tell: Any) -> str:
        write_record(bench.home, record)
        return f"/machines/{name}"

    return accepted(bench.jobs.start(f"Tolerance of {name}", work))


def _history(bench: Bench, name: str) -> dict[str, Any]:
    return machine_history(bench.home, name, sheet_of=lambda campaign: campaign_sheet_of(bench, campaign, name))
