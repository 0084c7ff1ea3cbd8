"""Prefect's server behind a guard: ``python -m flows.prefect_server --port 4200``.

Prefect answers every Host and every Origin unless told otherwise. Here only this computer's own
names and the server's own page are answered; the auth string is Prefect's own check.
"""

from __future__ import annotations

import argparse
from typing import Any

import uvicorn
from prefect.server.api.server import create_app
from prefect.settings import get_current_settings
from starlette.datastructures import Headers
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from flows._prefect_tables import make_missing_tables
from flows.own_pages import ENTER, HOST, asks_from_elsewhere, refuse

# The part of the address behind # stays in the browser: the page keeps it where Prefect's own
# page keeps what is typed into it.
_ENTER_PAGE = (
    '<!doctype html><html lang="en"><meta charset="utf-8"><title>Prefect</title><script>'
    "if (location.hash.length > 1) localStorage.setItem('prefect-password', location.hash.slice(1));"
    "location.replace('/deployments');</script>"
)


class OwnPagesOnly:
    """An application that answers this computer's own names and its own pages only.

    Args:
        app: What is guarded.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if asks_from_elsewhere(Headers(scope=scope)):
            await refuse("another site asks, or another name", 403, scope, receive, send)
        elif scope["type"] == "http" and scope["path"] == ENTER:
            await HTMLResponse(_ENTER_PAGE)(scope, receive, send)
        else:
            await self.app(scope, receive, send)


def main() -> None:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m flows.prefect_server")
    parser.add_argument("--port", type=int, required=True)
    port = parser.parse_args().port
    settings = get_current_settings().server.api
    make_missing_tables()
    options: dict[str, Any] = {"timeout_keep_alive": settings.keepalive_timeout}
    app = OwnPagesOnly(create_app(final=True))
    uvicorn.run(app, host=HOST, port=port, log_level="warning", **options)


if __name__ == "__main__":
    main()
