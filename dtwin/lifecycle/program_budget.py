"""How much of the error of a program each cause makes, by what a twin says of the machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle._gcode_compensation import Followed, outside
from dtwin.lifecycle.gcode_program import Move, read_program
from dtwin.physics.machine_terms import own_term
from dtwin.physics.problem import Term
from dtwin.physics.several_twin import SeveralTwin, joined
from dtwin.physics.state import AXES_OF
from dtwin.physics.twin import Twin
from dtwin.report.faults import AS_ZERO, with_k2
from dtwin.report.html import Table
from dtwin.report.text import table
from dtwin.schema import Floats
from dtwin.train.twin_axes import AXES, Motion, term_errors_um
from dtwin.train.twin_terms import choose

# Between two evaluated points.
_STEP_MM = 0.5
_MOST_POINTS = 2_000_000


@dataclass(frozen=True)
class _Cut:
    """What one cause does along a program; every figure in µm.

    ``label``, ``remedy``: the effect, and what to do about it.
    ``rms_um``: RMS over the way, of the vector under "", along X, Y and Z, in the planes XY, YZ and ZX, and ``across`` the
    way: what the workpiece shows.
    ``uncertainty_um``: of the RMS of the vector, expanded, k = 2, from those of the parameters, taken as uncorrelated;
    ``k2_um``: the same of each of ``rms_um``.
    ``largest_um``: largest vector, ``largest_k2_um``: its uncertainty, at that place.
    ``left_um``, ``left_k2_um``: RMS of the vector that all the other causes leave, and its uncertainty.
    """

    label: str
    remedy: str
    rms_um: dict[str, float]
    uncertainty_um: float
    k2_um: dict[str, float]
    largest_um: float
    largest_k2_um: float
    left_um: float
    left_k2_um: float


@dataclass(frozen=True)
class _ProgramBudget:
    """The causes of a program's error, the largest first.

    ``causes``: every effect that says what it does at any place.
    ``every``: all of them together; effects may undo each other, so they are no parts of a sum.
    ``not_told``: effects that are left out, and why.
    ``length_mm``: length of the way at feed; rapid motion does not count.
    ``outside``: share of the way further out than the twin was fitted to.
    """

    causes: tuple[_Cut, ...]
    every: _Cut
    not_told: Mapping[str, str]
    length_mm: float
    outside: float

    def as_dict(self) -> dict[str, Any]:
        made = {**vars(self), "causes": [vars(cut) for cut in self.causes], "every": vars(self.every)}
        return {**made, "not_told": dict(self.not_told)}


def program_budget(twin: Twin, text: str, *, origin_mm: Floats, where: str) -> _ProgramBudget:
    """Return how much each effect of a twin makes of the error of a program.

    Motion at feed is followed in steps of half a millimetre, at the speed that is programmed: what a control does to
    speed in corners is not known here.

    ``origin_mm``, shape (3,): centre of the measured circles in the coordinates of the program.
    ``where``: name of the program, for messages.
    Raises ``InputError`` when the twin has no circles, or the program says something that is not understood, has no motion at feed, or is too long.
    """
    twin, terms = of_circles(twin), twin.terms
    motion, way, step_mm = _followed(text, origin_mm, where)
    not_told = {c.label: c.how for c in map(choose, twin.terms) if not c.included}
    does: dict[str, Floats] = {}
    widths: dict[str, list[Floats]] = {}
    for term in twin.terms:
        if term.label in not_told:
            continue
        try:
            does[term.label] = term_errors_um(term, twin, motion)
        except InputError as error:
            not_told[term.label] = f"{error.message}: {error.got}"
            continue
        widths[term.label] = _widths_um(term, twin, motion)
    total = sum(does.values(), np.zeros(motion.position_mm.shape))
    own = {term.label: own_term(term, terms) for term in twin.terms}
    named = {label: (term.label, term.instance.effect.remedy) for label, term in own.items()}
    together = [width for one in widths.values() for width in one]
    causes = []
    for label, one in does.items():
        others = [width for name, some in widths.items() if name != label for width in some]
        causes.append(_cut(named[label], (one, widths[label]), (total - one, others), way, step_mm))
    every = _cut(("all of them", ""), (total, together), (np.zeros_like(total), []), way, step_mm)
    ordered = tuple(sorted(causes, key=lambda cut: -cut.rms_um[""]))
    return _ProgramBudget(ordered, every, not_told, float(step_mm.sum()), outside(twin, motion) / len(way))


def of_circles(twin: Twin) -> Twin:
    """Return a twin as its circles see it, of several campaigns with the effects that any of them sees, once.

    Raises ``InputError`` when it has none: an instrument along an axis sees nothing across it.
    """
    every = twin.parts if isinstance(twin, SeveralTwin) else (twin,)
    parts = [part for part in every if set(part.box.planes) <= set(AXES_OF)]
    if not parts:
        raise InputError(
            "a budget of a program is of a twin with circles",
            code="budget.circles",
            where=f"twin {twin.name}",
            got=twin.campaign,
            hint="fit circles together with these campaigns",
        )
    terms = {term.label: (term, part) for part in reversed(parts) for term in part.terms}
    return replace(
        parts[0],
        terms=tuple(term for term, _ in terms.values()),
        estimates=tuple(e for term, part in terms.values() for e in part.estimates_of(term)),
        box=joined([part.box for part in parts]),
    )


def _followed(text: str, origin_mm: Floats, where: str) -> tuple[Motion, Floats, Floats]:
    """Return the motion at feed, the direction of the way (n, 3), and the length that each point stands for (n,)."""
    followed, motions, ways, steps, points = Followed(origin_mm), [], [], [], 0
    for move in read_program(text, where):
        if not isinstance(move, Move):
            continue
        if move.rapid or move.started != move.known or move.feed_mm_min <= 0.0:
            # Where a first motion begins is not known.
            followed.turn(np.where(move.started, move.directions(np.array([1.0]))[0], 0.0))
            continue
        for first, last in pairwise(move.quadrants()):
            length_mm = move.length_mm * (last - first)
            n = max(1, math.ceil(length_mm / _STEP_MM))
            points += n
            if points > _MOST_POINTS:
                raise InputError(
                    "the program is too long", code="gcode.size", where=where, got=f"more than {points} points"
                )
            shares = first + (last - first) * (np.arange(n) + 0.5) / n
            followed.turn(move.directions(np.array([0.5 * (first + last)]))[0])
            motions.append(followed.motion(move, shares))
            ways.append(move.directions(shares))
            steps.append(np.full(n, length_mm / n))
    if not motions or sum(float(s.sum()) for s in steps) <= 0.0:
        raise InputError(
            "the program has no motion at feed", code="gcode.empty", where=where, allowed="G1, G2 or G3 with F"
        )
    whole = Motion(
        np.concatenate([m.position_mm for m in motions]),
        np.concatenate([m.velocity_mm_s for m in motions]),
        np.concatenate([m.acceleration_mm_s2 for m in motions]),
    )
    return whole, np.concatenate(ways), np.concatenate(steps)


_Sized = tuple[Floats, list[Floats]]
"""What causes do, shape (n, 3), and what the expanded uncertainty of each of their parameters does."""


def _cut(named: tuple[str, str], own: _Sized, others: _Sized, way: Floats, step_mm: Floats) -> _Cut:
    def seen(axes: str, vectors: Floats) -> Floats:
        if axes == "across":
            return np.asarray(vectors - (vectors * way).sum(axis=1, keepdims=True) * way)
        return vectors[:, [AXES.index(axis) for axis in axes or AXES]]

    does, widths_um = own
    rms, k2 = {}, {}
    for axes in ("", *AXES, *AXES_OF, "across"):
        mine, moved = seen(axes, does), [seen(axes, width) for width in widths_um]
        rms[axes], k2[axes] = _rms(mine, step_mm), _moves(mine, moved, step_mm)
    furthest = np.linalg.norm(does, axis=1).argmax()[None]
    there = [width[furthest] for width in widths_um]
    largest = _rms(does[furthest], np.ones(1)), _moves(does[furthest], there, np.ones(1))
    left, left_widths = others
    return _Cut(*named, rms, k2[""], k2, *largest, _rms(left, step_mm), _moves(left, left_widths, step_mm))


def _widths_um(term: Term, twin: Twin, motion: Motion) -> list[Floats]:
    """Return what the expanded uncertainty of each parameter of an effect does, shape (n, 3) each."""
    name, axis = term.instance.effect.name, term.instance.axis
    widths = [e.uncertainty_at_shape for e in twin.estimates if (e.effect, e.axis) == (name, axis)]
    return [term_errors_um(term, twin, motion, np.eye(len(widths))[k] * w) for k, w in enumerate(widths)]


def _moves(does: Floats, widths_um: list[Floats], step_mm: Floats) -> float:
    """Return how the RMS changes with the uncertainty of each parameter, together."""
    if (rms := _rms(does, step_mm)) <= 0.0:
        return 0.0
    parts = [((width * does).sum(axis=1) * step_mm).sum() / step_mm.sum() / rms for width in widths_um]
    return float(np.hypot.reduce([0.0, *parts]))


def _rms(vectors: Floats, step_mm: Floats) -> float:
    return float(np.sqrt(((vectors**2).sum(axis=1) * step_mm).sum() / step_mm.sum()))


def program_text(budget: _ProgramBudget) -> str:
    """Return the budget of a program for the terminal."""
    shown = program_table(budget)
    return "\n".join([table(shown.head, shown.rows), "", *program_lines(budget)])


def program_table(budget: _ProgramBudget) -> Table:
    """Return every cause, the largest first, and all of them together."""
    parts = [f"{name}, µm" for name in (*AXES, *AXES_OF)]
    head = ["cause", "RMS, µm", *parts, "across the way, µm", "largest, µm", "left without it, µm"]
    rows = [[*_row(cut), _sure(cut.left_um, cut.left_k2_um)] for cut in budget.causes]
    return Table(head, [*rows, [*_row(budget.every), "-"]])


def program_lines(budget: _ProgramBudget) -> list[str]:
    """Return what holds of the table, and the remedy of each cause."""
    lines = [
        f"{budget.length_mm:z.0f} mm at feed, at the speed that is programmed",
        "± is k = 2, from the uncertainties of the parameters, taken as uncorrelated",
    ]
    if budget.outside > 0.0:
        lines.append(f"{100 * budget.outside:z.0f} % of the points lie further out than anything that was measured")
    lines += [f"not in it: {label}: {why}" for label, why in budget.not_told.items()]
    # What may be nothing at all is not mended.
    return [
        *lines,
        *(f"{cut.label}: {AS_ZERO if cut.rms_um[''] <= cut.k2_um[''] else cut.remedy}" for cut in budget.causes),
    ]


def _row(cut: _Cut) -> list[str]:
    parts = [_sure(cut.rms_um[name], cut.k2_um[name]) for name in ("", *AXES, *AXES_OF, "across")]
    return [cut.label, *parts, _sure(cut.largest_um, cut.largest_k2_um)]


def _sure(value_um: float, k2_um: float) -> str:
    return with_k2(value_um, k2_um, "um").removesuffix(" µm")
