"""State of a cell as one file: what is done, what runs, which twin is live, who asked to stop."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import InputError, StoreError
from dtwin.locks import locked
from dtwin.schema import require_name

COBOT, MILL, NONE = "cobot", "mill", "none"
_WAITING, RUNNING, DONE, INTERRUPTED = "waiting", "running", "done", "interrupted"
_QUARTERS = 4
STEPS: tuple[tuple[str, str], ...] = (
    ("load", COBOT),
    ("hold and bolt", NONE),
    *((f"mill quarter {k + 1}", MILL) for k in range(_QUARTERS)),
    ("to unload position", NONE),
    ("unload", COBOT),
)
"""Steps of one part, each with the twin that is live in it."""
_MOST_PARTS = 100


class CellFile:
    """The state of one cell below ``DTWIN_HOME/cells``."""

    def __init__(self, home: Home, name: str) -> None:
        self.folder = home.root / "cells" / require_name(name, "the cell")
        self.name = name

    def begin(self, parts: int, seed: int) -> dict[str, Any]:
        """Write the state of a new job, with every step of every part waiting.

        Raises ``InputError`` when a job is there that is not done, or the number of parts makes no sense.
        """
        if not 1 <= parts <= _MOST_PARTS:
            raise InputError(
                "a job has one part or more", code="cell.parts", got=str(parts), allowed=f"1 to {_MOST_PARTS}"
            )
        if self._path.exists() and next_step(self.read()) is not None:
            raise InputError(
                "the cell has a job that is not done",
                code="cell.unfinished",
                where=self.name,
                hint=f"dtwin cell resume --cell {self.name}, or dtwin cell clear --cell {self.name}",
            )
        steps = [
            {"part": part + 1, "step": step, "twin": twin, "state": _WAITING, "result": {}}
            for part in range(parts)
            for step, twin in STEPS
        ]
        state = {"cell": self.name, "parts": parts, "seed": seed, "begun": now(), "steps": steps}
        self._stop.unlink(missing_ok=True)
        self.write(state)
        return state

    def read(self) -> dict[str, Any]:
        """Return the state.

        Raises ``InputError`` when the cell has no job.
        Raises ``StoreError`` when its file is damaged.
        """
        try:
            document = json.loads(self._path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise InputError(
                "the cell has no job", code="cell.none", where=self.name, hint=f"dtwin cell run --cell {self.name}"
            ) from error
        except ValueError as error:
            raise StoreError(
                "the cell's state cannot be read",
                code="cell.state",
                where=str(self._path),
                got=str(error)[:120],
                hint=f"dtwin cell clear --cell {self.name}",
            ) from error
        if not isinstance(document, dict) or not isinstance(document.get("steps"), list):
            raise StoreError(
                "the cell's state is something else",
                code="cell.state",
                where=str(self._path),
                hint=f"dtwin cell clear --cell {self.name}",
            )
        return document

    def write(self, state: dict[str, Any]) -> None:
        """Replace the state in one step."""
        write_text(self._path, json.dumps(state, indent=1), "the cell's state")

    def clear(self) -> None:
        """Forget the job. Raises ``InputError`` when it is running."""
        with self.alone():
            self._path.unlink(missing_ok=True)
            self._stop.unlink(missing_ok=True)

    def ask_to_stop(self, reason: str) -> None:
        """Ask the running job to stop after its step."""
        self.read()
        write_text(self._stop, reason, "the request to stop")

    def stop_asked(self) -> str | None:
        """Return why the job shall stop, None when it shall not."""
        try:
            return self._stop.read_text(encoding="utf-8") or "asked to"
        except FileNotFoundError:
            return None

    def take_stop(self) -> None:
        """Take a request to stop as answered."""
        self._stop.unlink(missing_ok=True)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the cell: two jobs would move the same machines. Raises ``InputError`` when another process holds it."""
        with locked(self.folder / "lock") as mine:
            if not mine:
                raise InputError(
                    "the cell is running already",
                    code="cell.busy",
                    where=self.name,
                    hint=f"dtwin cell status --cell {self.name}",
                )
            yield

    @property
    def running(self) -> bool:
        """Whether a process holds the cell now."""
        try:
            with self.alone():
                return False
        except InputError:
            return True

    @property
    def _path(self) -> Path:
        return self.folder / "state.json"

    @property
    def _stop(self) -> Path:
        return self.folder / "stop"


def next_step(state: dict[str, Any]) -> int | None:
    """Return the number of the first step that is not done, None when all are."""
    return next((i for i, s in enumerate(state["steps"]) if s["state"] != DONE), None)


def live_twin(state: dict[str, Any]) -> str:
    """Return the twin of the step that runs, ``none`` between steps."""
    return next((str(s["twin"]) for s in state["steps"] if s["state"] == RUNNING), NONE)


def now() -> str:
    """Return the time in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
