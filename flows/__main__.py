"""Serve every flow to a Prefect server: ``python -m flows --cron '0 * * * *'``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from threading import Thread

from prefect import serve

from dtwin.config import home
from dtwin.errors import DtwinError
from dtwin.shared_documents import following
from flows.cron import require_cron
from flows.schedule import deployments

# One trains while another is looked at; more would only take the cores from each other.
_AT_ONCE = 2
_LOOK_S, _GRACE_S = 1.0, 5.0


def main(arguments: list[str] | None = None) -> None:
    """Serve all deployments until told to stop.

    Args:
        arguments: Command line; ``--cron LINE`` sets the schedule; ``--with PROCESS`` ends this one with its parent.
    """
    parser = argparse.ArgumentParser(prog="python -m flows")
    parser.add_argument("--cron", help="when to train; without it only on request")
    parser.add_argument("--with", type=int, dest="parent", help="number of the parent process; ends with it")
    told = parser.parse_args(arguments)
    cron = told.cron
    if told.parent:
        Thread(target=_end_with, args=(told.parent,), daemon=True).start()
    try:
        made = deployments(require_cron(cron) if cron else None)
        with following(home()):
            serve(*made, limit=_AT_ONCE, print_starting_message=False)
    except DtwinError as error:
        print(error.render(), file=sys.stderr)
        sys.exit(error.exit_code)


def _end_with(parent: int) -> None:
    """End this process and its flow runs some seconds after its parent: Prefect's own end waits for a server that has ended, too."""
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    time.sleep(_GRACE_S)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()
