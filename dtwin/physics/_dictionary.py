"""The library as columns whose products are known: sets of effects are compared in microseconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from dtwin.physics._condensed import condensed
from dtwin.physics.candidates import Candidates, likely_pitches
from dtwin.physics.effect import Instance
from dtwin.physics.problem import Problem, Term, least_visible
from dtwin.schema import Floats

PITCH = "pitch_mm"
# Columns that come later, as pitches and shapes between those of the grids.
_ROOM = 128
_Index = NDArray[np.intp]


@dataclass(frozen=True)
class Entry:
    """An effect in one shape."""

    term: Term
    columns: slice
    free: int

    @property
    def label(self) -> str:
        """Name with axis."""
        return self.term.label

    @property
    def width(self) -> int:
        """Number of its columns."""
        return self.columns.stop - self.columns.start

    @property
    def parity(self) -> str:
        """How it depends on the direction."""
        return self.term.instance.effect.law.direction


class Dictionary:
    """Effects in the shapes of their grids, beside what is known.

    ``problem``: whitened campaign with what is known.
    """

    def __init__(self, problem: Problem, candidates: Candidates) -> None:
        self.problem, self.candidates = problem, candidates
        self.campaign = condensed(problem, candidates)
        self._residual = self.campaign.residual
        self.total = float(self._residual @ self._residual)
        self.entries: list[Entry] = []
        # A column is a row here. Room is left for more of them.
        self._room, self._room_gram = np.empty((0, len(self._residual))), np.empty((0, 0))
        self._right = np.empty(0)
        self._sizes: list[tuple[_Index, _Index, Floats, Floats]] | None = None
        self._roots: dict[bytes, Floats] = {}
        self._numbers: dict[str, list[int]] = {}
        grids = [Term(instance, shape) for instance in candidates.instances for shape in candidates.grid(instance)]
        self.add(grids)

    def add(self, terms: Iterable[Term]) -> list[Entry]:
        """Take more effects in; those that nothing can be seen of are left out."""
        terms = list(terms)
        if not terms:
            return []
        made = [self.candidates.harmonics(term) for term in terms]
        rows = self.campaign.each(made)
        size = np.sqrt(_squares(rows))
        rows /= np.where(size > 0.0, size, 1.0)[:, None]
        basis = self.campaign.basis
        rows -= (rows @ basis) @ basis.T
        number = np.repeat(np.arange(len(terms)), [columns.shape[2] for columns, _ in made])
        seen = (size > 0.0) & (_squares(rows) > np.array([least_visible(term) for term in terms])[number])
        many = np.bincount(number[seen], minlength=len(terms))
        ends = len(self._right) + np.cumsum(many)
        several = self.problem.obs.several_speeds
        new = [
            Entry(term, slice(int(end - k), int(end)), int(k) + len(term.instance.effect.refined_shapes(several)))
            for term, k, end in zip(terms, many, ends, strict=True)
            if k
        ]
        if new:
            self._append(rows if seen.all() else rows[seen])
            for at, entry in enumerate(new, start=len(self.entries)):
                self._numbers.setdefault(entry.label, []).append(at)
            self.entries += new
            self._sizes = None
        return new

    def shapes_of(self, instance: Instance, residual: Floats) -> list[Entry]:
        """Return an effect in the shapes of its grid; in the pitches at which what is left, (rows, n), repeats most."""
        if is_periodic(instance):
            pitches = likely_pitches(self.problem.obs, residual, instance)
            return self._entries(Term(instance, instance.effect.start_shape | {PITCH: pitch}) for pitch in pitches)
        return [self.entries[number] for number in self.numbers_of([instance.label])]

    def numbers_of(self, labels: Iterable[str]) -> list[int]:
        """Return the numbers of the entries with these labels, in whatever shape."""
        return [number for label in labels for number in self._numbers.get(label, ())]

    def _append(self, added: Floats) -> None:
        now, then = len(self._right), len(self._right) + len(added)
        if then > len(self._room):
            most = then + _ROOM
            room, gram = np.empty((most, len(self._residual))), np.empty((most, most))
            room[:now], gram[:now, :now] = self._room[:now], self._gram
            self._room, self._room_gram = room, gram
        self._room[now:then] = added
        cross = self._room[:now] @ added.T
        self._room_gram[:now, now:then], self._room_gram[now:then, :now] = cross, cross.T
        self._room_gram[now:then, now:then] = added @ added.T
        self._right = np.concatenate([self._right, added @ self._residual])

    @property
    def _gram(self) -> Floats:
        return self._room_gram[: len(self._right), : len(self._right)]

    def add_pitches(self, chosen: Sequence[Entry]) -> None:
        """Take in the pitches at which what a set leaves repeats most, and those of the axis's screw in it."""
        rows = self.problem.residual - self.fitted(chosen).reshape(self.problem.obs.n_rows, -1)
        have = {e.label: e.term for e in chosen}
        periodic = [instance for instance in self.candidates.instances if is_periodic(instance)]
        new: list[Term] = []
        for instance in periodic:
            # An axis has one screw.
            pitches = [
                term.shape[PITCH]
                for label, term in have.items()
                if term.instance.axis == instance.axis and PITCH in term.shape and label != instance.label
            ]
            if instance.label not in have:
                pitches += likely_pitches(self.problem.obs, rows, instance, 1)
            new += [Term(instance, instance.effect.start_shape | {PITCH: pitch}) for pitch in pitches]
        self._entries(new)

    def _entries(self, terms: Iterable[Term]) -> list[Entry]:
        """Return the entries of terms, taken in where they are not there yet."""
        terms = list(terms)
        numbers = self.numbers_of({term.label for term in terms})
        there = [e for e in (self.entries[number] for number in numbers) if e.term in terms]
        have = [entry.term for entry in there]
        return [*there, *self.add(term for term in terms if term not in have)]

    def fitted(self, chosen: Sequence[Entry]) -> Floats:
        """Return what a set explains, whitened, shape (rows * n,)."""
        index = _indices(chosen)
        if not len(index):
            return np.zeros_like(self.problem.y)
        root = self._root_of(index)
        along = (root @ (root.T @ self._right[index])) @ self._room[index]
        return self.campaign.expanded(along[:, None])[:, 0]

    def explained(self, chosen: Sequence[Entry]) -> float:
        """Return the sum of squares that a set explains."""
        index = _indices(chosen)
        if not len(index):
            return 0.0
        root = self._root_of(index)
        return float(((root.T @ self._right[index]) ** 2).sum())

    def coefficients(self, chosen: Sequence[Entry], entry: Entry) -> tuple[Floats, Floats]:
        """Return the factors of the columns of one effect of a set, and what each alone explains beside the rest, each of shape (columns,)."""
        index = _indices(chosen)
        root = self._root_of(index)
        at = np.isin(index, np.arange(entry.columns.start, entry.columns.stop))
        values = (root @ (root.T @ self._right[index]))[at]
        return values, values**2 / (root[at] ** 2).sum(axis=1)

    def gains(self, chosen: Sequence[Entry]) -> Floats:
        """Return what each entry would explain beside a set, shape (entries,)."""
        index = _indices(chosen)
        right, gram = self._right, self._gram
        if len(index):
            root = self._root_of(index)
            along = root.T @ gram[index]
            right = right - along.T @ (root.T @ right[index])
        out = np.zeros(len(self.entries))
        for index, columns, least, own in self._by_size():
            if len(chosen):
                part = along[:, columns].transpose(1, 2, 0)
                own = own - part @ part.transpose(0, 2, 1)
            if columns.shape[1] == 1:
                values, turned = own[:, :, 0], right[columns]
            else:
                values, vectors = _of_pairs(own) if columns.shape[1] == 2 else np.linalg.eigh(own)
                turned = (right[columns][:, None, :] @ vectors)[:, 0, :]
            seen = values > least[:, None]
            out[index] = np.where(seen, turned**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)
        return out

    def family(self, chosen: Sequence[Entry], entries: Sequence[Entry]) -> tuple[Floats, Floats, _Index]:
        """Return what each of some entries would explain beside a set, shape (entries,), and how they overlap there.

        That is the products of their columns, made orthonormal within each entry, and how many columns each has.
        """
        index, before = _indices(entries), _indices(chosen)
        own, right = self._gram[np.ix_(index, index)], self._right[index]
        if len(before):
            root = self._root_of(before)
            along = root.T @ self._gram[np.ix_(before, index)]
            own, right = own - along.T @ along, right - along.T @ (root.T @ self._right[before])
        ends = np.cumsum([entry.width for entry in entries])
        parts = [slice(int(end) - entry.width, int(end)) for end, entry in zip(ends, entries, strict=True)]
        roots = [_root(own[p, p], least_visible(e.term)) for p, e in zip(parts, entries, strict=True)]
        sizes = np.array([root.shape[1] for root in roots])
        turn = scipy.linalg.block_diag(*roots)
        owner = np.repeat(np.eye(len(sizes)), sizes, axis=1)
        gains = owner @ (turn.T @ right) ** 2
        return gains, turn.T @ own @ turn, sizes

    def _root_of(self, index: _Index) -> Floats:
        """Return the root of the inverse of the products of some columns; the same sets are asked for again and again."""
        key = index.tobytes()
        if key not in self._roots:
            self._roots[key] = _root(self._gram[np.ix_(index, index)])
        return self._roots[key]

    def _by_size(self) -> list[tuple[_Index, _Index, Floats, Floats]]:
        """Return, for each number k of columns, the entries with k, their columns, what is too little to see, and their products."""
        if self._sizes is None:
            sizes = np.array([e.width for e in self.entries], dtype=int)
            starts = np.array([e.columns.start for e in self.entries], dtype=int)
            least = np.array([least_visible(e.term) for e in self.entries])
            self._sizes = [
                (index, columns, least[index], self._gram[columns[:, :, None], columns[:, None, :]])
                for k in np.unique(sizes)
                for index in [np.flatnonzero(sizes == k)]
                for columns in [starts[index][:, None] + np.arange(k)]
            ]
        return self._sizes


def is_periodic(instance: Instance) -> bool:
    """Tell whether an effect repeats along an axis in a pitch that nothing but the runs tells."""
    shapes = instance.effect.shapes
    return bool(shapes) and shapes[0].name == PITCH and not shapes[0].grid


def dictionary_for(problem: Problem, terms: Iterable[Term]) -> Dictionary:
    """Return a dictionary that takes these terms in: those that differ between repeats must be known from the start."""
    differ = {t.label: t.instance for t in terms if not problem.obs.is_alike_in_repeats(t.instance)}
    return Dictionary(problem, Candidates(problem.obs, list(differ.values())))


def _squares(rows: Floats) -> Floats:
    """Return the sum of squares of each row."""
    return np.asarray(np.einsum("ij,ij->i", rows, rows))


def _indices(chosen: Sequence[Entry]) -> _Index:
    return np.concatenate([np.arange(e.columns.start, e.columns.stop) for e in chosen] or [np.empty(0, dtype=int)])


def _of_pairs(gram: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues, (entries, 2), and eigenvectors of symmetric 2 x 2 matrices: most effects have two numbers."""
    first, second, across = gram[:, 0, 0], gram[:, 1, 1], gram[:, 0, 1]
    angle = 0.5 * np.arctan2(2.0 * across, first - second)
    cos, sin = np.cos(angle), np.sin(angle)
    mean, half = 0.5 * (first + second), np.hypot(0.5 * (first - second), across)
    return np.stack([mean + half, mean - half], axis=1), np.stack([[cos, -sin], [sin, cos]]).transpose(2, 0, 1)


def _root(gram: Floats, least: float = 0.0) -> Floats:
    """Return a root of the inverse, without the directions that are not determined or of which less is left."""
    values, vectors = np.linalg.eigh(gram)
    keep = values > max(least, 1e-9 * max(float(values[-1]), 1e-300))
    return np.asarray(vectors[:, keep] / np.sqrt(values[keep]))
