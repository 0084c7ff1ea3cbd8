"""Where flows run: on the server that is up, with their state under ``DTWIN_HOME``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from prefect import Flow
from prefect.events.worker import EventsWorker
from prefect.logging.handlers import APILogWorker
from prefect.settings import temporary_settings

from dtwin.config import Home, home
from flows.reach import auth_string, running_server

_DELIVER_S = 15.0
# For its own server, on cores that are busy: Prefect's 20 s were not enough.
_START_S = 180


def run(flow: Flow[..., Any], **parameters: Any) -> Any:
    """Run a flow in this process and return its result.

    Args:
        flow: The flow.
        **parameters: Its parameters.

    Raises:
        InputError: When ``PREFECT_API_URL`` names a server that does not answer.
    """
    with runtime(home()):
        return flow(**parameters)


@contextmanager
def runtime(state: Home) -> Iterator[str | None]:
    """Set Prefect up for short flows, and give the address of the server that they report to.

    Without a server Prefect starts one of its own for this process, which takes seconds. The
    heartbeat is switched off: its thread costs every synchronous flow a second.

    Args:
        state: Where ``dtwin up`` says what is running.
    """
    url = running_server(state)
    updates: dict[str, Any] = {"flows.heartbeat_frequency": None, "server.ephemeral.startup_timeout_seconds": _START_S}
    if url is not None:
        updates["api.url"] = url
    if not os.environ.get("PREFECT_API_URL"):
        # Its own one, too: it answers every user of this computer, and every page in a browser, and what they begin
        # there runs at the next `dtwin up`.
        updates["api.auth_string"] = updates["server.api.auth_string"] = auth_string(state)
    with temporary_settings(updates=updates):
        if url is None:
            from flows._prefect_tables import make_missing_tables

            make_missing_tables()
        yield url


@contextmanager
def delivered() -> Iterator[None]:
    """Wait at the end until the server has the logs and task states of the body's flows.

    They go out in the background, and the server may stop right after.
    """
    try:
        yield
    finally:
        APILogWorker.drain_all(timeout=_DELIVER_S)
        EventsWorker.drain_all(timeout=_DELIVER_S)
