"""What each of many effects would take from the pass that was not fitted, while a model grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.schema import Floats

_RANK = 1e-6
_OWN = 1e-3
"""Share of a column that the model must leave for the column to count."""


class Search:
    """Candidates beside a model, as inner products: adding to the model costs a product of its new columns alone.

    ``y``, (n,): deviation in the first and in the second pass, in µm.
    ``pool``, (n, any) each: columns of the candidates in both passes.
    """

    def __init__(self, y: tuple[Floats, Floats], pool: Sequence[tuple[Floats, Floats]]) -> None:
        self._y = y
        self._candidates = len(pool)
        self._model: list[Floats] = [np.zeros((way.size, 0)) for way in y]
        by_width: dict[int, list[int]] = {}
        for number, columns in enumerate(pool):
            by_width.setdefault(columns[0].shape[1], []).append(number)
        self._groups = [_Group(numbers, [pool[i] for i in numbers], y) for numbers in by_width.values()]

    def add(self, columns: tuple[Floats, Floats]) -> None:
        """Add columns, (n, k), to the model."""
        for way, new in enumerate(columns):
            self._model[way] = np.hstack([self._model[way], new])
            for group in self._groups:
                group.add(way, new)

    def left_um(self) -> Floats:
        """Return the RMS on the pass not fitted with each candidate added to the model, in µm, shape (candidates,)."""
        mean_square = np.zeros(self._candidates)
        for one, other in ((0, 1), (1, 0)):
            gram = self._model[one].T @ self._model[one]
            # Columns differ in units by orders of magnitude.
            size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
            inverse = np.linalg.pinv(gram / np.outer(size, size), rcond=_RANK**2, hermitian=True) / np.outer(size, size)
            x = inverse @ (self._model[one].T @ self._y[one])
            left_out = self._y[other] - self._model[other] @ x
            outer = self._model[other].T @ self._model[other]
            for group in self._groups:
                change = group.change(one, inverse, x, outer, self._model[other].T @ left_out)
                mean_square[group.numbers] += (left_out @ left_out + change) / (2.0 * left_out.size)
        return np.asarray(np.sqrt(np.maximum(mean_square, 0.0)))


class _Group:
    """Candidates with equally many columns, w: their inner products in both passes.

    ``numbers``: which candidates they are.
    """

    def __init__(self, numbers: list[int], pool: Sequence[tuple[Floats, Floats]], y: tuple[Floats, Floats]) -> None:
        self.numbers = numbers
        # (c, w, n), (c, w, w), (c, w) and, of the model's k columns, (c, w, k).
        self._rows = [np.stack([columns[way].T for columns in pool]) for way in (0, 1)]
        self._gram = [rows @ rows.swapaxes(1, 2) for rows in self._rows]
        self._with_y = [rows @ values for rows, values in zip(self._rows, y, strict=True)]
        self._with_model = [np.zeros((*rows.shape[:2], 0)) for rows in self._rows]

    def add(self, way: int, new: Floats) -> None:
        self._with_model[way] = np.concatenate([self._with_model[way], self._rows[way] @ new], axis=2)

    def change(self, one: int, inverse: Floats, x: Floats, outer: Floats, model_left: Floats) -> Floats:
        """Return by how much the sum of squares on the other pass changes with each candidate, shape (c,).

        ``inverse``, (k, k): of the model's Gram matrix in the pass ``one``; ``x``, (k,): what is fitted there.
        ``outer``, (k, k) and ``model_left``, (k,): inner products of the model in the other pass with itself and with
        what it leaves there.
        """
        here, there = self._with_model[one], self._with_model[1 - one]
        # What the model says of each candidate's columns, (c, w, k).
        said = here @ inverse
        gram = self._gram[one] - said @ here.swapaxes(1, 2)
        own = np.diagonal(self._gram[one], axis1=1, axis2=2)
        # What the model already says must not come back as a difference of large numbers.
        keep = np.diagonal(gram, axis1=1, axis2=2) > _OWN * own
        gram = gram * keep[:, :, None] * keep[:, None, :]
        with_left = (self._with_y[one] - here @ x) * keep
        gain = (np.linalg.pinv(gram, rcond=_RANK, hermitian=True) @ with_left[..., None])[..., 0] * keep
        across = said @ there.swapaxes(1, 2)
        square = self._gram[1 - one] - across - across.swapaxes(1, 2) + said @ outer @ said.swapaxes(1, 2)
        product = self._with_y[1 - one] - there @ x - said @ model_left
        return np.asarray((gain[:, None, :] @ square @ gain[..., None])[:, 0, 0] - 2.0 * (gain * product).sum(axis=1))
