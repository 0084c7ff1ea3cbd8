"""The command line. Bodies import late so that help is instant."""

from __future__ import annotations

import json
import os
import sys

import typer

from dtwin.commands import data as data_commands
from dtwin.commands import demo as demo_command
from dtwin.commands import modelling as modelling_commands
from dtwin.commands import serving as serving_commands
from dtwin.config import quiet_environment
from dtwin.errors import EXIT_INTERRUPTED, DtwinError

app = typer.Typer(
    name="dtwin",
    help="Measure, model and correct the accuracy of machine tools and robots.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
demo_command.register(app)
data_commands.register(app)
modelling_commands.register(app)
serving_commands.register(app)


def main() -> None:
    """Run the command line; a user's mistake ends in a message, never a traceback."""
    quiet_environment()
    try:
        app()
    except DtwinError as error:
        _report(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("interrupted; run the same command again to continue", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output went away, as `head` does.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _report(error: DtwinError) -> None:
    if "--json" in sys.argv:
        print(json.dumps({"error": error.as_dict()}, indent=2))
    else:
        print(error.render(), file=sys.stderr)
