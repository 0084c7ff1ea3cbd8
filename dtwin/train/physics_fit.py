"""Fit the physics library: orders, alignment, terms, and the front over their number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dtwin.schema import Floats
from dtwin.train.gram import Sums, forward_order, solve, sums_of, total
from dtwin.train.library import Gear, Library, Mode
from dtwin.train.mode_search import find_modes
from dtwin.train.order_search import find_gears
from dtwin.train.rows import Rows, gather, thinned

RIDGE = 1e-3
# Within this of the best held-out error the smaller equation wins.
ELBOW = 1.03
_SEARCH_EVERY = 4
_NEVER_MOVES = 1e-9
DEAD_SHARE = 1e-3
_LAG_RANGE_S, _LAG_STEP_S, _LAG_ROUNDS = 0.040, 0.002, 2
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class FrontPoint:
    """One size of the equation.

    Attributes
    ----------
    terms : int
        Number of terms.
    held_out_rms_um : float
        Error on feeds that were left out as a whole.
    radius_out_rms_um : float
        Error on radii that were left out as a whole: extrapolation.
    """

    terms: int
    held_out_rms_um: float
    radius_out_rms_um: float


@dataclass(frozen=True)
class PhysicsFit:
    """A fitted physics library.

    Attributes
    ----------
    rows : Rows
        Rows with refined alignment.
    library : Library
        All terms.
    design, absorbed : ndarray, shape (n, p)
        Terms at the rows, centre and radius of set-ups taken out; and what was taken out.
    chosen : tuple of int
        Columns of the proposed equation.
    weights : ndarray, shape (len(chosen),)
        Their coefficients, fitted on all rows.
    front : tuple of FrontPoint
        Error over size.
    lag_shift_s : float
        RMS by which the alignment of single runs was corrected.
    """

    rows: Rows
    library: Library
    design: Floats
    absorbed: Floats
    chosen: tuple[int, ...]
    weights: Floats
    front: tuple[FrontPoint, ...]
    lag_shift_s: float


def fit_physics(rows: Rows, progress: Progress | None = None) -> PhysicsFit:
    """Fit the library to a campaign.

    Parameters
    ----------
    rows : Rows
        Rows of all runs, aligned by motion.
    progress : callable, optional
        Called with (done, total, what).
    """
    gears, modes = _search(thinned(rows, _SEARCH_EVERY), progress)
    library = Library(gears, modes)
    columns = np.concatenate([library.columns(run) for run in rows.runs])
    rows, shift_s = _realigned(rows, columns)
    design = rows.without_setups(columns)
    absorbed = columns - design
    cells = cell_sums(rows, design, absorbed)
    chosen, front = _front(rows, library, cells)
    weights = solve(total(list(cells.values())).take(chosen), RIDGE)
    return PhysicsFit(
        rows, library, design, absorbed, tuple(chosen), weights, tuple(front), shift_s
    )


def cell_sums(rows: Rows, design: Floats, absorbed: Floats) -> dict[tuple[float, float], Sums]:
    """Return sums by (feed, radius), over the scored rows."""
    feeds, radii = rows.label("feed_mm_min"), rows.label("radius_mm")
    cells = {}
    for feed in np.unique(feeds):
        for radius in np.unique(radii):
            inside = (feeds == feed) & (radii == radius) & rows.scored
            if inside.any():
                cells[(float(feed), float(radius))] = sums_of(
                    design[inside], rows.target_um[inside], absorbed[inside]
                )
    return cells


def held_out_rms(cells: dict[tuple[float, float], Sums], axis: int, chosen: Sequence[int]) -> float:
    """Return the RMS error over groups left out in turn.

    Parameters
    ----------
    cells : dict
        Sums by (feed, radius).
    axis : {0, 1}
        Leave feeds, or radii, out.
    chosen : sequence of int
        Columns of the equation.
    """
    squares, rows = 0.0, 0
    for value in sorted({key[axis] for key in cells}):
        inside = [s for key, s in cells.items() if key[axis] != value]
        outside = total([s for key, s in cells.items() if key[axis] == value]).take(chosen)
        if not inside:
            return float("nan")
        squares += outside.residual(solve(total(inside).take(chosen), RIDGE))
        rows += outside.rows
    return float(np.sqrt(max(squares, 0.0) / rows))


def _search(rows: Rows, progress: Progress | None) -> tuple[list[Gear], list[Mode]]:
    base = Library((), ())
    fixed = np.concatenate([base.columns(run) for run in rows.runs])
    kept: dict[Gear, Floats] = {}

    def explained(gears: Sequence[Gear]) -> Floats:
        for gear in gears:
            if gear not in kept:
                kept[gear] = _gear_columns(rows, gear)
        design = rows.without_setups(np.column_stack([fixed, *(kept[g] for g in gears)]))
        return design @ solve(sums_of(design, rows.target_um), RIDGE)

    gears = find_gears(rows, explained, progress=progress)
    return gears, find_modes(rows, rows.target_um - explained(gears))


def _gear_columns(rows: Rows, gear: Gear) -> Floats:
    library = Library((gear,), ())
    mine = [i for i, a in enumerate(library.atoms) if a.cause == "transmission ripple"]
    return np.concatenate([library.columns(run, mine) for run in rows.runs])


def _realigned(rows: Rows, columns: Floats) -> tuple[Rows, float]:
    """Shift each run's clock to where the equation fits best, keeping the mean shift zero."""
    bounds = np.concatenate([[0], np.cumsum([run.arc.size for run in rows.runs])])
    lags = np.array([run.lag_s for run in rows.runs])
    start = lags.copy()
    steps = np.arange(-_LAG_RANGE_S, _LAG_RANGE_S + 1e-9, _LAG_STEP_S)
    design = rows.without_setups(columns)
    for _ in range(_LAG_ROUNDS):
        predicted = design @ solve(sums_of(design, rows.target_um), RIDGE)
        expected = rows.measured_um - rows.target_um + predicted
        moved = np.zeros(lags.size)
        for i, run in enumerate(rows.runs):
            wanted = expected[bounds[i] : bounds[i + 1]]
            apart = [np.mean((run.target_um(lags[i] + d) - wanted) ** 2) for d in steps]
            moved[i] = steps[int(np.argmin(apart))]
        lags += moved - moved.mean()
        rows = gather(
            [replace(run, lag_s=float(lag)) for run, lag in zip(rows.runs, lags, strict=True)]
        )
    return rows, float(np.sqrt(np.mean((lags - start) ** 2)))


def _front(
    rows: Rows, library: Library, cells: dict[tuple[float, float], Sums]
) -> tuple[list[int], list[FrontPoint]]:
    everything = total(list(cells.values()))
    groups = _pairs(library, everything)
    order = forward_order(everything, groups, RIDGE)
    front: list[FrontPoint] = []
    sets: list[list[int]] = []
    chosen: list[int] = []
    for place, group in enumerate(order, start=1):
        chosen = [*chosen, *groups[group]]
        if place in (1, 2, 3, 5) or place % 4 == 0 or place == len(order):
            sets.append(sorted(chosen))
            front.append(
                FrontPoint(
                    len(chosen), held_out_rms(cells, 0, sets[-1]), held_out_rms(cells, 1, sets[-1])
                )
            )
    worst_of_both = [
        p.held_out_rms_um
        if np.isnan(p.radius_out_rms_um)
        else float(np.hypot(p.held_out_rms_um, p.radius_out_rms_um))
        for p in front
    ]
    limit = ELBOW * min(worst_of_both)
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
