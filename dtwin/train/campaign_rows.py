"""All rows of a campaign side by side, with set-ups taken out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.schema import Floats
from dtwin.statistics import rms
from dtwin.train.dataset import TickRun


@dataclass(frozen=True)
class Rows:
    """Rows of every run on the controller's clock.

    ``of_run``, shape (n,): which run a row belongs to.
    ``angle_rad``, ``measured_um``, shape (n,): path angle, and the bar's deviation as measured.
    ``target_um``, shape (n,): measured deviation after centre and radius of its set-up are taken out.
    ``scored``, shape (n,): rows inside the marked windows: errors are stated over these.
    """

    runs: tuple[TickRun, ...]
    of_run: NDArray[np.int64]
    angle_rad: Floats
    measured_um: Floats
    target_um: Floats
    scored: NDArray[np.bool_]

    @property
    def n(self) -> int:
        """Number of rows."""
        return self.of_run.size

    def label(self, name: str) -> NDArray[Any]:
        """Return a field of the run's condition for every row."""
        return np.array([getattr(run.meta, name) for run in self.runs])[self.of_run]

    def condition(self) -> NDArray[np.int64]:
        """Return the number of each row's condition: plane, radius, feed, direction."""
        keys = [(r.meta.plane, r.meta.radius_mm, r.meta.feed_mm_min, r.meta.direction) for r in self.runs]
        numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        return np.array([numbers[key] for key in keys])[self.of_run]

    def without_setups(self, values: Floats) -> Floats:
        """Project centre and radius of every set-up out of columns, shape (n,) or (n, p)."""
        absorbed = self.of_setups(values)
        return np.subtract(values, absorbed, out=absorbed)

    def of_setups(self, values: Floats) -> Floats:
        """Return what centre and radius of every set-up make of columns, shape (n,) or (n, p).

        Centre and radius belong to a set-up, never to a run: what they absorb is the same for
        every feed, direction and repeat inside it.
        """
        result = np.empty(np.shape(values))
        setups, of_run = np.unique([run.meta.setup for run in self.runs], return_inverse=True)
        of_row = of_run[self.of_run]
        for setup in range(len(setups)):
            inside = np.flatnonzero(of_row == setup)
            angle = self.angle_rad[inside]
            basis = np.linalg.qr(np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle)]))[0]
            if inside[-1] - inside[0] < inside.size:
                # Without copies, which would be new memory for every set-up.
                together = slice(inside[0], inside[-1] + 1)
                np.matmul(basis, basis.T @ values[together], out=result[together])
            else:
                result[inside] = basis @ (basis.T @ values[inside])
        return result

    def folds(self, group: str) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
        """Yield (training, held-out) row masks, one value of a condition's field left out in turn."""
        label = self.label(group)
        for value in np.unique(label):
            yield label != value, label == value

    def only(self, chosen: NDArray[np.bool_]) -> Rows:
        """Return the rows of the runs of which rows are chosen, with their set-ups taken out anew."""
        return gather([self.runs[i] for i in np.unique(self.of_run[chosen])])

    def blind(self, inside: NDArray[np.bool_]) -> Rows:
        """Return all rows with the targets of whole runs hidden (NaN): for fits that must not see them.

        Centre and radius of a set-up are those of the rows that remain.
        """
        target = np.full(self.n, np.nan)
        target[inside] = self.only(inside).target_um
        return replace(self, measured_um=np.where(inside, self.measured_um, np.nan), target_um=target)

    def rms_um(self, values: Floats) -> float:
        """Return the RMS over the scored rows."""
        return rms(values[self.scored])


def gather(runs: Sequence[TickRun]) -> Rows:
    """Put the rows of all runs side by side."""
    measured = np.concatenate([run.target_um() for run in runs])
    rows = Rows(
        runs=tuple(runs),
        of_run=np.repeat(np.arange(len(runs)), [run.arc.size for run in runs]),
        angle_rad=np.concatenate([run.angle_rad for run in runs]),
        measured_um=measured,
        target_um=measured,
        scored=np.concatenate([run.scored for run in runs]),
    )
    return replace(rows, target_um=rows.without_setups(measured))


def thinned(rows: Rows, every: int) -> Rows:
    """Return every so manieth row of each run."""
    runs = [replace(run, arc=run.arc[::every], scored=run.scored[::every]) for run in rows.runs]
    return gather(runs)


def noise_floor_um(rows: Rows) -> tuple[float, int]:
    """Return what repeats of the same condition disagree by, NaN without any, and its degrees of freedom.

    The unit of replication is the run: profiles over the path angle are averaged per run
    first, repeats of a condition in the same set-up are compared, and their pooled standard
    deviation is the floor that no model's held-out error may go below. Its degrees of freedom count
    each run once.
    """
    bins = 120
    place = (np.degrees(rows.angle_rad) % 360.0 * bins / 360.0).astype(int) % bins
    turn = np.floor(np.degrees(rows.angle_rad) / 360.0).astype(int)
    conditions = rows.condition()
    squares, freedom = 0.0, 0
    for condition in np.unique(conditions):
        inside = (conditions == condition) & rows.scored
        profiles = []
        for run in np.unique(rows.of_run[inside]):
            mine = inside & (rows.of_run == run)
            main = mine & (turn == np.bincount(turn[mine] - turn[mine].min()).argmax() + turn[mine].min())
            count = np.bincount(place[main], minlength=bins)
            total = np.bincount(place[main], weights=rows.target_um[main], minlength=bins)
            with np.errstate(invalid="ignore", divide="ignore"):
                profiles.append(total / count)
        stack = np.array(profiles)
        if len(stack) < 2:
            continue
        known = np.isfinite(stack).all(axis=0)
        if known.any():
            spread = stack[:, known] - stack[:, known].mean(axis=0)
            squares += float(np.sum(spread**2) / known.sum())
            freedom += len(stack) - 1
    return (float(np.sqrt(squares / freedom)) if freedom else float("nan")), freedom
