"""Pages about machines: what is known of each, its tests over time, and what happened to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from typing import Any, Literal

import tomli_w
from fastapi import APIRouter, Request
from pydantic import BaseModel, Field
from starlette.responses import JSONResponse, Response

from dtwin.errors import InputError
from dtwin.kinds.registry import kinds
from dtwin.machine_record import EVENTS, FACTS, keep_record, record_with, with_event, without_event
from dtwin.pipeline.home_catalogue import outlines
from dtwin.pipeline.machine_history import drop_machine, machine_overviews, other_series
from dtwin.pipeline.machine_joint import is_compared, machine_joint
from dtwin.pipeline.machine_next import machine_next
from dtwin.pipeline.machine_report import machine_report, overdue, until
from dtwin.pipeline.machine_series import SORTED_BY, TESTS_PER_FALSE_ALARM, by_size, calendar_of, worst_newest
from dtwin.progress import Tell
from dtwin.report.faults import title_of
from dtwin.report.history_plots import chart_figure, series_figure
from dtwin.report.pdf import pdf_of
from dtwin.units import shown_unit
from dtwin.workbench._bench import Bench, Here
from dtwin.workbench._pages import accepted, begun, download, drawn, in_language, rendered
from dtwin.workbench._plan_routes import planned_of, plans_zip
from dtwin.workbench._uploads import MAX_TRAY_BYTES

router = APIRouter()
_TITLES = {"together": "Tests of {} together", "next": "Next test of {}"}


class _EventTold(BaseModel):
    """What happened; an empty day is today."""

    what: str = Field(max_length=40)
    on: str = Field("", max_length=10)
    note: str = Field("", max_length=400)


class _NotedEvent(_EventTold):
    """An event as it is noted; a command may have noted more than the page takes."""

    note: str = Field("", max_length=2000)


class _FactsTold(BaseModel):
    """What is known of a machine; what is empty is not known."""

    type: str = Field("", max_length=2000)
    serial: str = Field("", max_length=2000)
    chain: str = Field("", max_length=2000)
    controller: str = Field("", max_length=2000)
    instruments: str = Field("", max_length=2000)
    notes: str = Field("", max_length=2000)


class _MachineTold(_FactsTold):
    """A machine that has no test yet."""

    machine: str = Field(max_length=128)


class _AxisTold(BaseModel):
    """An axis with lengths in mm; None where one is not known, and an axis without any is taken back."""

    axis: str = Field(max_length=8, pattern=r"^[A-Za-z0-9]+$")
    travel_mm: float | None = None
    pitch_mm: float | None = None
    low_mm: float | None = None
    high_mm: float | None = None


class _SymbolTold(BaseModel):
    """A figure of a test sheet."""

    symbol: str = Field(max_length=40)


class _ToleranceTold(_SymbolTold):
    """The largest value that a figure may have, in µm."""

    high_um: float


class _ScheduleTold(BaseModel):
    """Days between two tests; 0 takes a schedule back."""

    days: float


@router.get("/machines")
def machine_list(request: Request, bench: Here) -> Response:
    """Show all machines; what their tests say is filled in afterwards, for it may take long the first time."""
    read = bench.campaigns_soon()
    named = outlines(bench.home) if read is None else read
    return rendered(
        request,
        "machines.html",
        title="Machines",
        machines=machine_overviews(bench.home, named, bench.twin_lines()),
        unread=0 if read is not None else len(named),
        limit_mb=MAX_TRAY_BYTES // 1024**2,
    )


@router.get("/api/machines")
def last_tests(bench: Here) -> dict[str, str]:
    """Return the day of the last test of every machine, empty where none is stated, once all campaigns are read."""
    every = machine_overviews(bench.home, bench.campaigns(), bench.twin_lines())
    return {one["machine"]: one["last_test"] for one in every}


@router.get("/machines/{name}")
def machine_page(request: Request, bench: Here, name: str) -> Response:
    """Show one machine."""
    history = bench.history(name)
    return rendered(
        request,
        "machine.html",
        title=f"Machine {name}",
        machine=history,
        changes=by_size(history["series"]),
        sorted_by=SORTED_BY,
        overdue=overdue(history),
        until=until,
        figures=_figures_of(history),
        false_alarms=TESTS_PER_FALSE_ALARM,
        known_events=EVENTS,
        known_facts=FACTS,
        plans=planned_of(bench, name),
        with_twins=[kind.name for kind in kinds() if kind.offers("twins")],
    )


def _figures_of(history: Mapping[str, Any]) -> list[str]:
    """Return the figures that may have a tolerance: of the kinds that were measured, of all where none was."""
    measured = {test["kind"] for test in history["tests"]}
    every = [kind.figures for kind in kinds() if not measured or kind.name in measured]
    return list(dict.fromkeys(symbol for figures in every for symbol in figures))


@router.get("/machines/{name}/report.{ending}")
def report(bench: Here, name: str, ending: Literal["html", "pdf"], language: str = "en") -> Response:
    """Return what is known of a machine and what its tests say over time, as one file that needs nothing else."""
    made, file = machine_report(bench.history(name), language), f"{in_language(name, language)}.{ending}"
    return download(made, file, "text/html") if ending == "html" else download(pdf_of(made), file, "application/pdf")


@router.post("/api/machines/{name}/together")
def compare_tests(bench: Here, name: str) -> JSONResponse:
    """Diagnose the newest test of each sort and compare them."""
    return _worked_out(bench, name, "together", machine_joint)


@router.post("/api/machines/{name}/next")
def find_next(bench: Here, name: str) -> JSONResponse:
    """Diagnose the newest test of each sort and find which test tells most after them."""
    return _worked_out(bench, name, "next", machine_next)


@router.get("/machines/{name}/together")
def together(request: Request, bench: Here, name: str) -> Response:
    """Show what the tests of a machine say together."""
    if not is_compared(bench.home, name, bench.library):
        return _not_diagnosed(request, name, "together")
    diagnosis = machine_joint(bench.home, name, library=bench.library)
    groups = {t["campaign"]: [[title_of(n, bench.library) for n in g] for g in t["found"]] for t in diagnosis["tests"]}
    title = _TITLES["together"].format(name)
    return rendered(request, "together.html", title=title, machine=name, found=diagnosis, groups=groups)


@router.get("/machines/{name}/next")
def next_page(request: Request, bench: Here, name: str) -> Response:
    """Show which test tells most for its time."""
    if not is_compared(bench.home, name, bench.library):
        return _not_diagnosed(request, name, "next")
    advice = machine_next(bench.home, name, library=bench.library)
    of_cause: dict[str, list[str]] = {}
    for effect in bench.library.values():
        of_cause.setdefault((effect.cause or effect.name).replace("_", " "), []).append(effect.name)
    # A cause that several effects share has no page.
    pages = {cause: names[0] for cause, names in of_cause.items() if len(names) == 1}
    named = [
        (line, max((c for c in pages if f"{line} ".startswith(f"{c} ")), key=len, default=""))
        for line in advice["untold"]
    ]
    untold = [(line, pages.get(cause, "")) for line, cause in named]
    return rendered(request, "next.html", title=_TITLES["next"].format(name), found=advice, untold=untold)


@router.get("/machines/{name}/next/{test}.{ending}")
def next_files(bench: Here, name: str, test: str, ending: Literal["toml", "zip"]) -> Response:
    """Return a proposed test as its plan file, or as plan file and programs."""
    tests = machine_next(bench.home, name, library=bench.library)["tests"]
    document = next((t["document"] for t in tests if t["name"] == test), None)
    if document is None:
        raise InputError(
            "no such test is proposed", code="page.unknown", where=name, got=test, hint="names hold the day: look again"
        )
    if ending == "toml":
        return download(tomli_w.dumps(document), f"{test}.toml", "application/toml")
    return download(plans_zip([document]), f"{test}.zip", "application/zip")


@router.get("/machines/{name}/next-test.ics")
def next_test_file(bench: Here, name: str) -> Response:
    """Return the next test as a calendar file."""
    due = bench.history(name)["next_test"]
    if not due:
        raise InputError("no next test is known", code="page.unknown", where=name, hint="state how often it is tested")
    return download(calendar_of(name, due, datetime.now(UTC)), f"{name}.ics", "text/calendar")


@router.get("/api/machines/{name}/summary")
def summary(bench: Here, name: str) -> dict[str, Any]:
    """Return the worst of the tests of a machine that no later one repeats, its values so far, what else its list shows."""
    history = bench.history(name)
    worst = worst_newest(history["tests"])
    points = [
        one["points"]
        for one in history["series"]
        if worst and (one["figure"], one["title"]) == (worst["figure"], worst["condition"])
    ]
    newest = [{"changes": one["changes"][:1]} for one in history["series"] if one["state"] in ("changed", "trend")]
    current = [change["text"] for change in by_size(newest)]
    return {
        "worst": worst,
        "values": [point["value"] for point in points[0]] if points else [],
        "unit": shown_unit(worst["unit"]) if worst else "",
        "changed": current[0] if current else "",
        "overdue": overdue(history),
        "champion": history["champion"],
    }


@router.get("/api/machines/{name}/series")
def series(bench: Here, name: str, of: str) -> Response:
    """Return the picture of a figure over time."""
    history = bench.history(name)
    if of in history["others"]:
        others, *_ = other_series(bench.home, history, of)
        return drawn(series_figure(others, history["events"]))
    return drawn(series_figure(_series(history, of), history["events"]))


@router.get("/api/machines/{name}/chart")
def control_chart(bench: Here, name: str, of: str) -> Response:
    """Return the control chart of a figure."""
    return drawn(chart_figure(_series(bench.history(name), of)))


@router.post("/api/machines/{name}/event")
def tell_event(bench: Here, name: str, told: _EventTold) -> JSONResponse:
    """Note what happened to a machine."""
    return _noted(bench, name, "Note for", with_event, told)


@router.post("/api/machines/{name}/event/drop")
def drop_event(bench: Here, name: str, told: _NotedEvent) -> JSONResponse:
    """Take back the note of an event."""
    return _noted(bench, name, "Note taken back for", without_event, told)


@router.post("/api/machines")
def add_machine(bench: Here, told: _MachineTold) -> JSONResponse:
    """Add a machine before its first test; one that is there keeps what is known of it."""
    facts = {key: value for key, value in told.model_dump(exclude={"machine"}).items() if value}
    return _stated(bench, told.machine, "Record", facts)


@router.post("/api/machines/{name}/facts")
def tell_facts(bench: Here, name: str, told: _FactsTold) -> JSONResponse:
    """State what is known of a machine; what is not in the request stays."""
    return _stated(bench, name, "Record", told.model_dump(exclude_unset=True))


@router.post("/api/machines/{name}/drop")
def drop(bench: Here, name: str) -> JSONResponse:
    """Delete a machine that was not measured."""
    bench.history(name)
    return begun(bench, f"Remove {name}", "/machines", lambda: drop_machine(bench.home, name))


@router.post("/api/machines/{name}/axis")
def tell_axis(bench: Here, name: str, told: _AxisTold) -> JSONResponse:
    """State what is known of an axis, or take it back."""
    known = told.model_dump(exclude={"axis"}, exclude_none=True)
    return _stated(bench, name, f"Axis {told.axis}", {"axes": {told.axis: known or None}})


@router.post("/api/machines/{name}/tolerance/drop")
def drop_tolerance(bench: Here, name: str, told: _SymbolTold) -> JSONResponse:
    """Take back what is stated of a figure."""
    return _stated(bench, name, "Tolerance taken back", {"tolerances": {told.symbol: None}})


@router.post("/api/machines/{name}/tolerance")
def tell_tolerance(bench: Here, name: str, told: _ToleranceTold) -> JSONResponse:
    """State the largest value that a figure may have."""
    return _stated(bench, name, "Tolerance", {"tolerances": {told.symbol: told.high_um}})


@router.post("/api/machines/{name}/schedule")
def tell_schedule(bench: Here, name: str, told: _ScheduleTold) -> JSONResponse:
    """State how often a machine is tested."""
    return _stated(bench, name, "Tests", {"test_every_days": told.days})


def _worked_out(bench: Bench, name: str, what: str, make: Callable[..., Any]) -> JSONResponse:
    """Do what takes a diagnosis of each test as work of its own, and go to its page; of no machine there is none."""
    bench.history(name)

    def work(tell: Tell) -> str:
        tell("diagnose the newest test of each sort")
        make(bench.home, name, library=bench.library, progress=lambda done, total, of: tell(f"{done} of {total}, {of}"))
        return f"/machines/{name}/{what}"

    return accepted(bench.jobs.start(_TITLES[what].format(name), work))


def _not_diagnosed(request: Request, name: str, what: str) -> Response:
    """Offer to diagnose the newest tests, for a page that says what they find."""
    return rendered(request, "undiagnosed.html", title=_TITLES[what].format(name), machine=name, what=what)


def _stated(bench: Bench, name: str, what: str, stated: Mapping[str, Any]) -> JSONResponse:
    """Write the record of a machine with what is stated; tables are joined."""
    # What is not usable is refused at once; the work before this one may change the record still.
    record_with(bench.home, name, stated)
    return begun(bench, f"{what} of {name}", f"/machines/{name}", lambda: keep_record(bench.home, name, stated))


def _noted(
    bench: Bench, name: str, title: str, change: Callable[..., object], told: _EventTold | _NotedEvent
) -> JSONResponse:
    bench.history(name)
    note = partial(change, bench.home, name, told.what, told.on, told.note)
    return begun(bench, f"{title} {name}", f"/machines/{name}", note)


def _series(history: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    chosen: Mapping[str, Any] | None = next((one for one in history["series"] if one["name"] == name), None)
    if chosen is None:
        raise InputError("there is no such figure", code="page.unknown", where=history["machine"], got=name[:80])
    return chosen
