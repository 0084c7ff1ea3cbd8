"""Fit the physics library: orders, modes, alignment, terms, and the front over their number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.circular._library import Gear, Library
from dtwin.kinds.circular._order_search import find_gears, find_modes
from dtwin.kinds.circular._term_columns import Sums, TermColumns, forward_order, solve, sums_of, total
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.statistics import rms
from dtwin.train.campaign_rows import Rows, gather, thinned

_RIDGE = 1e-3
# Within this of the best held-out error the smaller equation wins.
_ELBOW = 1.03
_SEARCH_EVERY = 4
_NEVER_MOVES = 1e-9
DEAD_SHARE = 1e-3
_LAG_RANGE_S, _LAG_STEP_S, _LAG_ROUNDS = 0.040, 0.002, 2
_Cells = Mapping[tuple[float, float], Sums]


@dataclass(frozen=True)
class _FrontPoint:
    """One size of the equation.

    ``held_out_rms_um``, ``radius_out_rms_um``: error on feeds, and on radii, that only the coefficients were fitted
    without: it chooses the size. What is reported of the chosen one is :func:`predicted_left_out`.
    """

    terms: int
    held_out_rms_um: float
    radius_out_rms_um: float


@dataclass(frozen=True)
class PhysicsFit:
    """A fitted physics library.

    ``design``, ``absorbed``, shape (n, p): terms at the rows, centre and radius of set-ups taken out; and what was
    taken out.
    ``chosen``: columns of the proposed equation.
    ``weights``, shape (len(chosen),): their coefficients, fitted on all rows.
    ``lag_shift_s``: RMS by which the alignment of single runs was corrected.
    """

    rows: Rows
    library: Library
    design: Floats
    absorbed: Floats
    chosen: tuple[int, ...]
    weights: Floats
    front: tuple[_FrontPoint, ...]
    lag_shift_s: float


def fit_physics(rows: Rows, columns: TermColumns | None = None, progress: Progress = silent) -> PhysicsFit:
    """Fit the library to a campaign.

    ``rows``: rows of all runs, aligned by motion.
    ``columns``: terms of these runs, or of more, that other fits use too.
    """
    columns = columns or TermColumns(rows.runs)
    library = _search(thinned(rows, _SEARCH_EVERY), columns, progress)
    design = columns.of(library, rows.runs)
    absorbed = rows.of_setups(design)
    design -= absorbed
    rows, shift_s = _realigned(rows, design)
    cells = _cell_sums(rows, design, absorbed)
    chosen, front = _front(library, cells)
    weights = solve(total(list(cells.values())).take(chosen), _RIDGE)
    return PhysicsFit(rows, library, design, absorbed, tuple(chosen), weights, tuple(front), shift_s)


@dataclass(frozen=True)
class _LeftOut:
    """A fit that sees nothing of one group, and will predict it.

    ``group``, ``value``: field of the condition, and its value that is left out.
    ``outside``, (n,): its rows.
    ``predicted``: of these rows, in um, centre and radius of the set-ups not taken out.
    """

    group: str
    value: float
    outside: NDArray[np.bool_]
    predicted: Future[Floats]


def leave_out(
    rows: Rows, groups: Sequence[str], columns: TermColumns, pool: Executor, step: Progress
) -> list[_LeftOut]:
    """Begin to predict every row by equations that saw nothing of the row's group.

    Orders, modes, alignment of the runs, number of terms and coefficients are all found again
    without the group. The rows that are predicted keep the alignment by motion.

    ``rows``: rows of all runs, aligned by motion.
    ``groups``: fields of the condition, each left out by value.
    ``pool``, ``step``: threads in which the fits run side by side, and what each calls after every order it finds.
    """
    return [
        _LeftOut(
            group, rows.label(group)[outside][0], outside, pool.submit(_predicted, rows, columns, inside, outside, step)
        )
        for group in groups
        for inside, outside in rows.folds(group)
    ]


def predicted_left_out(folds: Sequence[_LeftOut], progress: Progress) -> dict[str, Floats]:
    """Return what every row of each group, (n,), is predicted to be by the fits without it."""
    predicted: dict[str, Floats] = {}
    for done, fold in enumerate(folds, start=1):
        predicted.setdefault(fold.group, np.zeros(fold.outside.size))[fold.outside] = fold.predicted.result()
        progress(done, len(folds), f"without {fold.group} {fold.value:g}")
    return predicted


def _predicted(
    rows: Rows, columns: TermColumns, inside: NDArray[np.bool_], outside: NDArray[np.bool_], step: Progress
) -> Floats:
    """Return the prediction of the rows outside by a fit to the rows inside."""
    fit = fit_physics(rows.only(inside), columns, step)
    return columns.of(fit.library, rows.only(outside).runs, fit.chosen) @ fit.weights


def predicted_fresh(fit: PhysicsFit) -> Floats:
    """Predict every run by coefficients that were fitted without it, orders and terms as they are.

    What to expect of a fresh run of a trained condition; not a nested figure.

    Returns (n,): in um, centre and radius of the set-ups not taken out.
    """
    rows, chosen = fit.rows, list(fit.chosen)
    design, absorbed = fit.design[:, chosen], fit.absorbed[:, chosen]
    scored = [np.flatnonzero((rows.of_run == i) & rows.scored) for i in range(len(rows.runs))]
    sums = [sums_of(design[i], rows.target_um[i], absorbed[i]) for i in scored]
    predicted = np.zeros(rows.n)
    for number in range(len(sums)):
        weights = solve(total([*sums[:number], *sums[number + 1 :]]), _RIDGE)
        here = rows.of_run == number
        predicted[here] = (design[here] + absorbed[here]) @ weights
    return predicted


def _cell_sums(rows: Rows, design: Floats, absorbed: Floats) -> _Cells:
    """Return sums over the scored rows by (feed, radius), by run where there is one such pair."""
    keys = [(float(run.meta.feed_mm_min or 0.0), float(run.meta.radius_mm or 0.0)) for run in rows.runs]
    if len(set(keys)) == 1:
        keys = [(float(number), float(number)) for number in range(len(keys))]
    cells: dict[tuple[float, float], Sums] = {}
    ends = np.cumsum([run.arc.size for run in rows.runs])
    # Run by run: copies of all scored rows would be as large as the terms themselves.
    for key, run, end in zip(keys, rows.runs, ends, strict=True):
        here = slice(end - run.arc.size, end)
        scored = rows.scored[here]
        if scored.any():
            sums = sums_of(design[here][scored], rows.target_um[here][scored], absorbed[here][scored])
            cells[key] = cells[key] + sums if key in cells else sums
    return dict(sorted(cells.items()))


def _coefficients_out_rms(cells: _Cells, axis: int, chosen: Sequence[int]) -> float:
    """Return the RMS error over feeds (axis 0) or radii (1) that coefficients are fitted without."""
    squares, rows = 0.0, 0
    for value in sorted({key[axis] for key in cells}):
        inside = [s for key, s in cells.items() if key[axis] != value]
        outside = total([s for key, s in cells.items() if key[axis] == value]).take(chosen)
        if not inside:
            return float("nan")
        squares += outside.residual(solve(total(inside).take(chosen), _RIDGE))
        rows += outside.rows
    return float(np.sqrt(max(squares, 0.0) / rows))


def _search(rows: Rows, columns: TermColumns, progress: Progress) -> Library:
    """Return the library with the orders and modes that the rows, thinned ones, show."""
    equation = _Growing(rows, columns)
    gears = find_gears(rows, equation.explained, progress=progress)
    return Library(gears, find_modes(rows, rows.target_um - equation.explained(gears)))


class _Growing:
    """An equation that gears join one after the other: only what a new gear adds to its sums is computed.

    ``rows``: thinned.
    """

    def __init__(self, rows: Rows, columns: TermColumns) -> None:
        self._rows, self._columns = rows, columns
        self._parts: dict[Gear | None, Floats] = {}
        self._gram, self._moment = np.zeros((0, 0)), np.zeros(0)
        self._add(None)

    def explained(self, gears: Sequence[Gear]) -> Floats:
        """Return what the equation explains with all gears so far, these among them, (n,)."""
        for gear in gears:
            if gear not in self._parts:
                self._add(gear)
        sums = Sums(self._gram, self._moment, 0.0, self._rows.n, np.zeros_like(self._gram))
        parts = list(self._parts.values())
        weights = np.split(solve(sums, _RIDGE), np.cumsum([part.shape[1] for part in parts])[:-1])
        return np.sum([part @ weight for part, weight in zip(parts, weights, strict=True)], axis=0)

    def _add(self, gear: Gear | None) -> None:
        new = self._rows.without_setups(self._columns.part(gear, self._rows.runs, every=_SEARCH_EVERY))
        self._parts[gear] = new
        across = np.concatenate([part.T @ new for part in self._parts.values()])
        before = len(self._gram)
        self._gram = np.block([[self._gram, across[:before]], [across.T]])
        self._moment = np.concatenate([self._moment, new.T @ self._rows.target_um])


def _realigned(rows: Rows, design: Floats) -> tuple[Rows, float]:
    """Shift each run's clock to where the equation fits best, keeping the mean shift zero."""
    bounds = np.concatenate([[0], np.cumsum([run.arc.size for run in rows.runs])])
    lags = np.array([run.lag_s for run in rows.runs])
    start = lags.copy()
    steps = np.arange(-_LAG_RANGE_S, _LAG_RANGE_S + 1e-9, _LAG_STEP_S)
    sums = sums_of(design, rows.target_um)
    for _ in range(_LAG_ROUNDS):
        predicted = design @ solve(replace(sums, moment=design.T @ rows.target_um), _RIDGE)
        expected = rows.measured_um - rows.target_um + predicted
        moved = np.zeros(lags.size)
        for i, run in enumerate(rows.runs):
            shifted = run.target_um(lags[i] + steps[:, None])
            apart = np.mean((shifted - expected[bounds[i] : bounds[i + 1]]) ** 2, axis=1)
            moved[i] = steps[int(np.argmin(apart))]
        lags += moved - moved.mean()
        rows = gather([replace(run, lag_s=float(lag)) for run, lag in zip(rows.runs, lags, strict=True)])
    return rows, rms(lags - start)


def _front(library: Library, cells: _Cells) -> tuple[list[int], list[_FrontPoint]]:
    if len(cells) < 2:
        raise InputError(
            "the size of an equation cannot be chosen from a single run",
            code="train.grid",
            allowed="two runs at least with any one feed or radius left out",
        )
    everything = total(list(cells.values()))
    groups = _pairs(library, everything)
    order = forward_order(everything, groups, _RIDGE)
    front: list[_FrontPoint] = []
    sets: list[list[int]] = []
    chosen: list[int] = []
    for place, group in enumerate(order, start=1):
        chosen = [*chosen, *groups[group]]
        if place in (1, 2, 3, 5) or place % 4 == 0 or place == len(order):
            sets.append(sorted(chosen))
            errors = [_coefficients_out_rms(cells, axis, sets[-1]) for axis in (0, 1)]
            front.append(_FrontPoint(len(chosen), *errors))
    judged = np.array([[p.held_out_rms_um, p.radius_out_rms_um] for p in front])
    # A single feed, or radius, cannot be left out: its column is NaN.
    worst_of_both = np.sqrt(np.nansum(judged**2, axis=1))
    limit = _ELBOW * worst_of_both.min()
    best = next(i for i, error in enumerate(worst_of_both) if error <= limit)
    return sets[best], front


def _pairs(library: Library, sums: Sums) -> list[list[int]]:
    """Return columns that belong together, cosine and sine of one wave, if they ever move."""
    size = np.sqrt(np.diag(sums.gram) / sums.rows)
    groups: dict[str, list[int]] = {}
    for i, atom in enumerate(library.atoms):
        if size[i] < _NEVER_MOVES * float(size.max()):
            continue
        groups.setdefault(atom.name.replace("cos(", "wave(").replace("sin(", "wave("), []).append(i)
    return list(groups.values())
