"""A campaign with one row for each condition: a third of the numbers when every run has two repeats, the same products."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dtwin.physics.candidates import Candidates
from dtwin.physics.effect import Instance, Shape
from dtwin.physics.gridding import Indices
from dtwin.physics.problem import Problem, Term, beside, least_visible, orthonormal
from dtwin.physics.whitening import condition_sums
from dtwin.schema import Floats

# As share of a column's sum of squares; less differs between repeats by rounding only.
_ROUNDING = 1e-18
_SPANNING = 8
# Logarithms of shapes: the step that slopes are taken with, and how far from there they are used.
_STEP, _NEAR = 1e-4, 0.02
# Columns of so many shapes between those of the grids.
_MOST_KEPT = 500


@dataclass(frozen=True)
class Condensed:
    """Whitened vectors of a campaign, in a space of fewer dimensions in which their products are the same.

    Hardly any effect differs between repeats. What does, and what the basis does between them, spans a few directions.
    A vector is the sum over the rows of each condition, divided by the root of their number; then its coordinates along
    those directions; at last, for the measurements only, the size of the rest. m numbers in all.

    ``y``, (m,), ``basis``, (m, p): measurements, and the orthonormal basis of what is known.
    ``between``, (rows * n, q): orthonormal directions in which repeats differ.
    """

    problem: Problem
    candidates: Candidates
    y: Floats
    basis: Floats
    between: Floats
    condition_of: Indices
    root: Floats
    _between_grids: dict[object, Floats] = field(default_factory=dict, repr=False, compare=False)
    _slopes: dict[object, tuple[Floats, Floats]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def residual(self) -> Floats:
        """What the known effects leave, shape (m,)."""
        return np.asarray(self.y - self.basis @ (self.basis.T @ self.y))

    def columns(self, term: Term) -> Floats:
        """Return the whitened columns of a term with a shape of the grid, shape (m, k)."""
        return self.each([self.candidates.harmonics(term)]).T

    def columns_between(self, term: Term) -> Floats:
        """Return the whitened columns of a term with any shape, shape (m, k); kept until many others were asked for."""
        key, kept = (term.label, tuple(sorted(term.shape.items()))), self._between_grids
        if key not in kept:
            if len(kept) >= _MOST_KEPT:
                del kept[next(iter(kept))]
            made = self.problem.obs.distinct_harmonics(term.instance, term.shape, keep=False)
            kept[key] = self.each([made]).T
        return kept[key]

    def slope(self, term: Term, name: str) -> Floats:
        """Return how the columns of a term change with the logarithm of a shape, shape (m, k).

        Of a shape next to it when that was asked for before: slopes change little from there.
        """
        key, logs = (term.label, name), np.log([max(value, 1e-300) for _, value in sorted(term.shape.items())])
        if key not in self._slopes or np.abs(self._slopes[key][0] - logs).max() > _NEAR:
            moved = replace(term, shape=dict(term.shape) | {name: term.shape[name] * np.exp(_STEP)})
            made = self.problem.obs.distinct_harmonics(moved.instance, moved.shape, keep=False)
            self._slopes[key] = logs, (self.each([made]).T - self.columns_between(term)) / _STEP
        return self._slopes[key][1]

    def each(self, made: Sequence[tuple[Floats, Indices]]) -> Floats:
        """Return whitened columns, one after the other, shape (columns, m). ``made``: as ``Candidates.harmonics`` gives them."""
        out = np.empty((sum(rows.shape[2] for rows, _ in made), len(self.y)))
        at = 0
        for rows, of in made:
            k = rows.shape[2]
            part, at = out[at : at + k], at + k
            if len(rows) == len(self.root) < len(of) and self.problem.zero_weight == 1.0:
                cells = self._factors.size
                np.multiply(
                    rows.transpose(2, 0, 1), self._factors, out=part[:, :cells].reshape(k, *self._factors.shape)
                )
                part[:, cells:] = 0.0
            else:
                part[:] = self._condensed(self.problem.weighted(rows, of)).T
        return out

    @cached_property
    def _factors(self) -> Floats:
        """Weight of each coefficient of each condition, shape (conditions, n)."""
        return np.outer(self.root, self.problem.weights)

    def given(self, terms: Iterable[Term]) -> Condensed:
        """Return the same with further effects known."""
        made = self
        for term in terms:
            made = replace(made, basis=np.concatenate([made.basis, made.visible(term)[0]], axis=1))
        return made

    def visible(self, term: Term) -> tuple[Floats, Floats]:
        """Return the columns of a term that nothing known can imitate, shape (m, j), and the share of each."""
        return beside(self.basis, self.columns(term), least_visible(term))

    def expanded(self, vectors: Floats) -> Floats:
        """Return vectors of shape (m, k) with all rows, shape (rows * n, k)."""
        n, k = self.problem.obs.n_bins, vectors.shape[1]
        cells = vectors[: len(self.root) * n].reshape(-1, n, k) / self.root[:, None, None]
        return np.asarray(cells[self.condition_of].reshape(-1, k) + self.between @ vectors[len(self.root) * n : -1])

    def _condensed(self, rows: Floats) -> Floats:
        """Return vectors of shape (rows, n, k) as shape (m, k)."""
        k = rows.shape[2]
        cells, left = _parted(rows, self.condition_of, self.root)
        return np.concatenate([cells.reshape(-1, k), self.between.T @ left.reshape(-1, k), np.zeros((1, k))])


def condensed(problem: Problem, candidates: Candidates) -> Condensed:
    """Return a problem condensed; with all its rows where repeats were not measured in the same places."""
    obs = problem.obs
    own = [i for i in candidates.instances if not obs.is_alike_in_repeats(i)]
    rows_differ = obs.condition_masks is None or any(not (s.smooth and s.grid) for i in own for s in i.effect.shapes)
    of = np.arange(obs.n_rows) if rows_differ else obs.condition_of
    root = np.sqrt(np.bincount(of))
    basis = problem.basis.reshape(obs.n_rows, obs.n_bins, -1)
    terms = [] if rows_differ else [candidates.whitened(problem, Term(i, s)) for i in own for s in _spanning(i)]
    whole = np.concatenate([problem.basis, *terms], axis=1).reshape(obs.n_rows, obs.n_bins, -1)
    between = _directions(whole, of, root)
    empty = np.empty(0)
    blank = Condensed(problem, candidates, empty, empty, between, of, root)
    y = problem.y.reshape(obs.n_rows, obs.n_bins, 1)
    of_y = blank._condensed(y)[:, 0]
    of_y[-1] = np.sqrt(max(0.0, float(problem.y @ problem.y - of_y @ of_y)))
    return replace(blank, y=of_y, basis=blank._condensed(basis))


def _spanning(instance: Instance) -> list[Shape]:
    """Return shapes of an effect whose columns span those of all others between them, to within 1 % of each."""
    values = [np.geomspace(min(s.grid), max(s.grid), _SPANNING) for s in instance.effect.shapes]
    names = [shape.name for shape in instance.effect.shapes]
    return [dict(zip(names, chosen, strict=True)) for chosen in itertools.product(*values)]


def _directions(rows: Floats, condition_of: Indices, root: Floats) -> Floats:
    """Return what columns of shape (rows, n, k) span between the rows of a condition, orthonormal, shape (rows * n, q)."""
    left = _parted(rows, condition_of, root)[1].reshape(-1, rows.shape[2])
    size, whole = (left**2).sum(axis=0), (rows**2).sum(axis=(0, 1))
    differ = size > _ROUNDING * whole
    return orthonormal(left[:, differ] / np.sqrt(size[differ]))


def _parted(rows: Floats, condition_of: Indices, root: Floats) -> tuple[Floats, Floats]:
    """Return the sums over each condition divided by the root of their number, and what is left of every row."""
    cells = condition_sums(rows, condition_of) / root[:, None, None]
    return cells, rows - (cells / root[:, None, None])[condition_of]
