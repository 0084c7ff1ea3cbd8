"""The library as columns whose products are known: sets of effects are compared in microseconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.physics.candidates import Candidates, likely_pitches
from dtwin.physics.problem import Problem, Term, least_visible
from dtwin.schema import Floats

_PITCH = "pitch_mm"


@dataclass(frozen=True)
class Entry:
    """An effect in one shape.

    Attributes
    ----------
    term : Term
        Effect and shape.
    columns : slice
        Where its columns are.
    free : int
        Parameters and shapes.
    """

    term: Term
    columns: slice
    free: int

    @property
    def label(self) -> str:
        """Name with axis."""
        return self.term.label


class Dictionary:
    """Effects in the shapes of their grids, beside what is known.

    Parameters
    ----------
    problem : Problem
        Whitened campaign with what is known.
    candidates : Candidates
        The library.
    """

    def __init__(self, problem: Problem, candidates: Candidates) -> None:
        self._problem, self._candidates = problem, candidates
        self._residual = problem.residual.ravel()
        self.total = float(self._residual @ self._residual)
        self.entries: list[Entry] = []
        self._columns = np.empty((len(self._residual), 0))
        self._gram, self._right = np.empty((0, 0)), np.empty(0)
        grids = [
            Term(instance, shape)
            for instance in candidates.instances
            for shape in candidates.grid(instance)
        ]
        self.add(grids)

    def add(self, terms: Iterable[Term]) -> list[Entry]:
        """Take more effects in; those that nothing can be seen of are left out."""
        new, parts, at = [], [], self._columns.shape[1]
        for term in terms:
            whitened = self._candidates.whitened(self._problem, term)
            size = np.sqrt((whitened**2).sum(axis=0))
            whitened = whitened[:, size > 0.0] / size[size > 0.0]
            basis = self._problem.basis
            left = whitened - basis @ (basis.T @ whitened)
            left = left[:, (left**2).sum(axis=0) > least_visible(term)]
            k = left.shape[1]
            if not k:
                continue
            effect = term.instance.effect
            new.append(Entry(term, slice(at, at + k), k + len(effect.shapes)))
            parts.append(left)
            at += k
        if new:
            added = np.concatenate(parts, axis=1)
            cross, own = self._columns.T @ added, added.T @ added
            self._gram = np.block([[self._gram, cross], [cross.T, own]])
            self._right = np.concatenate([self._right, added.T @ self._residual])
            self._columns = np.concatenate([self._columns, added], axis=1)
            self.entries += new
        return new

    def add_pitches(self, chosen: Sequence[Entry]) -> None:
        """Take in the pitches at which what a set leaves repeats most."""
        left = self._residual - self.fitted(chosen)
        rows = left.reshape(self._problem.obs.n_rows, -1)
        have = {e.label for e in chosen}
        for instance in self._candidates.instances:
            shapes = instance.effect.shapes
            if shapes and shapes[0].name == _PITCH and instance.label not in have:
                pitches = likely_pitches(self._problem.obs, rows, instance, 1)
                self.add([Term(instance, {_PITCH: p}) for p in pitches])

    def fitted(self, chosen: Sequence[Entry]) -> Floats:
        """Return what a set explains, whitened, shape (rows * n,)."""
        index = _indices(chosen)
        if not len(index):
            return np.zeros_like(self._residual)
        root = _root(self._gram[np.ix_(index, index)])
        return np.asarray(self._columns[:, index] @ (root @ (root.T @ self._right[index])))

    def explained(self, chosen: Sequence[Entry]) -> float:
        """Return the sum of squares that a set explains."""
        index = _indices(chosen)
        if not len(index):
            return 0.0
        root = _root(self._gram[np.ix_(index, index)])
        return float(((root.T @ self._right[index]) ** 2).sum())

    def gains(self, chosen: Sequence[Entry]) -> Floats:
        """Return what each entry would explain beside a set, shape (entries,)."""
        index = _indices(chosen)
        right, gram = self._right, self._gram
        if len(index):
            root = _root(gram[np.ix_(index, index)])
            along = root.T @ gram[index]
            right = right - along.T @ (root.T @ right[index])
        out = np.zeros(len(self.entries))
        for i, entry in enumerate(self.entries):
            own = gram[entry.columns, entry.columns]
            if len(index):
                part = along[:, entry.columns]
                own = own - part.T @ part
            least = least_visible(entry.term)
            if own.shape == (1, 1):
                out[i] = right[entry.columns][0] ** 2 / own[0, 0] if own[0, 0] > least else 0.0
                continue
            values, vectors = np.linalg.eigh(own)
            seen = values > least
            out[i] = (((vectors[:, seen].T @ right[entry.columns]) ** 2) / values[seen]).sum()
        return out


def _indices(chosen: Sequence[Entry]) -> np.ndarray:
    return np.concatenate(
        [np.arange(e.columns.start, e.columns.stop) for e in chosen] or [np.empty(0, dtype=int)]
    )


def _root(gram: Floats) -> Floats:
    """Return a root of the inverse, without the directions that are not determined."""
    values, vectors = np.linalg.eigh(gram)
    keep = values > 1e-9 * max(float(values[-1]), 1e-300)
    return np.asarray(vectors[:, keep] / np.sqrt(values[keep]))
