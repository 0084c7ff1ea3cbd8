"""The application, and the server that it runs in."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import threading
from asyncio import CancelledError
from collections.abc import Callable
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import h11
import numpy as np
import uvicorn
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from plotly.offline import get_plotlyjs
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response
from uvicorn.protocols.http.h11_impl import H11Protocol

from dtwin.config import Home
from dtwin.errors import DtwinError, InputError, MissingPart, printable
from dtwin.failures import fault_of
from dtwin.kinds.registry import kind_named
from dtwin.physics.circular import fit_circle
from dtwin.report.plots import polar_figure
from dtwin.workbench import _budget_routes as budget_routes
from dtwin.workbench import _campaign_routes as campaign_routes
from dtwin.workbench import _delivery_routes as delivery_routes
from dtwin.workbench import _effect_routes as effect_routes
from dtwin.workbench import _import_routes as import_routes
from dtwin.workbench import _live_routes as live_routes
from dtwin.workbench import _machine_routes as machine_routes
from dtwin.workbench import _measuring_routes as measuring_routes
from dtwin.workbench import _model_routes as model_routes
from dtwin.workbench import _plan_routes as plan_routes
from dtwin.workbench import _reading as reading
from dtwin.workbench import _registry_rows
from dtwin.workbench import _told_pages as told_pages
from dtwin.workbench import _twin_actions as twin_actions
from dtwin.workbench import _twin_routes as twin_routes
from dtwin.workbench._access import Access, Guarded
from dtwin.workbench._bench import Bench, bench_of
from dtwin.workbench._pages import drawn, refused

_WARMED_TWINS = 3
_KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_FOREVER = {"Cache-Control": "public, max-age=31536000, immutable"}
_PATIENCE_S = 30.0
# Systems limit a process to 1024 open files; whoever comes beyond it is not answered, and the server says so without an end.
_MOST_OPEN, _AT_ONCE = 500, 100


def application(bench: Bench) -> Guarded:
    """Return the workbench as an ASGI application."""
    app = FastAPI(title="dtwin workbench", docs_url=None, redoc_url=None, openapi_url=None)
    app.state.bench = bench
    for part in (
        machine_routes,
        plan_routes,
        campaign_routes,
        import_routes,
        twin_routes,
        told_pages,
        twin_actions,
        budget_routes,
        effect_routes,
        model_routes,
        live_routes,
        measuring_routes,
        delivery_routes,
    ):
        app.include_router(part.router, dependencies=[Depends(_require_home)])
    app.add_api_route("/", lambda: RedirectResponse("/machines", 303), include_in_schema=False)
    app.add_api_route("/static/{name}", _static, include_in_schema=False)
    app.add_exception_handler(DtwinError, _said)
    app.add_exception_handler(ModuleNotFoundError, _absent)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _unknown)
    app.add_exception_handler(OSError, _of_disk)
    app.add_exception_handler(Exception, _broken)
    return Guarded(app, bench.access)


def run(
    home: Home,
    host: str,
    listening: socket.socket,
    effects_path: Path | None,
    announce: Callable[[str], None],
    *,
    private: bool = False,
) -> None:
    """Serve until a signal ends it.

    ``host``: address as it was asked for.
    ``effects_path``: folder of the user's own effects.
    ``announce``: gets the address, once it answers.
    """
    _load_libraries()
    access = Access(host, int(listening.getsockname()[1]), private, home=home)
    bench = Bench(home, access, effects_path)
    threading.Thread(target=_warm, args=(bench,), daemon=True).start()
    config = uvicorn.Config(
        application(bench),
        http=_Connection,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=3,
        backlog=_AT_ONCE,
    )
    # A request that Ctrl-C cuts short is no fault.
    logging.getLogger("uvicorn.error").addFilter(
        lambda said: not (said.exc_info and said.exc_info[0] is CancelledError)
    )
    _Announcing(config, lambda: announce(access.address)).run(sockets=[listening])


class _Announcing(uvicorn.Server):
    """A server that says when it answers."""

    def __init__(self, config: uvicorn.Config, said: Callable[[], None]) -> None:
        super().__init__(config)
        self._said = said

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then say so."""
        await super().startup(sockets)
        if self.started:
            self._said()


def _require_home(request: Request) -> None:
    bench_of(request).require_home()


def _static(name: str) -> Response:
    if name == "plotly.js":
        return Response(get_plotlyjs(), media_type=_KINDS[".js"], headers=_FOREVER)
    path = files("dtwin.workbench") / "static" / name
    kind = _KINDS.get(Path(name).suffix)
    if kind is None or "/" in name or not path.is_file():
        raise HTTPException(404)
    return Response(path.read_bytes(), media_type=kind, headers={"Cache-Control": "no-cache"})


def _said(request: Request, error: Exception) -> Response:
    assert isinstance(error, DtwinError)
    return refused(request, error)


def _absent(request: Request, error: Exception) -> Response:
    assert isinstance(error, ModuleNotFoundError)
    said = MissingPart(
        f"this page needs the package {error.name}, which is not installed here",
        code="package.missing",
        hint="pip install '.[all]' in a checkout of dtwin",
    )
    return refused(request, said)


def _of_disk(request: Request, error: Exception) -> Response:
    if (fault := fault_of(error)) is None:
        # A mistake of ours, of which the server keeps a traceback.
        raise error
    return refused(request, fault)


def _broken(request: Request, error: Exception) -> Response:
    if (fault := fault_of(error)) is not None:
        return refused(request, fault)
    return Response("Internal Server Error", 500, media_type="text/plain")


def _load_libraries() -> None:
    """Load, before a second thread runs, libraries whose parts import one another: two threads at once got half of one, and a page failed."""
    # Plotly looks into a pandas that is loaded; nearly every part of SciPy is behind its optimize.
    for name in ("pandas", "scipy.optimize"):
        import_module(name)


def _warm(bench: Bench) -> None:
    """Load and read what the first pages would wait for; a page says what is wrong with it."""
    # What fits and draws a circle is imported at its first: that took a second.
    angle_deg = np.linspace(0.0, 360.0, 37)
    fit_circle(angle_deg, np.cos(np.radians(angle_deg)), 100.0)
    drawn(polar_figure({"circle": (angle_deg, np.zeros(37))}, 100.0, title="", plane="XY"))
    with contextlib.suppress(DtwinError, ModuleNotFoundError):
        for one in bench.campaigns()[:1]:
            if kind_named(one.kind).offers("sheet"):
                reading.campaign_sheet_of(bench, one.name, one.machine)
        newest = sorted(bench.twins.root.glob("*/v*.json"), key=lambda p: -p.stat().st_mtime)
        known = set(bench.twins.names())
        paths = [path.parent.name for path in newest if path.parent.name in known]
        for name in list(dict.fromkeys(paths))[:_WARMED_TWINS]:
            reading.view(bench, name)
        _registry_rows.registry_of(bench.home)
    # What was imported stays: looking through it for garbage held up every tenth answer by 140 ms.
    gc.freeze()


def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    if first["type"] == "missing":
        return refused(request, InputError("the request is not complete", code="request.invalid", where=place))
    said = InputError(
        "a field cannot be read",
        code="request.invalid",
        where=place.removeprefix("body."),
        got=printable(str(first["input"])[:80]),
        allowed=first["msg"].removeprefix("Input should be "),
    )
    return refused(request, said)


def _unknown(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 404:
        said = InputError(
            "there is no such page", code="page.unknown", got=request.url.path[:80], hint="begin at /campaigns"
        )
        return refused(request, said)
    return Response(f"{error.detail}\n", error.status_code, media_type="text/plain")


class _Connection(H11Protocol):
    """A connection that is closed when the head of its next request is not whole in time, nothing more of its body comes, or nothing of an answer is taken.

    Of very many, one that waits for a request gives way to each new one. The server itself limits only how long nothing at all comes after an answer.
    """

    _until: asyncio.TimerHandle | None = None
    _taking: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        if len(self.connections) > _MOST_OPEN:
            waiting = (c for c in self.connections if isinstance(c, _Connection) and c._until is not None)
            closed = next(waiting, self)
            closed._wait_no_more()
            closed.transport.abort()
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Read on; a request that is whole may take its time."""
        super().data_received(data)
        if self.conn.their_state is h11.SEND_BODY:
            self._wait()
        elif self.conn.their_state is not h11.IDLE:
            self._wait_no_more()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing."""
        super().connection_lost(exc)
        self._wait_no_more()
        self._taken()

    def pause_writing(self) -> None:
        """Wait until more of the answer is taken: it is held in memory."""
        super().pause_writing()
        self._require_less(None)

    def resume_writing(self) -> None:
        """Write on."""
        super().resume_writing()
        self._taken()

    def _require_less(self, held: int | None) -> None:
        """Close a connection that still holds as much as it did; else look again later."""
        now_held = self.transport.get_write_buffer_size()
        if held is not None and now_held >= held:
            self.transport.abort()
        else:
            self._taking = self.loop.call_later(_PATIENCE_S, self._require_less, now_held)

    def _taken(self) -> None:
        if self._taking is not None:
            self._taking.cancel()
            self._taking = None

    def _wait(self) -> None:
        self._wait_no_more()
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self._until = self.loop.call_later(_PATIENCE_S, self.transport.close)

    def _wait_no_more(self) -> None:
        if self._until is not None:
            self._until.cancel()
            self._until = None
