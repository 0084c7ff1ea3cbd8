"""The command line. Bodies import late so that help is instant."""

from __future__ import annotations

import contextlib
import gc
import io
import json
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from dtwin import __version__
from dtwin.commands import register
from dtwin.commands.tasks import ByTask, Commands, EndedEarly
from dtwin.config import home, quiet_environment
from dtwin.errors import EXIT_INTERRUPTED, DtwinError, InputError, MissingPart
from dtwin.failures import fault_of

_BEGIN = """\b
New here?
  dtwin demo --quick     the main job on a virtual robot, in small
  dtwin ui               the workbench in your browser
  dtwin check FILE       what a ball-bar file or a campaign folder shows
Everything is kept in DTWIN_HOME, by default .dtwin in this folder.
"""

app = Commands(
    name="dtwin",
    cls=ByTask,
    help="Measure, model and correct the accuracy of machine tools and robots.",
    epilog=_BEGIN,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
register(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"dtwin {__version__}")
        raise typer.Exit


# They begin and end with the shared store themselves, or are about it.
_FOLLOW_THEMSELVES = ("home", "ui", "up")


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    if {"--help", "-h"} & set(sys.argv):
        return
    _require_text(sys.argv[1:])
    told = os.environ.get("DTWIN_HOME", "")
    if "://" in told:
        raise InputError(
            "the home is a folder, not an address",
            code="home.folder",
            where="DTWIN_HOME",
            got=f"{told.partition('://')[0][:20]}://",
            hint="a home on a shared store: dtwin home move --store ADDRESS, docs/how-to/share-a-home.md",
        )
    state = home()
    state.require_parts()
    if state.root.exists() and not state.root.is_dir():
        raise InputError("the home is not a folder", code="home.folder", where=str(state.root), hint="set DTWIN_HOME")
    state.tightened()
    if state.file.store and context.invoked_subcommand not in _FOLLOW_THEMSELVES:
        from dtwin.shared_documents import followed_beside, following

        beside = context.invoked_subcommand == "serve"
        context.with_resource(followed_beside(state) if beside else following(state))


def _require_text(words: Sequence[str]) -> None:
    """Refuse words whose bytes are no text here: a table, page or name that they come into could not be written."""
    odd = next((word for word in (*words, str(home().root)) if any("\ud800" <= c <= "\udfff" for c in word)), None)
    if odd is not None:
        raise InputError(
            "a word of the command is no text in the encoding of this terminal",
            code="command.encoding",
            got=ascii(odd)[1:-1][:120],
            allowed=sys.getfilesystemencoding(),
            hint="rename what is not in UTF-8; in a terminal of ASCII: LC_ALL=C.UTF-8, and PYTHONUTF8 not 0",
        )


def main() -> None:
    """Run the command line; a user's mistake ends in a message, never a traceback."""
    quiet_environment()
    # What a library begins by -m would import what lies where the command was typed: an mlflow.py on a share.
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    # Cells of a table by the million are in no cycles: to look for some took a third of the time of a large file.
    gc.set_threshold(100_000, 50, 50)
    _open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A terminal of few letters has no µ; what it cannot show is told as on stderr.
        sys.stdout.reconfigure(errors="backslashreplace")
    # Also at the end: what a first command made is for its owner alone.
    with contextlib.ExitStack() as ending:
        ending.callback(_tighten)
        _run()


def _tighten() -> None:
    # What names no home was told.
    with contextlib.suppress(InputError):
        home().tightened()


def _open_closed_streams() -> None:
    """Open streams that were closed (``>&-``) to nowhere, in their order: the next file would get what is printed."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def _run() -> None:
    try:
        app()
    except DtwinError as error:
        _report(error)
        sys.exit(error.exit_code)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("", "dtwin", "flows", "studies"):
            raise
        absent = _missing_part(missing)
        _report(absent)
        sys.exit(absent.exit_code)
    except EndedEarly as ended:
        if isinstance(ended.__cause__, BrokenPipeError):
            # As `head` does.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(0)
        print("interrupted; run the same command again to continue", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    except Exception as error:
        fault = fault_of(error)
        if fault is None:
            raise
        _report(fault)
        sys.exit(fault.exit_code)


def _missing_part(package: str) -> MissingPart:
    """Say which part of the installation a command needs; a serving host has only ``serve``."""
    return MissingPart(
        f"this command needs the package {package}, which is not installed here",
        code="package.missing",
        hint="pip install '.[all]' in a checkout of dtwin; a serving host needs only '.[serve]' "
        "and the command dtwin serve",
    )


def _report(error: DtwinError) -> None:
    if "--json" in sys.argv:
        with contextlib.suppress(OSError):
            print(json.dumps({"error": error.as_dict()}, indent=2), flush=True)
            return
    with contextlib.suppress(OSError):
        print(error.render(), file=sys.stderr)
