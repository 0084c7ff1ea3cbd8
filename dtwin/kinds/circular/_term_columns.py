"""Columns of the library's terms over the runs of a campaign, made once for every fold, and least squares by their sums per condition."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
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


# Small: it decides only what the measurements leave open.
_CENTRE_PENALTY = 0.02


@dataclass(frozen=True)
class Sums:
    """Sums over the rows of one cell of the grid.

    ``gram``, (p, p): X'X.
    ``moment``, (p,): X'y.
    ``power``: y'y.
    ``penalty``, (p, p): what is minimised besides the residual.
    """

    gram: Floats
    moment: Floats
    power: float
    rows: int
    penalty: Floats

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.gram + other.gram,
            self.moment + other.moment,
            self.power + other.power,
            self.rows + other.rows,
            self.penalty + other.penalty,
        )

    def take(self, chosen: Sequence[int]) -> Sums:
        """Return the sums for a subset of the columns."""
        index = np.asarray(chosen, dtype=int)
        square = np.ix_(index, index)
        return Sums(self.gram[square], self.moment[index], self.power, self.rows, self.penalty[square])

    def residual(self, weights: Floats) -> float:
        """Return the sum of squared residuals under given weights."""
        return float(self.power - 2.0 * weights @ self.moment + weights @ self.gram @ weights)


def sums_of(design: Floats, target: Floats, absorbed: Floats | None = None) -> Sums:
    """Return the sums of one cell.

    ``design``, (n, p): terms with centre and radius of the set-up taken out.
    ``target``, (n,): error with the same taken out.
    ``absorbed``, (n, p): what was taken out of the terms. It is held near zero: an equation that moves the centre of
    the circle spends its clamp on what no measurement has asked for.
    """
    penalty = np.zeros((design.shape[1], design.shape[1]))
    if absorbed is not None:
        penalty = _CENTRE_PENALTY * (absorbed.T @ absorbed)
    return Sums(design.T @ design, design.T @ target, float(target @ target), target.size, penalty)


def total(cells: Sequence[Sums]) -> Sums:
    """Return the sums over several cells."""
    result = cells[0]
    for cell in cells[1:]:
        result = result + cell
    return result


def solve(sums: Sums, ridge: float) -> Floats:
    """Return ridge weights; the penalty is relative to each column's own size.

    ``ridge``: penalty as a share of a column's mean square.
    """
    scale = np.sqrt(np.maximum(np.diag(sums.gram), 1e-300))
    scaled = (sums.gram + sums.penalty) / np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += ridge
    return np.asarray(np.linalg.solve(scaled, sums.moment / scale) / scale)


def forward_order(sums: Sums, groups: Sequence[Sequence[int]], ridge: float) -> list[int]:
    """Return groups of columns in the order in which they reduce the residual most.

    ``groups``: columns that enter together, such as cosine and sine.
    ``ridge``: as in :func:`solve`.
    """
    scale = np.sqrt(np.maximum(np.diag(sums.gram), 1e-300))
    gram = sums.gram / np.outer(scale, scale)
    gram[np.diag_indices_from(gram)] += ridge
    moment = sums.moment / scale
    left = list(range(len(groups)))
    order: list[int] = []
    # Orthogonalise in place: after each step gram and moment are those of the residual.
    while left:
        gains = np.zeros(len(left))
        for size in {len(groups[g]) for g in left}:
            places = [i for i, g in enumerate(left) if len(groups[g]) == size]
            index = np.array([groups[left[i]] for i in places])
            block = gram[index[:, :, None], index[:, None, :]] + 1e-12 * np.eye(size)
            taken = np.linalg.solve(block, moment[index][:, :, None])[:, :, 0]
            gains[places] = np.sum(moment[index] * taken, axis=1)
        best = left.pop(int(np.argmax(gains)))
        order.append(best)
        index = np.array(groups[best])
        block = gram[np.ix_(index, index)] + 1e-12 * np.eye(len(index))
        across = gram[:, index]
        moment = moment - across @ np.linalg.solve(block, moment[index])
        gram = gram - across @ np.linalg.solve(block, across.T)
    return order
