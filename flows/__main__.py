"""Serve every flow to a Prefect server: ``python -m flows --cron '0 * * * *'``."""

from __future__ import annotations

import argparse
import sys

from prefect import serve

from dtwin.config import home
from dtwin.errors import DtwinError
from dtwin.shared_documents import following
from flows.cron import require_cron
from flows.schedule import deployments

# One trains while another is looked at; more would only take the cores from each other.
_AT_ONCE = 2


def main(arguments: list[str] | None = None) -> None:
    """Serve all deployments until told to stop.

    Args:
        arguments: Command line; ``--cron LINE`` sets the schedule.
    """
    parser = argparse.ArgumentParser(prog="python -m flows")
    parser.add_argument("--cron", help="when to train; without it only on request")
    cron = parser.parse_args(arguments).cron
    try:
        made = deployments(require_cron(cron) if cron else None)
        with following(home()):
            serve(*made, limit=_AT_ONCE, print_starting_message=False)
    except DtwinError as error:
        print(error.render(), file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
