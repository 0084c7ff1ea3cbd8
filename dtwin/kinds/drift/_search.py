"""What a model of drift lacks, and what pays nothing in it: the one search of checks, training and twins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dtwin.features.time_alone import ALPHA, MATERIAL, TIME_ALONE, is_no_less, needed, share_taken
from dtwin.kinds.drift._model import (
    ALIKE,
    Fitted,
    Series,
    Term,
    fitted,
    held_out,
    left_with_time,
    with_each,
    without_each,
)
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.statistics import gain_tail

_LONG = 6
MOST_RUNGS = 20
"""Terms that a search adds or takes out at most."""
_TAUS_S = tuple(float(t) for t in 60.0 * 2.0 ** np.arange(0, 8.5, 0.5))
_FINER = tuple(2.0 ** (step * np.array([-4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0])) for step in (0.1, 0.02, 0.004))
_FAR_LESS = 0.5
_SURELY = 0.1
"""Share that something takes even where blocks do not agree."""


@dataclass(frozen=True)
class Step:
    """Something that a model lacked: the model with it, the share of squares on held-out blocks, and p over blocks."""

    fitted: Fitted
    said: str
    gain: float
    p_value: float


def missing(series: Series, base: Fitted, progress: Progress = silent) -> list[Step]:
    """Return what a model of steady temperatures lacks, step by step: lags, curves of sensors, further sensors.

    The search begins with every sensor, as that of a twin does: beside a lag that is not yet there, a sensor that is needed
    may seem to pay nothing. Each step is told without what pays nothing in it.
    """
    out: list[Step] = []
    added: list[str] = []
    terms: tuple[Term, ...] = tuple(Term("steady", channel) for channel in series.temperatures_c)
    seen = {term.channel for term in base.terms}
    for done in range(MOST_RUNGS):
        progress(done, MOST_RUNGS, f"search, {len(terms)} sensors")
        best = next((one for one in additions(series, terms) if one.pays), None)
        gone = idle(series, terms) if best is None else ()
        if best is None and not gone:
            break
        terms = rung(terms, best, gone)
        if best is None and not out:
            continue
        model = fitted(series, _needed_alone(series, terms))
        if best is None:
            out[-1] = replace(out[-1], fitted=model)
            continue
        said = f"{best.said} or {TIME_ALONE}" if best.is_as_time else best.said
        out.append(Step(model, said, best.gain, best.p_value))
        added.append(best.added.channel)
    progress(MOST_RUNGS, MOST_RUNGS, "search")
    last = {term.channel for term in out[-1].fitted.terms} if out else set()
    told: list[Step] = []
    for step, channel in zip(out, added, strict=True):
        further = [
            term
            for term, value, k2 in zip(step.fitted.terms, step.fitted.value[1:], step.fitted.k2[1:], strict=True)
            # A sensor that stood in for what came later is none that was missing.
            if term.channel in last - seen - {channel} and abs(value) > k2
        ]
        seen |= {channel, *(term.channel for term in further)}
        told.append(replace(step, said="; ".join([step.said, *(f"the sensor {term.name}" for term in further)])))
    return told


def rung(terms: Sequence[Term], best: Addition | None, gone: Sequence[Term]) -> tuple[Term, ...]:
    """Return the next model of a search: with what pays best, else without the first of what pays nothing."""
    return best.terms if best is not None else tuple(term for term in terms if term != gone[0])


def further(series: Series, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return what a search finds that goes on past what is not sure, where in the end all is sure and surely less is left than by
    terms; else nothing.
    """
    more = _sure_of(series, _searched(series, terms))
    return () if is_no_less(held_out(series, terms).squares, held_out(series, more).squares) else more


def together(series: Series, terms: Sequence[Term], most_um: float) -> tuple[Term, ...]:
    """Return what a search finds that begins with every sensor, where it leaves no more than so much on times held out and,
    without what takes less than half of the squares or is not sure, surely less than terms do; else nothing.

    A sensor may tell nothing while others are absent. What takes less than half may stand for what no term describes.
    """
    chosen = _searched(series, [Term("steady", channel) for channel in series.temperatures_c])
    model = held_out(series, chosen)
    if not model.squares.sum() <= len(series.t_s) * most_um**2:
        return ()
    while chosen:
        takes = [share_taken(without, model.squares) for without in without_each(model, chosen)]
        if min(takes) >= _FAR_LESS:
            break
        chosen = rung(chosen, None, [chosen[int(np.argmin(takes))]])
        model = held_out(series, chosen)
    chosen = _sure_of(series, chosen)
    return () if is_no_less(held_out(series, terms).squares, held_out(series, chosen).squares) else chosen


def _searched(series: Series, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return what a search ends with that begins with terms."""
    chosen = tuple(terms)
    for _ in range(MOST_RUNGS):
        best = next((one for one in additions(series, chosen) if one.pays), None)
        gone = idle(series, chosen) if best is None else ()
        if best is None and not gone:
            break
        chosen = rung(chosen, best, gone)
    return chosen


def _sure_of(series: Series, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """Return the terms that are more than what is left may have made."""
    model = fitted(series, terms)
    return tuple(t for t, v, k2 in zip(terms, model.value[1:], model.k2[1:], strict=True) if abs(v) > k2)


def _needed_alone(series: Series, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """Return terms without those that pay nothing, taken out one after the other."""
    while gone := idle(series, terms):
        terms = rung(terms, None, gone)
    return terms


@dataclass(frozen=True, eq=False)
class Addition:
    """Something that a model may lack.

    ``left`` (blocks,): squares that are left in each block when it was held out, µm².
    ``gain``, ``p_value``: share of them that it takes; over blocks, by Bonferroni over all that were tried.
    ``far_gain``: the share on sixths of the log: where more is left than noise, whatever is smooth fits short stretches.
    ``added``: the term that is new, which may stand in place of an old one of the same sensor.
    ``by_time`` (blocks,): squares that a course of time alone leaves in the place of a further sensor; None for a lag or a
    curve of one that is there already.
    ``series``: of the log.
    """

    left: Floats
    terms: tuple[Term, ...]
    added: Term
    said: str
    gain: float
    p_value: float
    far_gain: float
    by_time: Floats | None
    series: Series

    @cached_property
    def pays(self) -> bool:
        """Whether it takes enough, and surely, and on long stretches, too, and its coefficient is more than its uncertainty.

        Beside another sensor it must not leave far more than time alone: where something settles, every sensor that rises or
        falls by itself takes much of it. One sensor alone may: of a warm-up that further sensors complete.
        """
        if not (self.gain > MATERIAL and self.p_value < ALPHA and self.far_gain > MATERIAL):
            return False
        if (
            len(self.terms) > 1
            and self.by_time is not None
            and share_taken(self.left, self.by_time) > _FAR_LESS
            and gain_tail(self.left, self.by_time) < ALPHA
        ):
            return False
        return self._size > float(self._model.scatter_k2[self._at])

    @cached_property
    def sure(self) -> bool:
        """Whether its coefficient is more than what is left may make of it: else it may only stand in for something."""
        return self._size > float(self._model.k2[self._at])

    @cached_property
    def _model(self) -> Fitted:
        return fitted(self.series, self.terms)

    @property
    def _at(self) -> int:
        return 1 + self.terms.index(self.added)

    @property
    def _size(self) -> float:
        return abs(float(self._model.value[self._at]))

    @cached_property
    def is_as_time(self) -> bool:
        """Whether time alone takes as much, for all that this log tells: what settles, or follows a body without a sensor."""
        return self.by_time is not None and is_no_less(self.by_time, self.left)

    def equals(self, other: Addition) -> bool:
        """Tell whether another takes no more than chance may."""
        return is_no_less(self.left, other.left)


def additions(series: Series, terms: Sequence[Term]) -> list[Addition]:
    """Return what a model may lack, those that leave least first: lags, curves of sensors, further sensors."""
    model = held_out(series, terms)
    before = model.squares
    tried: list[tuple[Floats, tuple[Term, ...], Term, str]] = []
    for i, term in enumerate(terms):
        others = (*terms[:i], *terms[i + 1 :])
        kinds = {"steady": ("lag",), "lag": ("lag2",)}.get(term.kind, ())
        for kind in kinds:
            late, each = _lags(series, others, kind, term.channel)
            # The time constant is chosen on blocks that are not the one it is judged on.
            best = int(np.argmin(each.sum(axis=1)))
            nested = np.array([each[np.argmin(each.sum(axis=1) - each[:, b]), b] for b in range(each.shape[1])])
            evened = held_out(series, others).with_each(series.evened(late[best])[:, None])[0]
            if kind == "lag" and share_taken(evened, nested) <= MATERIAL:
                # What evens the noise of the sensor out is no lag.
                continue
            tried.append(
                (
                    nested,
                    (*others, late[best]),
                    late[best],
                    f"{'a second' if kind == 'lag2' else 'the'} lag of {term.name}",
                )
            )
    used = {term.channel for term in terms}
    more = [Term("curve" if channel in used else "steady", channel) for channel in series.temperatures_c]
    more = [term for term in more if term not in terms]
    for term, left in zip(more, with_each(series, model, more), strict=True):
        said = f"{'the curve of the sensor' if term.channel in used else 'the sensor'} {term.name}"
        tried.append((left, (*terms, term), term, said))
    far = held_out(series, terms, _LONG).squares
    further = any(term.kind == "steady" for _, _, term, _ in tried)
    by_time = left_with_time(series, terms) if further else None
    made = [
        Addition(
            left,
            new,
            term,
            said,
            share_taken(before, left),
            min(1.0, len(tried) * gain_tail(before, left)),
            share_taken(far, held_out(series, new, _LONG).squares),
            by_time if term.kind == "steady" else None,
            series,
        )
        for left, new, term, said in tried
    ]
    # What leaves as much but for rounding stays in the order of the log.
    return sorted(made, key=lambda one: round(float(one.left.sum()) / max(float(before.sum()), 1e-300) / ALIKE))


def best_lag(series: Series, others: Sequence[Term], late: Term) -> Term:
    """Return a lag with the time constant that leaves least on blocks held out, beside others."""
    made, each = _lags(series, others, late.kind, late.channel)
    return made[int(np.argmin(each.sum(axis=1)))]


def _lags(series: Series, others: Sequence[Term], kind: str, channel: str) -> tuple[list[Term], Floats]:
    """Return lags by their time constants, and the squares that each leaves in each block, shape (lags, blocks).

    Finer about the best: a time constant that is a little off leaves what looks like a curve of the sensor.
    """
    made: list[Term] = []
    each: list[Floats] = []
    model = held_out(series, others)
    tried = np.array(_TAUS_S)
    for finer in (*_FINER, None):
        made += [Term(kind, channel, float(tau)) for tau in tried]
        each += list(with_each(series, model, made[len(each) :]))
        if finer is not None:
            tried = made[int(np.argmin(np.array(each).sum(axis=1)))].tau_s * finer
    return made, np.array(each)


def idle(series: Series, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return the terms each of which pays nothing beside the others."""
    model = held_out(series, terms)
    without = without_each(model, terms)
    return tuple(t for t, left in zip(terms, without, strict=True) if not needed(left, model.squares, _SURELY))
