"""Where flows run: on the server that is up, with their state under ``DTWIN_HOME``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from prefect import Flow
from prefect.settings import temporary_settings

from dtwin.config import Home, home
from dtwin.errors import InputError
from flows.reach import answers, running


def run(flow: Flow[..., Any], **parameters: Any) -> Any:
    """Run a flow in this process and return its result.

    Parameters
    ----------
    flow : Flow
        The flow.
    **parameters
        Its parameters.

    Raises
    ------
    InputError
        When ``PREFECT_API_URL`` names a server that does not answer.
    """
    with runtime(home()):
        return flow(**parameters)


@contextmanager
def runtime(state: Home) -> Iterator[str | None]:
    """Set Prefect up for short flows, and give the address of the server that they report to.

    Without a server Prefect starts one of its own for this process, which takes seconds. The
    heartbeat is switched off: its thread costs every synchronous flow a second.

    Parameters
    ----------
    state : Home
        Where ``dtwin up`` says what is running.
    """
    url = running_server(state)
    updates: dict[str, Any] = {"flows.heartbeat_frequency": None}
    if url is not None:
        updates["api.url"] = url
    with temporary_settings(updates=updates):
        yield url


def running_server(state: Home) -> str | None:
    """Return the API address of the server to report to, None when there is none.

    Parameters
    ----------
    state : Home
        Where ``dtwin up`` says what is running.

    Raises
    ------
    InputError
        When ``PREFECT_API_URL`` names a server that does not answer.
    """
    named = os.environ.get("PREFECT_API_URL")
    if named:
        if answers(f"{named}/health"):
            return named
        raise InputError(
            "the Prefect server does not answer",
            code="prefect.absent",
            where="PREFECT_API_URL",
            got=named,
            hint="dtwin up starts one; unset PREFECT_API_URL to run without",
        )
    url = running(state).get("prefect_api")
    return url if url is not None and answers(f"{url}/health") else None
