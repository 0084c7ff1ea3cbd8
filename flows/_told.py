"""How a mistake of dtwin is told on Prefect's page: with what to try, and without a traceback."""

from __future__ import annotations

import logging
from types import TracebackType

import prefect.states

from dtwin.errors import DtwinError

_of_prefect = prefect.states.format_exception


def _formatted(exc: BaseException, tb: TracebackType | None = None) -> str:
    """Return what the state of a failed flow or task says of its error; Prefect leaves all but the message away."""
    return exc.render() if isinstance(exc, DtwinError) else _of_prefect(exc, tb)  # type: ignore[arg-type]


class _WithoutTraces(logging.Filter):
    """Takes the traceback away from what a user can mend, and tells all of its message in lines, as the command does."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, DtwinError):
            record.exc_info = None
            record.msg, record.args = "%s", (error.render(),)
        elif "error[" in (said := record.getMessage()):
            # What Prefect says of a state is quoted as Python does.
            record.msg, record.args = "%s", (said.replace("\\n", "\n"),)
        return True


prefect.states.format_exception = _formatted
for _name in ("prefect.flow_runs", "prefect.task_runs"):
    logging.getLogger(_name).addFilter(_WithoutTraces())
