"""Columns of the library's terms over the runs of a campaign, made once for every fold."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from math import prod

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

    def of(self, library: Library, runs: Sequence[TickRun], only: Sequence[int] | None = None) -> Floats:
        """Return terms at the rows of runs, one run after the other, shape (rows, terms).

        ``library``: with joint angles not taken ahead.
        ``only``: numbers of the wanted terms; all by default.
        """
        parts = [self._kept_of(part, runs) for part in (None, *library.gears, *library.modes)]
        wanted = slice(None) if only is None else np.asarray(only, dtype=int)
        rows = [columns.shape[1] for columns in parts[0]]
        terms = np.empty((sum(rows), len(library.atoms) if only is None else len(only)))
        for i, end in enumerate(np.cumsum(rows)):
            terms[end - rows[i] : end] = np.concatenate([part[i] for part in parts])[wanted].T
        return terms

    def part(self, part: Gear | None, runs: Sequence[TickRun], *, every: int) -> Floats:
        """Return the terms of a gear, or those that are always there, at every so manieth row of runs."""
        return np.concatenate([columns[:, ::every].T for columns in self._kept_of(part, runs)]).astype(float)

    def _kept_of(self, part: Gear | Mode | None, runs: Sequence[TickRun]) -> list[NDArray[np.float32]]:
        """Return a part's terms of each run, (terms, rows) each."""
        with self._lock:
            if (runs[0].meta.run_id, part) not in self._kept:
                self._make(part)
        return [self._kept[(run.meta.run_id, part)] for run in runs]

    def _make(self, part: Gear | Mode | None) -> None:
        runs = list(self._runs.values())
        if isinstance(part, Gear):
            made = self._of_gear(part, runs)
        else:
            library = Library([], [] if part is None else [part])
            wanted = [f for atom, f in library.atoms.items() if part is None or atom.cause == RINGING]
            made = library.values([prod(factors[1:], start=factors[0]) for factors in wanted], runs)
        for run, columns in zip(runs, made, strict=True):
            self._kept[(run.meta.run_id, part)] = columns.T

    def _of_gear(self, gear: Gear, runs: Sequence[TickRun]) -> list[NDArray[np.float32]]:
        """Return the terms of a gear: a wave, which remembers nothing, times a term that is always there."""
        library = Library([gear], [])
        number = {factors: i for i, factors in enumerate(library.atoms.values())}
        ripple = [factors for atom, factors in library.atoms.items() if atom.cause == RIPPLE]
        always = [number[factors[:-1]] for factors in ripple]
        waves = library.values([factors[-1] for factors in ripple], runs)
        if (runs[0].meta.run_id, None) not in self._kept:
            self._make(None)
        kept = [self._kept[(run.meta.run_id, None)] for run in runs]
        return [wave * columns[always].T for wave, columns in zip(waves, kept, strict=True)]
