"""A test sheet: the figures of a standard for each condition, with uncertainty, limits and the decision."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dtwin.report.text import decimals, micrometres, table
from dtwin.report.uncertainty import REPEATABILITY, Budget, Contribution, combined
from dtwin.schema import Run
from dtwin.tolerances import Limits
from dtwin.units import shown_number, shown_unit

_INSIDE, OUTSIDE, OPEN = "inside", "outside", "cannot say"


@dataclass(frozen=True)
class Characteristic:
    """One figure of a standard under one condition; names that end in ``_um`` are in the unit of its sheet.

    ``symbol``, ``name``: as in the standard, and in words.
    ``value_um``: mean of the repeats.
    ``repeats``: evaluations that it is the mean of; the unit of replication is the run, or the pair of runs.
    ``deviation_um``: standard deviation of one evaluation, NaN when it is not known.
    ``expanded_um``: half width that covers 95 %, NaN when it is not known.
    ``contributions``: what makes it uncertain beside its repeatability, as the kind of campaign says.
    ``too_small``: why the figure is smaller than the truth by an amount that U does not hold, and what to do; empty
    when it is not. Such a figure may be surely beyond a largest value, and never surely within one.
    """

    symbol: str
    name: str
    value_um: float
    repeats: int = 1
    deviation_um: float = math.nan
    dof: float = 0.0
    expanded_um: float = math.nan
    limits: Limits | None = None
    contributions: tuple[Contribution, ...] = ()
    budget: Budget | None = None
    too_small: str = ""

    @property
    def decision(self) -> str:
        """``inside``, ``outside`` or ``cannot say`` after ISO 14253-1; empty without limits."""
        if self.limits is None:
            return ""
        over = -math.inf if self.limits.high_um is None else self.value_um - self.limits.high_um
        under = -math.inf if self.limits.low_um is None else self.limits.low_um - self.value_um
        known = math.isfinite(self.expanded_um)
        if known and max(over, under) <= -self.expanded_um:
            return OPEN if self.too_small and self.limits.high_um is not None else _INSIDE
        # Bounds are included: what may lie on a bound is not proved to be outside. Nor is what is too small, by a lower bound.
        beyond = over if self.too_small else max(over, under)
        return OUTSIDE if known and beyond > self.expanded_um else OPEN

    @property
    def held_back(self) -> bool:
        """Whether it would be decided if the figure were not too small."""
        return bool(self.too_small) and self.decision != replace(self, too_small="").decision

    def as_dict(self, unit: str) -> dict[str, Any]:
        """Return a JSON-ready mapping, whose names end in the unit; ``shown`` is rounded to two digits of the uncertainty."""
        known = math.isfinite(self.expanded_um)
        digits = decimals(self.expanded_um)
        return {
            "symbol": self.symbol,
            "name": self.name,
            "unit": unit,
            f"value_{unit}": self.value_um,
            f"expanded_{unit}": self.expanded_um if known else None,
            "repeats": self.repeats,
            f"low_{unit}": None if self.limits is None else self.limits.low_um,
            f"high_{unit}": None if self.limits is None else self.limits.high_um,
            "decision": self.decision,
            "budget": None if self.budget is None else self.budget.as_dict(unit),
            "shown": {
                "value": f"{self.value_um:z.{digits}f}" if known else micrometres(self.value_um),
                "expanded": f"± {self.expanded_um:z.{digits}f}" if known else "-",
                "limit": str(self.limits or "-"),
            },
        }


@dataclass(frozen=True)
class Part:
    """The figures of one condition.

    ``sound``: whether the runs are free of errors of quality; otherwise nothing is decided.
    """

    title: str
    runs: tuple[str, ...]
    characteristics: tuple[Characteristic, ...]
    sound: bool = True


@dataclass(frozen=True)
class Sheet:
    """The figures of a campaign after one standard.

    ``headline``: symbol of the figure that stands for the whole.
    ``basis``: where the uncertainty comes from, and what is not in it.
    ``notes``: what was left out, and why.
    ``untold``: symbols of figures that have a limit, and that no condition of this test tells: nothing is inside
    without them.
    ``unit``: of figures and limits, ``um`` or ``arcsec``.
    """

    standard: str
    headline: str
    parts: tuple[Part, ...]
    basis: str = ""
    notes: tuple[str, ...] = ()
    untold: tuple[str, ...] = ()
    unit: str = "um"

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        made = [c.decision for p in self.parts for c in p.characteristics]
        parts = [
            {
                "title": p.title,
                "runs": list(p.runs),
                "characteristics": [c.as_dict(self.unit) for c in p.characteristics],
                "verdict": _worst(c.decision for c in p.characteristics),
            }
            for p in self.parts
        ]
        return {
            "standard": self.standard,
            "headline": self.headline,
            "unit": self.unit,
            "verdict": _worst([*made, OPEN] if self.untold else made),
            "parts": parts,
            "basis": self.basis,
            "notes": list(self.notes),
        }


def _worst(decisions: Iterable[str]) -> str:
    """Return the worst of some decisions; empty when none was made."""
    made = set(decisions)
    return next((d for d in (OUTSIDE, OPEN, _INSIDE) if d in made), "")


def sound_runs(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Return the runs of one condition that have no error of quality, and a note on each other one.

    When every run has one, all are returned, and the notes say so.
    """
    errors = {run.meta.run_id: [f for f in run.findings if f.severity == "error"] for run in runs}
    sound = [run for run in runs if not errors[run.meta.run_id]]
    what = "is not evaluated" if sound else "is evaluated, though not sound"
    notes = [
        f"{name} {what}: {findings[0].message.removesuffix('?')}." for name, findings in errors.items() if findings
    ]
    return sound or list(runs), notes


def repeated(symbol: str, name: str, values_um: Sequence[float]) -> Characteristic:
    """Return the mean of repeated evaluations, with the deviation of one of them."""
    n = len(values_um)
    mean = sum(values_um) / n
    scatter = math.hypot(*(v - mean for v in values_um)) / math.sqrt(n - 1) if n > 1 else math.nan
    return Characteristic(symbol, name, mean, n, scatter, float(n - 1))


def pooled(parts: Iterable[Part]) -> tuple[Part, ...]:
    """Return the parts with the deviation of each figure pooled over conditions, degrees of freedom added.

    A condition that was measured once gets the deviation of the others; those that are not sound tell none.
    """
    kept = tuple(parts)
    of_symbol: dict[str, list[Characteristic]] = {}
    for part in kept:
        for c in part.characteristics if part.sound else ():
            of_symbol.setdefault(c.symbol, []).append(c)

    def with_pool(c: Characteristic) -> Characteristic:
        known = [other for other in of_symbol.get(c.symbol, ()) if other.dof > 0]
        dof = sum(other.dof for other in known)
        if not dof:
            return c
        variance = sum(other.dof * other.deviation_um**2 for other in known) / dof
        return replace(c, deviation_um=math.sqrt(variance), dof=dof)

    return tuple(replace(part, characteristics=tuple(map(with_pool, part.characteristics))) for part in kept)


def judged(sheet: Sheet, limits: Mapping[str, Limits], asked: Sequence[str] = ()) -> Sheet:
    """Return the sheet with budgets, uncertainties, limits and decisions.

    ``sheet``: as a kind of campaign evaluated it.
    ``asked``: symbols whose limits the test has to decide; where it does not tell one, nothing is called inside.
    """

    def complete(c: Characteristic, sound: bool) -> Characteristic:
        c = replace(c, limits=limits.get(c.symbol))
        if not c.dof > 0 or not sound:
            return replace(c, expanded_um=math.nan, budget=None)
        basis = f"standard deviation {shown_number(c.deviation_um)} {shown_unit(sheet.unit)}, {shown_number(c.dof)} degrees of freedom"
        scatter = Contribution(REPEATABILITY, c.deviation_um / math.sqrt(c.repeats), basis, c.dof)
        budget = combined([scatter, *c.contributions])
        return replace(c, expanded_um=budget.expanded_um, budget=budget)

    parts = tuple(
        replace(p, characteristics=tuple(complete(c, p.sound) for c in p.characteristics)) for p in sheet.parts
    )
    budgets = [c.budget for p in parts for c in p.characteristics if c.budget is not None]
    taken = dict.fromkeys(c.source for b in budgets for c in b.contributions if c.assumed and c.standard_um)
    assumed = f" Assumed, for nobody stated it: {', '.join(taken)}." if taken else ""
    basis = (
        f"U covers 95 % (k = 2, more where repeats are few); repeatability: {sheet.basis}.{assumed}"
        if budgets
        else "U is not known, for nothing was repeated in sound data: no limit can be decided."
    )
    known = {c.symbol for p in parts for c in p.characteristics}
    untold = tuple(symbol for symbol in asked if symbol not in known)
    notes = [f"{symbol} has a tolerance, and this test does not tell it." for symbol in untold]
    for p in parts:
        of_reason: dict[str, list[str]] = {}
        for c in p.characteristics:
            if c.held_back:
                of_reason.setdefault(c.too_small, []).append(c.symbol)
        notes += [f"{p.title}: {', '.join(held)} cannot be decided: {why}." for why, held in of_reason.items()]
    return replace(sheet, parts=parts, basis=basis, notes=(*sheet.notes, *notes), untold=untold)


def number_of(characteristic: Mapping[str, Any], name: str) -> Any:
    """Return a number of a figure, as :meth:`Characteristic.as_dict` gave it, in the unit of its sheet."""
    return characteristic[f"{name}_{characteristic['unit']}"]


def _rows(part: Mapping[str, Any]) -> list[list[str]]:
    shown = [(c, c["shown"]) for c in part["characteristics"]]
    return [
        [f"{c['symbol']}, {c['name']}", s["value"], s["expanded"], s["limit"], c["decision"] or "-"] for c, s in shown
    ]


def headline_budget(sheet: Mapping[str, Any]) -> tuple[str, list[list[str]]] | None:
    """Return title and rows of the budget of the figure that stands for the whole, where it is largest.

    ``sheet``: as :meth:`Sheet.as_dict` gave it. None when no uncertainty is known.
    """
    known = [
        (abs(number_of(c, "value")), part["title"], c)
        for part in sheet["parts"]
        for c in part["characteristics"]
        if c["symbol"] == sheet["headline"] and c.get("budget")
    ]
    if not known:
        return None
    _, title, c = max(known, key=lambda found: found[0])
    return f"{c['symbol']}, {title}", budget_rows(c)


def budget_rows(characteristic: Mapping[str, Any]) -> list[list[str]]:
    """Return the rows of the budget of a figure, the last two its sum and the expanded uncertainty."""
    budget = characteristic["budget"]
    size = f"standard_{characteristic['unit']}"
    rows = [[c["source"], f"{c[size]:z.3f}", c["basis"]] for c in budget["contributions"]]
    rows.append(["combined", f"{budget[size]:z.3f}", "root of the sum of squares"])
    return [*rows, [f"U (k = {budget['k']:z.2f})", f"{number_of(characteristic, 'expanded'):z.3f}", ""]]


def overview(sheet: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a table with a line for each condition. ``sheet``: as :meth:`Sheet.as_dict` gave it."""
    parts = sheet["parts"]
    symbols = list(dict.fromkeys(c["symbol"] for part in parts for c in part["characteristics"]))
    rows = []
    for part in parts:
        shown = {c["symbol"]: c["shown"] for c in part["characteristics"]}
        cells = [" ".join((shown[s]["value"], shown[s]["expanded"])) if s in shown else "-" for s in symbols]
        rows.append([part["title"], *(cell.removesuffix(" -") for cell in cells), part["verdict"] or "-"])
    return [shown_unit(sheet["unit"]), *symbols, "decision"], rows


def notes_beside(sheet: Mapping[str, Any]) -> list[str]:
    """Return the notes of a sheet that do not say what one of its findings says, beside which they are shown."""
    return [note for note in sheet["notes"] if not any(f["message"] in note for f in sheet["findings"])]


def sheet_lines(sheet: Mapping[str, Any]) -> list[str]:
    """Return what :meth:`Sheet.as_dict` gave for a terminal: one condition in full, of several a line each."""
    parts, unit = sheet["parts"], shown_unit(sheet["unit"])
    lines = [f"{sheet['standard']}: {sheet['verdict'] or 'no tolerance is stated'}"]
    if len(parts) == 1:
        head = (parts[0]["title"], f"value, {unit}", f"U (95 %), {unit}", f"limit, {unit}", "decision")
        lines += table(head, _rows(parts[0])).splitlines()
    elif parts:
        lines += table(*overview(sheet)).splitlines()
    lines.append(sheet["basis"])
    budget = headline_budget(sheet)
    if budget is not None:
        lines += ["", *table((f"Budget of {budget[0]}", f"u (k = 1), {unit}", "from"), budget[1]).splitlines(), ""]
    return [*lines, *sheet["notes"]]
