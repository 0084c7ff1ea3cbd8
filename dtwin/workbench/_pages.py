"""Templates, figures and errors as answers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

import plotly.graph_objects as go
from fastapi import Request
from jinja2 import Environment, PackageLoader
from starlette.responses import HTMLResponse, JSONResponse, Response

from dtwin import __version__
from dtwin.errors import DtwinError, GateRefusal
from dtwin.local_time import local_time
from dtwin.pipeline.machine_report import tolerance_words
from dtwin.progress import Tell
from dtwin.report.faults import grouped, in_titles, title_of
from dtwin.report.pdf import browser
from dtwin.report.text import VERDICTS, gain_words, micrometres
from dtwin.report.twins import condition_words, number, place_words
from dtwin.twins.diagnosing_code import is_of_other_code
from dtwin.units import is_number, shown_setting, shown_unit
from dtwin.workbench._access import NEEDED, OTHERWISE
from dtwin.workbench._bench import Bench, bench_of
from dtwin.workbench._jobs import Job

_UNKNOWN = ("campaign.unknown", "twin.unknown", "twin.version", "machine.unknown", "page.unknown", "model.unknown")


def when(text: str | None, seconds: bool = False) -> str:
    """Return an ISO 8601 time to the minute, or to the second, by this computer's clock."""
    return local_time(text or "").replace("T", " ")[: 19 if seconds else 16] or "not stated"


def zone() -> str:
    """Return the zone of this computer's clock, for example ``UTC+01:00``."""
    return f"UTC{datetime.now().astimezone().isoformat()[-6:]}".removesuffix("+00:00")


def um(value: float | None) -> str:
    """Return micrometres for people; a dash when not known."""
    return "\u2013" if value is None or not math.isfinite(value) else micrometres(value)


def stated(row: Mapping[str, Any]) -> str:
    """Return the conditions of a run that is no circle, for example ``axis Z, frequency 5 Hz``."""
    condition = json.loads(row["condition_json"])
    words = (
        shown_setting(name, number(value, 6) if is_number(value) else str(value)) for name, value in condition.items()
    )
    return ", ".join(words) or "not stated"


_ENVIRONMENT = Environment(
    loader=PackageLoader("dtwin.workbench"), autoescape=True, trim_blocks=True, lstrip_blocks=True
)
# A page compares what it was made of with what it asks for, and is loaded anew where they differ: in one order.
_ENVIRONMENT.policies["json.dumps_kwargs"] = {"sort_keys": False}
_ENVIRONMENT.filters |= {
    "when": when,
    "um": um,
    "gain": gain_words,
    "plain": number,
    "condition": condition_words,
    "place": place_words,
    "stated": stated,
    "unit": shown_unit,
    "grouped": grouped,
    "titled": title_of,
    "in_titles": in_titles,
}
_ENVIRONMENT.globals |= {
    "tolerance_words": tolerance_words,
    "is_of_other_code": is_of_other_code,
    "version": __version__,
    "verdict_words": VERDICTS,
    "zone": zone,
    "browser": browser,
}


def rendered(request: Request, template: str, status: int = 200, **context: Any) -> HTMLResponse:
    """Return a page. ``context``: what the template shows; everything is escaped."""
    bench = bench_of(request)
    text = _ENVIRONMENT.get_template(template).render(
        allowed=request.state.allowed,
        may=request.state.may,
        needed=[*NEEDED, ("", OTHERWISE)],
        path=request.url.path,
        home=str(bench.home.root),
        shared=bench.access.shared,
        jobs=bench.jobs.unfinished(),
        library=bench.twins.library,
        **context,
    )
    return HTMLResponse(text, status)


def drawn(figure: go.Figure) -> Response:
    """Return a figure for the page's script."""
    return Response(figure.to_json(), media_type="application/json")


def in_language(stem: str, language: str) -> str:
    """Return the name of a file without its ending: those in both languages lie beside each other."""
    return stem if language == "en" else f"{stem}-{language}"


def download(content: str | bytes, name: str, kind: str) -> Response:
    """Return a file to keep."""
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=kind, headers=headers)


def accepted(job: Job) -> JSONResponse:
    """Return where to ask for the progress of a job."""
    return JSONResponse({"job": job.id}, 202)


def begun(bench: Bench, title: str, address: str, do: Callable[[], object], said: str = "") -> JSONResponse:
    """Queue work that leads to an address, and return where to ask for its progress; ``said``: its stage."""

    def work(tell: Tell) -> str:
        if said:
            tell(said)
        do()
        return address

    return accepted(bench.jobs.start(title, work))


def refused(request: Request, error: DtwinError) -> Response:
    """Return an error as the command line words it."""
    status = 404 if error.code in _UNKNOWN else 409 if isinstance(error, GateRefusal) else 400
    if request.url.path.startswith("/api/"):
        return JSONResponse({"error": error.as_dict(), "text": error.render()}, status)
    return rendered(request, "error.html", status, text=error.render(), title="That did not work")
