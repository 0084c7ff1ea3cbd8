"""Selectors that must do worse, on the very same cases: all see the library and the residual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from cases import Case
from judge import LIBRARY
from sklearn.linear_model import LassoCV

from dtwin.physics.candidates import applicable, likely_pitches
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Problem, Term, unweighted
from dtwin.physics.twin import chosen_terms
from dtwin.schema import Floats

_KEPT = 1e-6
_INCLUDED = 0.8
_RESAMPLES = 20
_THIN = 4


@dataclass(frozen=True)
class Matrix:
    """Residual and what every candidate could do about it, scaled to unit RMS.

    Attributes:
        y, x: Residual with known effects and set-up taken out, and candidates likewise. Shapes (rows, 360) and (rows,
            360, columns).
        owner: Candidate of each column. Shape (columns,).
        labels: Candidates.
    """

    y: Floats
    x: Floats
    owner: Floats
    labels: tuple[str, ...]

    def grams(self) -> tuple[Floats, Floats, Floats]:
        """Return X'X, X'y and y'y of every row."""
        g = np.einsum("nqi,nqj->nij", self.x, self.x)
        return g, np.einsum("nqi,nq->ni", self.x, self.y), (self.y**2).sum(axis=1)


def matrix_of(case: Case) -> Matrix:
    """Return the selectors' view of a case."""
    obs = observe(case.campaign, case.runs)
    known = chosen_terms(case.known, LIBRARY, obs)
    problem = unweighted(obs, known)
    tried, _ = applicable(LIBRARY, obs, known)
    parts, owner, labels = [], [], []
    for instance in tried:
        if instance.effect.on_spread:
            continue
        columns = _best_shape(problem, obs, Term(instance, instance.effect.start_shape))
        if not columns.shape[1]:
            continue
        parts.append(columns)
        owner += [len(labels)] * columns.shape[1]
        labels.append(instance.label)
    x = np.concatenate(parts, axis=1)
    x = x * np.sqrt(len(x))
    return Matrix(
        problem.residual.reshape(obs.n_rows, -1), x.reshape(obs.n_rows, 360, -1), np.array(owner), tuple(labels)
    )


def _best_shape(problem: Problem, obs: Observations, term: Term) -> Floats:
    """Return the columns of the shape that explains most."""
    effect = term.instance.effect
    shapes = [dict(term.shape)]
    if any(s.name == "pitch_mm" for s in effect.shapes):
        found = likely_pitches(obs, problem.residual, term.instance)
        shapes += [effect.start_shape | {"pitch_mm": pitch} for pitch in found]
    elif len(effect.shapes) == 1:
        shapes += [{effect.shapes[0].name: v} for v in effect.shapes[0].grid]
    best, gain = np.zeros((problem.residual.size, 0)), -1.0
    for shape in shapes:
        columns, _ = problem.visible(problem.whitened(obs.regressors(term.instance, shape)))
        won = float(((columns.T @ problem.residual.ravel()) ** 2).sum())
        if won > gain:
            best, gain = columns, won
    return best


def _sse(g: Floats, b: Floats, yy: float, columns: Floats) -> float:
    if not len(columns):
        return yy
    sub = g[np.ix_(columns, columns)]
    return yy - float(b[columns] @ np.linalg.pinv(sub, rcond=_KEPT, hermitian=True) @ b[columns])


def _forward(m: Matrix, g: Floats, b: Floats, yy: float, n: int, most: int = 40) -> list[int]:
    chosen: list[int] = []
    now = n * np.log(yy)
    while len(chosen) < most:
        tries = []
        for candidate in set(range(len(m.labels))) - set(chosen):
            columns = np.flatnonzero(np.isin(m.owner, [*chosen, candidate]))
            left = max(_sse(g, b, yy, columns), 1e-12)
            tries.append((n * np.log(left) + len(columns) * np.log(n), candidate))
        if not tries or min(tries)[0] >= now:
            break
        now, best = min(tries)
        chosen.append(best)
    return chosen


def _named(m: Matrix, chosen: Sequence[int]) -> list[str]:
    return [m.labels[i] for i in chosen]


def forward_bic(m: Matrix) -> list[str]:
    g, b, yy = (part.sum(axis=0) for part in m.grams())
    return _named(m, _forward(m, g, b, float(yy), m.y.size))


def lasso_cv(m: Matrix) -> list[str]:
    x, y = m.x[:, ::_THIN].reshape(-1, m.x.shape[2]), m.y[:, ::_THIN].ravel()
    order = np.random.default_rng(0).permutation(len(y))
    found = LassoCV(cv=5, alphas=30, max_iter=2000).fit(x[order], y[order])
    used = np.abs(found.coef_) > 1e-6
    return _named(m, sorted(set(m.owner[used].tolist())))


def _stlsq(m: Matrix, g: Floats, b: Floats, threshold_um: float = 0.1) -> list[int]:
    keep = np.ones(len(b), dtype=bool)
    for _ in range(10):
        at = np.flatnonzero(keep)
        if not len(at):
            break
        x = np.linalg.pinv(g[np.ix_(at, at)], rcond=_KEPT, hermitian=True) @ b[at]
        small = np.abs(x) < threshold_um
        if not small.any():
            break
        keep[at[small]] = False
    return sorted(set(m.owner[keep].tolist()))


def stlsq(m: Matrix) -> list[str]:
    g, b, _ = (part.sum(axis=0) for part in m.grams())
    return _named(m, _stlsq(m, g, b))


def bagging(m: Matrix) -> list[str]:
    grams, rights, _ = m.grams()
    rng = np.random.default_rng(0)
    count = np.zeros(len(m.labels))
    for _ in range(_RESAMPLES):
        rows = rng.integers(len(grams), size=len(grams))
        count[_stlsq(m, grams[rows].sum(axis=0), rights[rows].sum(axis=0))] += 1
    return _named(m, np.flatnonzero(count > _INCLUDED * _RESAMPLES).tolist())


def best_r2(m: Matrix) -> list[str]:
    g, b, yy = (part.sum(axis=0) for part in m.grams())
    left = [_sse(g, b, float(yy), np.flatnonzero(m.owner == i)) for i in range(len(m.labels))]
    return [m.labels[int(np.argmin(left))]]


def always_unknown(m: Matrix) -> list[str]:
    return ["?"]


def everything(m: Matrix) -> list[str]:
    return list(m.labels)


CONTROLS: dict[str, Callable[[Matrix], list[str]]] = {
    f.__name__: f for f in (forward_bic, lasso_cv, stlsq, bagging, best_r2, always_unknown, everything)
}


def answers(case: Case) -> dict[str, list[str]]:
    """Return what each control names; ``?`` stands for unknown."""
    if len(case.runs) < 2:
        return {}
    matrix = matrix_of(case)
    return {name: control(matrix) for name, control in CONTROLS.items()}
