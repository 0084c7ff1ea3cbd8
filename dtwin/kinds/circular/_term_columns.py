"""Columns of the library's terms over the runs of a campaign, made once for every fold."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.kinds.circular._library import RINGING, RIPPLE, Gear, Library, Mode
from dtwin.schema import Floats
from dtwin.train.dataset import TickRun


class TermColumns:
    """What the terms are at the rows of runs: functions of the commanded motion alone.

    No measurement goes into them, so that folds that hold out different runs may share them, in threads, too.

    ``runs``: all runs, each with an id of its own.
    """

    def __init__(self, runs: Sequence[TickRun]) -> None:
        self._runs = {run.meta.run_id: run for run in runs}
        self._lock = threading.Lock()
        self._kept: dict[tuple[str, Gear | Mode | None], NDArray[np.float32]] = {}

    def of(
        self, library: Library, runs: Sequence[TickRun], only: Sequence[int] | None = None, *, every: int = 1
    ) -> Floats:
        """Return terms at the rows of runs, one run after the other, shape (rows, terms).

        ``library``: with joint angles not taken ahead.
        ``only``: numbers of the wanted terms; all by default.
        ``every``: only each such row of a run.
        """
        parts = [None, *library.gears, *library.modes]
        wanted = slice(None) if only is None else np.asarray(only, dtype=int)
        found = []
        for run in runs:
            columns = np.concatenate([self._part(run.meta.run_id, p) for p in parts])
            found.append(columns[wanted, ::every].T.astype(float))
        return np.concatenate(found)

    def _part(self, run_id: str, part: Gear | Mode | None) -> NDArray[np.float32]:
        """Return the terms of a gear or a mode, or those that are always there, (terms, rows)."""
        with self._lock:
            if (run_id, part) not in self._kept:
                self._make(part)
        return self._kept[(run_id, part)]

    def _make(self, part: Gear | Mode | None) -> None:
        gears = [part] if isinstance(part, Gear) else []
        library = Library(gears, [part] if isinstance(part, Mode) else [])
        causes = [atom.cause for atom in library.atoms]
        added = [i for i, cause in enumerate(causes) if cause in (RIPPLE, RINGING)]
        only = added if part is not None else None
        runs = list(self._runs.values())
        for run, columns in zip(runs, library.columns(runs, only), strict=True):
            self._kept[(run.meta.run_id, part)] = columns.T
