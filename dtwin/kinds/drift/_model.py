"""What a displacement follows: temperatures, at once or late, and how much is left on times held out.

Unit of replication is the block: a stretch of time, for readings near in time err alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dtwin.features import time_alone
from dtwin.features.time_alone import ALPHA, MATERIAL, share_taken
from dtwin.kinds.drift._held_out import HeldOut
from dtwin.schema import Floats
from dtwin.statistics import gain_tail, t_quantile, usual_size
from dtwin.units import shown_number

_BLOCKS, _LONGER = 24, 12
"""Blocks of a log that are held out, and of a jackknife: what a model lacks goes on from one short block to the next."""
_COARSE_S = tuple(float(t) for t in 60.0 * 2.0 ** np.arange(9))
"""Time constants of lags, about as fine as lags differ."""
_NINE_OF_TEN = 0.9
_DIGITS = 4
ALIKE = 1e-9
"""Share of squares that is rounding."""
_FEWEST_EVEN = 100


@dataclass(frozen=True)
class Term:
    """A column of the model.

    ``kind``: ``steady``: the temperature itself. ``lag``: through one first-order lag of ``tau_s``. ``lag2``: through
    two. ``curve``: its square, for a sensor whose scale is not straight.
    """

    kind: str
    channel: str
    tau_s: float = 0.0

    @property
    def label(self) -> str:
        """As people read it."""
        late = {"lag": " late by ", "lag2": " late twice by "}.get(self.kind)
        if late is not None:
            return f"{self.name}{late}{shown_number(self.tau_s / 60.0)} min"
        return f"{self.name} squared" if self.kind == "curve" else self.name

    @property
    def name(self) -> str:
        """The sensor."""
        return self.channel.removeprefix("temperature_").removesuffix("_c")


@dataclass(frozen=True)
class Series:
    """One log.

    ``t_s``, ``moved_um`` (n,).
    ``sample`` (n,) or None: readings of one sample follow each other at once: they differ by noise alone.
    ``touched_s``: times behind steps that were taken out of ``moved_um``, or of a sensor that slipped; a fit tells what of them is
    left.
    """

    t_s: Floats
    moved_um: Floats
    temperatures_c: dict[str, Floats]
    sample: Floats | None
    touched_s: tuple[float, ...] = ()

    @cached_property
    def block(self) -> Floats:
        """Number of the block of each reading; a sample is in one."""
        key = np.arange(len(self.t_s)) if self.sample is None else np.unique(self.sample, return_inverse=True)[1]
        return np.asarray(key * _BLOCKS // (key.max() + 1))

    @cached_property
    def floor_um(self) -> float:
        """Standard deviation of one reading within its sample, and no less than its last digit leaves; NaN without samples
        that were read again.
        """
        if self.sample is None:
            return float("nan")
        label = np.unique(self.sample, return_inverse=True)[1]
        count = np.bincount(label)
        mean = np.bincount(label, self.moved_um) / count
        dof = len(label) - len(count)
        if dof <= 0:
            return float("nan")
        return max(float(np.sqrt(((self.moved_um - mean[label]) ** 2).sum() / dof)), self.digit_um / np.sqrt(12.0))

    @cached_property
    def next_um(self) -> float:
        """Standard deviation of one reading by what three that follow each other evenly are off a straight line.

        Noise is no more than that: what moves from one reading to the next, as an axis that rests in another place, is in it.
        NaN where fewer than ``_FEWEST_EVEN`` do.
        """
        steps = np.diff(self.t_s)
        usual = np.median(steps) if steps.size else 0.0
        even = (steps > 0.0) & (np.abs(steps - usual) <= 0.5 * usual)
        bent = np.diff(self.moved_um, 2)[even[1:] & even[:-1]]
        if bent.size < _FEWEST_EVEN:
            return float("nan")
        return max(usual_size(bent) / np.sqrt(6.0), self.digit_um / np.sqrt(12.0))

    def evened(self, late: Term) -> Floats:
        """Return the temperature of a lag evened over its time constant to both sides, shape (n,): not late."""
        early = _late(-self.t_s[::-1], self.temperatures_c[late.channel][::-1], late.tau_s)[::-1]
        return np.asarray(0.5 * (self.column(late) + early))

    @cached_property
    def courses(self) -> Floats:
        """What else may move it: each temperature at once, late and squared, and courses of time, about their means, (n, courses)."""
        each = [
            Term(kind, channel, tau)
            for channel in self._unlike
            for kind, taus in (("steady", (0.0,)), ("lag", _COARSE_S), ("curve", (0.0,)))
            for tau in taus
        ]
        made = np.column_stack([*map(self.column, each), *time_alone.courses(self.t_s)])
        return np.asarray(made - made.mean(axis=0))

    @property
    def _unlike(self) -> list[str]:
        """Sensors, of those that read the same the first."""
        out: list[str] = []
        for channel, values in self.temperatures_c.items():
            if all(np.ptp(values - self.temperatures_c[other]) > ALIKE * np.ptp(values) for other in out):
                out.append(channel)
        return out

    @cached_property
    def digit_um(self) -> float:
        """Least difference of two readings: what the display resolves, or nothing where each reading is another."""
        apart = np.diff(np.unique(np.round(self.moved_um, _DIGITS)))
        return float(apart.min()) if apart.size else 0.0

    def column(self, term: Term) -> Floats:
        """Return the column of a term, shape (n,)."""
        values = self.temperatures_c[term.channel]
        if term.kind == "curve":
            return np.asarray((values - values.mean()) ** 2)
        for _ in range({"steady": 0, "lag": 1, "lag2": 2}[term.kind]):
            values = _late(self.t_s, values, term.tau_s)
        return values


@dataclass(frozen=True)
class Fitted:
    """Terms fitted to a log.

    ``value``, ``k2`` (terms + 1,): the constant first; µm, µm/K and µm/K²; half widths cover 95 %, unit of replication
    the block; what is left, as a band, is in them.
    ``scatter_k2`` (terms + 1,): of it what blocks scatter by.
    ``late_k2_s`` (terms,): of time constants; 0 for terms that are not late.
    ``covariance``, ``dof``: of standard uncertainties of the values, behind them the time constants of terms that are late.
    ``left_um``: standard deviation of the residual.
    ``held_out_um``: root mean square on blocks that were held out.
    """

    terms: tuple[Term, ...]
    value: Floats
    k2: Floats
    scatter_k2: Floats
    late_k2_s: Floats
    covariance: Floats
    dof: Floats
    left_um: float
    r2: float
    held_out_um: float


def fitted(series: Series, terms: Sequence[Term]) -> Fitted:
    """Fit terms and a constant by least squares."""
    x, y, told = _design(series, terms), series.moved_um, 1 + len(terms)
    every = np.linalg.lstsq(x, y, rcond=None)[0]
    value: Floats = np.asarray(every[:told], dtype=np.float64)
    left = y - x @ every
    # A jackknife over blocks: readings near in time err alike. Time constants move along, in first order, for they were fitted, too.
    late = [n for n, term in enumerate(terms) if term.tau_s]
    moving = [value[1 + n] * _by_time(series, terms[n]) for n in late]
    wide = np.column_stack([x, *moving])
    each = HeldOut(wide, y, series.block * _LONGER // _BLOCKS).values
    squares, blocks = HeldOut(x, y, series.block).squares, len(each)
    apart = each - each.mean(axis=0)
    off = apart**2
    spread = (blocks - 1) / blocks * off.sum(axis=0)
    # Where a few blocks tell most, as the first hours of a warm-up do, the spread itself is less sure.
    tails = blocks * (off**2).sum(axis=0) / np.maximum(off.sum(axis=0) ** 2, 1e-300)
    dof = np.clip(2.0 * blocks / np.maximum(tails - 1.0, 1e-9), 1.0, blocks - 1)
    times, band = np.array([t_quantile(0.975, float(d)) for d in dof]), _band(series, wide, left)
    scatter = times * np.sqrt(spread)
    k2 = np.hypot(scatter, band)
    late_k2_s = np.zeros(len(terms))
    late_k2_s[late] = k2[x.shape[1] :] * np.array([terms[n].tau_s for n in late])
    kept = [*range(told), *range(x.shape[1], x.shape[1] + len(late))]
    units = np.array([1.0] * told + [terms[n].tau_s for n in late])
    scaled = apart[:, kept] * units
    covariance = (blocks - 1) / blocks * scaled.T @ scaled
    covariance += np.diag((units * (band / times)[kept]) ** 2)
    size = float(np.sqrt((left**2).sum() / max(len(y) - x.shape[1], 1)))
    r2 = 1.0 - float((left**2).sum()) / float(((y - y.mean()) ** 2).sum())
    held = float(np.sqrt(squares.sum() / len(y)))
    return Fitted(
        terms=tuple(terms),
        value=value,
        k2=np.asarray(k2[:told]),
        scatter_k2=np.asarray(scatter[:told]),
        late_k2_s=late_k2_s,
        covariance=np.asarray(covariance),
        dof=dof[kept],
        left_um=size,
        r2=r2,
        held_out_um=held,
    )


def _band(series: Series, x: Floats, left: Floats) -> Floats:
    """Return how far what is left over whole blocks, beyond noise, may move the values of columns, shape (columns,).

    Were all of it made by one course that is not in the model, nine courses of ten would move a value by less.
    """
    size = np.maximum(np.bincount(series.block, minlength=_BLOCKS), 1)
    even = float((np.bincount(series.block, left, minlength=_BLOCKS) ** 2 / size).sum())
    noise = (float((left**2).sum()) - even) / max(len(left) - _BLOCKS, 1)
    beyond = even - (_BLOCKS + 2.0 * np.sqrt(2.0 * _BLOCKS)) * noise
    if not beyond > 0.0:
        return np.zeros(x.shape[1])
    scale = np.sqrt((x**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    along, sizes, turned = np.linalg.svd(x / scale, full_matrices=False)
    kept = sizes > sizes[0] * ALIKE
    parts = along[:, kept].T @ series.courses
    beside = (series.courses**2).sum(axis=0) - (parts**2).sum(axis=0)
    other = beside > ALIKE * (series.courses**2).sum(axis=0)
    moves = turned[kept].T @ (parts[:, other] / sizes[kept, None]) / scale[:, None]
    if not other.any():
        return np.zeros(x.shape[1])
    return np.asarray(np.quantile(np.abs(moves) * np.sqrt(beyond / beside[other]), _NINE_OF_TEN, axis=1))


def left_of(series: Series, terms: Sequence[Term], per_kelvin: Floats) -> tuple[Floats, float]:
    """Return what values of terms leave of a log, shape (n,), its zero and steps fitted; and where the zero lies."""
    x, told = _design(series, terms), 1 + len(terms)
    left = series.moved_um - x[:, 1:told] @ per_kelvin
    own = np.delete(x, np.s_[1:told], axis=1)
    fit = np.linalg.lstsq(own, left, rcond=None)[0]
    return np.asarray(left - own @ fit), float(fit[0])


def steady(series: Series) -> Fitted:
    """Return all temperatures, each taken at once, less those that do not pay on blocks held out."""
    chosen = [Term("steady", channel) for channel in series.temperatures_c]
    while chosen:
        model = held_out(series, chosen)
        now, without = model.squares, without_each(model, chosen)
        sums = without.sum(axis=1)
        # Of sensors that read the same, the first one stays.
        least = int(np.flatnonzero(sums <= (1.0 + ALIKE) * sums.min())[-1])
        if share_taken(without[least], now) > MATERIAL and gain_tail(without[least], now) < ALPHA:
            break
        chosen.pop(least)
    return fitted(series, chosen)


def held_out_um(series: Series, terms: Sequence[Term]) -> Floats:
    """Return what is left of each reading by terms that were fitted without its block, shape (n,)."""
    x = _design(series, terms)
    values = HeldOut(x, series.moved_um, series.block).values
    return np.asarray(series.moved_um - (x * values[series.block]).sum(axis=1))


def held_out(series: Series, terms: Sequence[Term], blocks: int = _BLOCKS) -> HeldOut:
    """Return terms fitted without each block; ``blocks``: fewer are longer."""
    return HeldOut(_design(series, terms), series.moved_um, series.block * blocks // _BLOCKS)


def with_each(series: Series, model: HeldOut, more: Sequence[Term]) -> Floats:
    """Return the squares of a model with each of further terms beside it, shape (terms, blocks), µm²."""
    return model.with_each(np.array([series.column(term) for term in more]).reshape(len(more), series.t_s.size).T)


def without_each(model: HeldOut, terms: Sequence[Term]) -> Floats:
    """Return the squares of a model of terms without each of them, shape (terms, blocks), µm²."""
    return model.without_each(range(1, 1 + len(terms)))


def left_with_time(series: Series, terms: Sequence[Term]) -> Floats:
    """Return the least squares in each block held out with a course of time beside the terms: straight, or an exponential."""
    model = held_out(series, terms)
    return time_alone.left_with_time(series.t_s, lambda course: np.asarray(model.with_each(course[:, None])[0]))


def _by_time(series: Series, late: Term) -> Floats:
    """Return the derivative of the column of a lag by the logarithm of its time constant."""
    step = 0.01
    return (series.column(replace(late, tau_s=late.tau_s * (1.0 + step))) - series.column(late)) / step


def _design(series: Series, terms: Sequence[Term]) -> Floats:
    """Return a constant, the terms, and a step at each touch of the probe."""
    steps = [(series.t_s >= at).astype(np.float64) for at in series.touched_s]
    return np.column_stack([np.ones(len(series.t_s)), *(series.column(term) for term in terms), *steps])


def _late(t_s: Floats, values: Floats, tau_s: float) -> Floats:
    """Return values through a first-order lag, exact for straight lines between readings."""
    gaps, rises = np.diff(t_s), np.diff(values)
    slope = np.divide(rises, gaps, out=np.zeros_like(rises), where=gaps > 0.0)
    kept = np.exp(-gaps / tau_s)
    added = values[1:] - slope * tau_s - kept * (values[:-1] - slope * tau_s)
    # Rows of readings that follow each other are walked side by side from zero, then each begins where the one before ended.
    rows = max(int(np.sqrt(kept.size)), 1)
    steps = max(-(-kept.size // rows), 1)
    share, more = (np.pad(one, (0, rows * steps - kept.size)).reshape(rows, steps) for one in (kept, added))
    out, at, begin = np.empty_like(more), np.zeros(rows), float(values[0])
    for n in range(steps):
        out[:, n] = at = share[:, n] * at + more[:, n]
    for row, left in zip(out, np.cumprod(share, axis=1), strict=True):
        row += left * begin
        begin = row[-1]
    return np.concatenate([values[:1], out.ravel()[: kept.size]])
