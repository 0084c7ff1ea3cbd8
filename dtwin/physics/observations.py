"""A campaign's measurements on one angle grid, with the state of the machine beside them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.physics._kept_columns import condition_key, kept_columns
from dtwin.physics.centres import with_own_centres, without_centre
from dtwin.physics.effect import Instance, Shape
from dtwin.physics.grid import Grid, PathCondition
from dtwin.physics.gridding import CIRCLE, Indices
from dtwin.physics.state import State
from dtwin.physics.whitening import from_harmonics, to_harmonics
from dtwin.schema import Campaign, Floats, Run, RunMeta
from dtwin.units import UM_PER_MM

SETUP_COLUMNS = "setup_"
# Of the sum of squares of a column.
_ROUNDING = 1e-20


@dataclass(frozen=True)
class Observations:
    """Runs of a campaign on the points of one path: on a circle, averaged over degrees.

    Attributes:
        y_um: Mean deviation in each bin, zero where nothing was measured. The part of a centre offset that is of second
            order is taken out. Shape (rows, n).
        mask: Where something was measured. Shape (rows, n).
        condition_of, setup_of, run_of: Condition, set-up and run of each row; a run of several turns has several rows.
            Shape (rows,).
        columns: Logged columns of each row: a number, or an array of shape (n,).
        feed_mm_s: Path speed that was reached. Shape (rows,).
        grid: The n points along the path: on a circle 360.
        wander_um: RMS by which the centre moves from run to run of a set-up, where that is most of what repeats differ by;
            every row then has a centre of its own, and effects are told by what else they do. Otherwise 0.
        told_from: Values of logged columns that rises are counted from, where they are not the means of these rows: of a part
            of a campaign those of the whole, of another campaign those that a twin was fitted at.
    """

    campaign: Campaign
    runs: tuple[RunMeta, ...]
    y_um: Floats
    mask: NDArray[np.bool_]
    conditions: tuple[PathCondition, ...]
    condition_of: Indices
    setups: tuple[str, ...]
    setup_of: Indices
    run_of: Indices
    columns: tuple[Mapping[str, Any], ...]
    feed_mm_s: Floats
    grid: Grid = CIRCLE
    wander_um: float = 0.0
    told_from: Mapping[str, float] = field(default_factory=dict)

    @property
    def n_bins(self) -> int:
        """Number of points along the path."""
        return self.grid.n

    @property
    def n_setup(self) -> int:
        """Number of terms that belong to set-ups."""
        return len(self.grid.setup_names) * len(self.setups)

    @cached_property
    def sense(self) -> Floats:
        """Sense of motion of each row, +1 or -1, shape (rows,)."""
        return np.array([self.conditions[c].sense for c in self.condition_of])

    @cached_property
    def radius_mm(self) -> Floats:
        """Size of the path of each row, shape (rows,)."""
        return np.array([self.conditions[c].radius_mm or 1.0 for c in self.condition_of])

    @cached_property
    def several_speeds(self) -> bool:
        """Whether the feed was changed."""
        return len({c.feed_mm_min for c in self.conditions}) > 1

    @property
    def crossed(self) -> bool:
        """Whether radius and feed were changed apart from each other, so that what grows with either is told."""
        pairs = {(c.radius_mm, c.feed_mm_min) for c in self.conditions}
        return len(pairs) > max(len(set(values)) for values in zip(*pairs, strict=True))

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(self.runs)

    @cached_property
    def there_and_back(self) -> bool:
        """Whether runs go over the path in both senses, so that their rows belong together."""
        return len(set(zip(self.run_of.tolist(), self.condition_of.tolist(), strict=True))) > len(
            set(self.run_of.tolist())
        )

    @property
    def planes(self) -> tuple[str, ...]:
        """Planes that were measured, or axes that moved alone."""
        return tuple(sorted({c.plane for c in self.conditions}))

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that were moved."""
        return tuple(sorted({axis for c in self.conditions for axis in c.axes}))

    @property
    def logged(self) -> tuple[str, ...]:
        """Columns that were logged for every row."""
        common = set.intersection(*(set(c) for c in self.columns))
        return tuple(sorted(common))

    @cached_property
    def clusters(self) -> Indices:
        """Test of each row: the directions of one test share set-up, repeat and everything logged.

        Shape (rows,).
        """
        keys = [
            (
                self.setup_of[i],
                self.conditions[self.condition_of[i]].feed_mm_min,
                meta.repeat,
                tuple(sorted(meta.covariates.items())),
            )
            for i, meta in enumerate(self.runs)
        ]
        numbers = {key: n for n, key in enumerate(dict.fromkeys(keys))}
        return np.array([numbers[key] for key in keys])

    @cached_property
    def place_of(self) -> Indices:
        """Condition of each row without its direction, shape (rows,)."""
        conditions = [self.conditions[c] for c in self.condition_of]
        keys = [(c.plane, c.radius_mm, c.feed_mm_min) for c in conditions]
        numbers = {key: n for n, key in enumerate(dict.fromkeys(keys))}
        return np.array([numbers[key] for key in keys])

    @cached_property
    def centred_columns(self) -> Mapping[str, Floats]:
        """Logged columns minus their mean over the campaign, shape (rows, n) each."""
        return {name: self._logged(name) - mean for name, mean in self.means.items()}

    @cached_property
    def means(self) -> Mapping[str, float]:
        """What rises of the logged columns are counted from."""
        return {n: self.told_from.get(n, float(self._logged(n)[self.mask].mean())) for n in self.logged}

    def _logged(self, name: str) -> Floats:
        return np.array([np.broadcast_to(c[name], self.n_bins) for c in self.columns], dtype=float)

    def rms(self, values: Floats) -> float:
        """Return the RMS of values, shape (rows, n), over what was measured."""
        return float(np.sqrt((values[self.mask] ** 2).mean()))

    def without(self, drop: Sequence[int]) -> Observations:
        """Return the observations without some rows.

        Args:
            drop: Rows to leave out.
        """
        keep = np.setdiff1d(np.arange(self.n_rows), np.asarray(drop, dtype=int))
        return self.take(keep)

    def take(self, rows: Indices) -> Observations:
        """Return some rows, in the order given.

        Args:
            rows: Rows to keep. Shape (k,).
        """
        used = sorted(set(self.condition_of[rows].tolist()))
        new = {old: i for i, old in enumerate(used)}
        setups = sorted(set(self.setup_of[rows].tolist()))
        new_setup = {old: i for i, old in enumerate(setups)}
        return replace(
            self,
            runs=tuple(self.runs[i] for i in rows),
            y_um=self.y_um[rows],
            mask=self.mask[rows],
            conditions=tuple(self.conditions[i] for i in used),
            condition_of=np.array([new[int(i)] for i in self.condition_of[rows]]),
            setups=tuple(self.setups[i] for i in setups),
            setup_of=np.array([new_setup[int(i)] for i in self.setup_of[rows]]),
            run_of=self.run_of[rows],
            columns=tuple(self.columns[i] for i in rows),
            feed_mm_s=self.feed_mm_s[rows],
            told_from=self.means,
        )

    def with_y(self, y_um: Floats) -> Observations:
        """Return the same runs with other measurements, shape (rows, n)."""
        return replace(self, y_um=np.where(self.mask, y_um, 0.0))

    def regressors(self, instance: Instance, shape: Shape) -> Floats:
        """Return the columns of an effect, averaged over the bins.

        Returns:
            um per unit of each parameter, zero where nothing was measured. Shape (rows, n, parameters).
        """
        effect = instance.effect
        out = np.zeros((self.n_rows, self.n_bins, len(effect.parameters)))
        if not self.is_alike_in_repeats(instance):
            for row in range(self.n_rows):
                out[row] = _averaged(self.grid, instance, shape, self._row_states[row])
        else:
            for number, state in enumerate(self._condition_states):
                make = partial(_averaged, self.grid, instance, shape, state)
                key = self._condition_keys[number]
                out[self.condition_of == number] = kept_columns(instance, shape, key, make)
        if not self.wander_um:
            return np.where(self.mask[:, :, None], out, 0.0)
        told = self._told(out)
        # What moves the centre and nothing else would leave rounding, and that be fitted.
        seen = (told**2).sum(axis=(0, 1)) > _ROUNDING * (out**2).sum(axis=(0, 1))
        return np.where(self.mask[:, :, None] & seen, told, 0.0)

    def harmonics(self, instance: Instance, shape: Shape) -> Floats:
        """Return the columns of an effect as coefficients of harmonics, shape (rows, n, parameters)."""
        rows, of = self.distinct_harmonics(instance, shape)
        return np.asarray(rows[of])

    def distinct_harmonics(self, instance: Instance, shape: Shape, *, keep: bool = True) -> tuple[Floats, Indices]:
        """Return the different rows of ``harmonics``, and which of them each row is: ``condition_of`` where repeats agree.

        ``keep``: the shape will be asked for again.
        """
        masks = self.condition_masks
        if masks is None or not self.is_alike_in_repeats(instance):
            return to_harmonics(self.regressors(instance, shape)), np.arange(self.n_rows)
        if keep:
            made = [partial(_averaged, self.grid, instance, shape, state) for state in self._condition_states]
            columns = np.stack(
                [kept_columns(instance, shape, *one) for one in zip(self._condition_keys, made, strict=True)]
            )
        else:
            at = [instance.effect.columns(state, instance.axis, shape) for state in self._condition_states]
            columns = self.grid.averaged(np.stack(at))
        return to_harmonics(self._told(columns) * masks[:, :, None]), self.condition_of

    def _told(self, columns: Floats) -> Floats:
        """Return columns on whole circles, shape (k, n, ...), as runs tell them: without the centre that every row has of its own.

        Like the runs: before places are left out, for there an effect and a part of a circle's centre are no longer apart.
        """
        return from_harmonics(without_centre(to_harmonics(columns))) if self.wander_um else columns

    @staticmethod
    def is_alike_in_repeats(instance: Instance) -> bool:
        """Tell whether an effect does the same in all runs of a condition."""
        return not (instance.effect.within_condition or instance.effect.needs)

    @cached_property
    def condition_masks(self) -> NDArray[np.bool_] | None:
        """Where runs of each condition were measured, shape (conditions, n); None when repeats differ in that."""
        first = np.array([np.flatnonzero(self.condition_of == i)[0] for i in range(len(self.conditions))])
        masks = self.mask[first]
        return masks if np.array_equal(masks[self.condition_of], self.mask) else None

    @cached_property
    def _condition_keys(self) -> list[Hashable]:
        return [condition_key(state) for state in self._condition_states]

    @cached_property
    def _condition_states(self) -> list[State]:
        states: list[State] = []
        for number in range(len(self.conditions)):
            rows = np.flatnonzero(self.condition_of == number)
            feed = float(self.feed_mm_s[rows].mean())
            meta, geometry = self.runs[int(rows[0])], self.campaign.machine_geometry
            states.append(self.grid.state(meta, self.conditions[number], feed, geometry))
        return states

    @cached_property
    def _row_states(self) -> tuple[State, ...]:
        return tuple(self._row_state(row) for row in range(self.n_rows))

    def _row_state(self, row: int) -> State:
        state = self._condition_states[int(self.condition_of[row])]
        columns = {
            name: np.repeat(np.broadcast_to(value, self.n_bins).astype(float), self.grid.fine)
            for name, value in self.columns[row].items()
        }
        for name in [n for n in columns if n.endswith("_c")]:
            rise = self.centred_columns[name][row] if name in self.centred_columns else None
            if rise is not None:
                columns[f"{name[:-2]}_rise_c"] = np.repeat(rise, self.grid.fine)
        return replace(state, columns=columns)


def observe(campaign: Campaign, runs: Sequence[Run]) -> Observations:
    """Put runs on the grid.

    Args:
        runs: Of one kind: circular runs with ``angle_deg`` and ``deviation_um``, outside a marked window samples are left
            out; sweeps with ``position_mm`` and ``error_um``; tones with the command and the tool.

    Raises:
        InputError: When there is no run, or a run lacks what its kind needs or is too short.
    """
    if not runs:
        raise InputError("there is no run to look at", code="twin.no_runs", where=campaign.name)
    grid, rows = kind_named(campaign.kind).rows(runs, _times_h(runs))
    conditions = sorted(
        {row.condition for row in rows}, key=lambda c: (c.plane, c.radius_mm, c.feed_mm_min, c.direction)
    )
    keys = [(row.run.meta.setup, row.condition.mounted) for row in rows]
    setups = list(dict.fromkeys(keys))
    ids = list(dict.fromkeys(run.meta.run_id for run in runs))
    made = Observations(
        campaign=campaign,
        runs=tuple(row.run.meta for row in rows),
        y_um=np.array([row.y_um for row in rows]),
        mask=np.array([row.mask for row in rows]),
        conditions=tuple(conditions),
        condition_of=np.array([conditions.index(row.condition) for row in rows]),
        setups=tuple(f"{name} {mounted}" for name, mounted in setups),
        setup_of=np.array([setups.index(key) for key in keys]),
        run_of=np.array([ids.index(row.run.meta.run_id) for row in rows]),
        columns=tuple(row.columns for row in rows),
        feed_mm_s=np.array([row.feed_mm_s for row in rows]),
        grid=grid,
    )
    return _without_second_order(made) if grid is CIRCLE else made


def _without_second_order(made: Observations) -> Observations:
    """Take out the second-order part of the centre offsets, and log the centres."""
    centres = _centres_um(made)
    columns = tuple(
        {**logged, f"{SETUP_COLUMNS}first_um": a_um, f"{SETUP_COLUMNS}second_um": b_um}
        for logged, (a_um, b_um) in zip(made.columns, centres.tolist(), strict=True)
    )
    made = replace(made, columns=columns)
    return with_own_centres(made.with_y(made.y_um - _second_order_um(made, centres)))


def _times_h(runs: Sequence[Run]) -> list[float]:
    """Return session times; without stated times the order of the runs counts."""
    stated = [_stated_s(run.meta.started) for run in runs]
    if any(time is None for time in stated):
        lengths = [_length_s(run) for run in runs]
        return [float(t) / 3600.0 for t in np.concatenate([[0.0], np.cumsum(lengths)[:-1]])]
    known = [time for time in stated if time is not None]
    return [(time - min(known)) / 3600.0 for time in known]


def _stated_s(started: str) -> float | None:
    try:
        return datetime.fromisoformat(started).timestamp() if started else None
    except ValueError:
        return None


def _length_s(run: Run) -> float:
    t_s = run.samples.get("t_s")
    return float(t_s[-1] - t_s[0]) if t_s is not None and len(t_s) else 1.0


def _centres_um(made: Observations) -> Floats:
    """Return the centre of each row's set-up, shape (rows, 2)."""
    basis = made.grid.setup
    out: Floats = np.zeros((made.n_rows, 2))
    for setup in range(len(made.setups)):
        rows = np.flatnonzero(made.setup_of == setup)
        mask = made.mask[rows]
        design = np.broadcast_to(basis, (len(rows), *basis.shape))[mask]
        out[rows] = np.linalg.lstsq(design, made.y_um[rows][mask], rcond=None)[0][1:]
    return out


def _second_order_um(made: Observations, centres_um: Floats) -> Floats:
    """Return what a centre offset adds to the measured length in second order.

    The distance from a shifted pivot to a point of the commanded circle exceeds the first-order
    term by (a sin t - b cos t)^2 / 2R.
    """
    theta = made.grid.phase_rad
    radius_um = made.radius_mm * UM_PER_MM
    across = np.outer(centres_um[:, 0], np.sin(theta)) - np.outer(centres_um[:, 1], np.cos(theta))
    return np.asarray(across**2 / (2.0 * radius_um[:, None]))


def _averaged(grid: Grid, instance: Instance, shape: Shape, state: State) -> Floats:
    return grid.averaged(instance.effect.columns(state, instance.axis, shape))
