"""A Prefect page for a job that is started by hand: the one that is up, or one of its own.

What takes seconds to import is imported after the server was started, which takes as long.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from dtwin.config import Home
from dtwin.errors import DtwinError
from flows.reach import running_server
from flows.servers import await_healthy, prefect_alone

if TYPE_CHECKING:
    from studies.cobot_steps import ProgressOf, Steps

Say = Callable[[str], None]


@contextmanager
def shown_steps(home: Home, progress: ProgressOf, say: Say) -> Iterator[Steps]:
    """Give what does the steps of a job: flows when there can be a page, else plain functions.

    Args:
        home: Where everything is kept.
        progress: Returns a progress callback for a title.
        say: Shows a line: where the page is, or why there is none.
    """
    with ExitStack() as held:
        try:
            steps = held.enter_context(_flow_steps(home, progress, say))
        except DtwinError as error:
            say(f"no Prefect page, the steps run without: {error}")
            steps = _plain(home, progress)
        yield steps


@contextmanager
def _flow_steps(home: Home, progress: ProgressOf, say: Say) -> Iterator[Steps]:
    if find_spec("prefect") is None:
        say("prefect is not installed: the steps run without it (pip install '.[flows]')")
        yield _plain(home, progress)
        return
    with ExitStack() as held:
        api, until = running_server(home), ""
        if api is None:
            started = held.enter_context(prefect_alone(home))
            import flows.demo  # noqa: F401
            from dtwin.train.registry import Registry

            # Makes the tables of an empty home: seconds of another processor than the server's.
            Registry(home)
            await_healthy(home, started)
            api = started.addresses["prefect_api"]
            until = " until the end, afterwards with: dtwin up"
        from flows._runtime import delivered, runtime
        from flows.demo import FlowSteps

        held.enter_context(runtime(home))
        held.enter_context(delivered())
        _quiet_console()
        say(f"the steps show at {api.removesuffix('/api')}/runs{until}")
        yield FlowSteps(home, api, progress, say)


def _plain(home: Home, progress: ProgressOf) -> Steps:
    from studies.cobot_steps import PlainSteps

    return PlainSteps(home, progress)


def _quiet_console() -> None:
    """Keep log lines and tracebacks out of the terminal; the page has them, and errors are shown."""
    from prefect.logging.handlers import PrefectConsoleHandler

    for name in ("prefect", "prefect.flow_runs", "prefect.task_runs", None):
        for handler in logging.getLogger(name).handlers:
            if isinstance(handler, PrefectConsoleHandler):
                handler.setLevel(logging.CRITICAL)
