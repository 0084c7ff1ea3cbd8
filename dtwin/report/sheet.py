"""A test sheet: the figures of a standard for each condition, with uncertainty, limits and the decision."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dtwin.report.text import decimals, table
from dtwin.schema import Run
from dtwin.statistics import t_quantile
from dtwin.tolerances import Limits

INSIDE, OUTSIDE, OPEN = "inside", "outside", "cannot say"
_COVERED = 0.95
_MANY_DOF = 1e6


@dataclass(frozen=True)
class Characteristic:
    """One figure of a standard under one condition.

    Attributes
    ----------
    symbol, name : str
        As in the standard, and in words.
    value_um : float
        Mean of the repeats.
    repeats : int
        Evaluations that it is the mean of; the unit of replication is the run, or the pair of runs.
    deviation_um : float
        Standard deviation of one evaluation, NaN when it is not known.
    dof : float
        Degrees of freedom of that.
    expanded_um : float
        Half width that covers 95 %, NaN when it is not known.
    """

    symbol: str
    name: str
    value_um: float
    repeats: int = 1
    deviation_um: float = math.nan
    dof: float = 0.0
    expanded_um: float = math.nan
    limits: Limits | None = None

    @property
    def decision(self) -> str:
        """``inside``, ``outside`` or ``cannot say`` after ISO 14253-1; empty without limits."""
        if self.limits is None:
            return ""
        over = -math.inf if self.limits.high_um is None else self.value_um - self.limits.high_um
        under = -math.inf if self.limits.low_um is None else self.limits.low_um - self.value_um
        beyond = max(over, under)
        if not math.isfinite(self.expanded_um) or abs(beyond) < self.expanded_um:
            return OPEN
        return OUTSIDE if beyond > 0 else INSIDE

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping; ``shown`` is rounded to two digits of the uncertainty."""
        known = math.isfinite(self.expanded_um)
        digits = decimals(self.expanded_um) if known else 2 if abs(self.value_um) >= 1.0 else 4
        return {
            "symbol": self.symbol,
            "name": self.name,
            "value_um": self.value_um,
            "expanded_um": self.expanded_um if known else None,
            "repeats": self.repeats,
            "low_um": None if self.limits is None else self.limits.low_um,
            "high_um": None if self.limits is None else self.limits.high_um,
            "decision": self.decision,
            "shown": {
                "value": f"{self.value_um:z.{digits}f}",
                "expanded": f"± {self.expanded_um:z.{digits}f}" if known else "-",
                "limit": str(self.limits or "-"),
            },
        }


@dataclass(frozen=True)
class Part:
    """The figures of one condition.

    Attributes
    ----------
    sound : bool
        Whether the runs are free of errors of quality; otherwise nothing is decided.
    """

    title: str
    runs: tuple[str, ...]
    characteristics: tuple[Characteristic, ...]
    sound: bool = True


@dataclass(frozen=True)
class Sheet:
    """The figures of a campaign after one standard.

    Attributes
    ----------
    headline : str
        Symbol of the figure that stands for the whole.
    basis : str
        Where the uncertainty comes from, and what is not in it.
    notes : tuple of str
        What was left out, and why.
    """

    standard: str
    headline: str
    parts: tuple[Part, ...]
    basis: str = ""
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        parts = [
            {
                "title": p.title,
                "runs": list(p.runs),
                "characteristics": [c.as_dict() for c in p.characteristics],
                "verdict": _worst(c.decision for c in p.characteristics),
            }
            for p in self.parts
        ]
        return {
            "standard": self.standard,
            "headline": self.headline,
            "verdict": _worst(c.decision for p in self.parts for c in p.characteristics),
            "parts": parts,
            "basis": self.basis,
            "notes": list(self.notes),
        }


def _worst(decisions: Iterable[str]) -> str:
    """Return the worst of some decisions; empty when none was made."""
    made = set(decisions)
    return next((d for d in (OUTSIDE, OPEN, INSIDE) if d in made), "")


def sound_runs(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Return the runs of one condition that have no error of quality, and a note on each other one.

    When every run has one, all are returned, and the notes say so.
    """
    errors = {run.meta.run_id: [f for f in run.findings if f.severity == "error"] for run in runs}
    sound = [run for run in runs if not errors[run.meta.run_id]]
    what = "is not evaluated" if sound else "is evaluated, though not sound"
    notes = [f"{name} {what}: {found[0].code}." for name, found in errors.items() if found]
    return sound or list(runs), notes


def repeated(symbol: str, name: str, values_um: Sequence[float]) -> Characteristic:
    """Return the mean of repeated evaluations, with the deviation of one of them."""
    n = len(values_um)
    mean = sum(values_um) / n
    scatter = math.sqrt(sum((v - mean) ** 2 for v in values_um) / (n - 1)) if n > 1 else math.nan
    return Characteristic(symbol, name, mean, n, scatter, float(n - 1))


def pooled(parts: Iterable[Part]) -> tuple[Part, ...]:
    """Return the parts with the deviation of each figure pooled over conditions, degrees of freedom added.

    A condition that was measured once gets the deviation of the others.
    """
    kept = tuple(parts)
    of_symbol: dict[str, list[Characteristic]] = {}
    for part in kept:
        for c in part.characteristics:
            of_symbol.setdefault(c.symbol, []).append(c)

    def with_pool(c: Characteristic) -> Characteristic:
        known = [other for other in of_symbol[c.symbol] if other.dof > 0]
        dof = sum(other.dof for other in known)
        if not dof:
            return c
        variance = sum(other.dof * other.deviation_um**2 for other in known) / dof
        return replace(c, deviation_um=math.sqrt(variance), dof=dof)

    return tuple(replace(part, characteristics=tuple(map(with_pool, part.characteristics))) for part in kept)


def judged(sheet: Sheet, instrument_um: float | None, limits: Mapping[str, Limits]) -> Sheet:
    """Return the sheet with uncertainties, limits and decisions.

    ``sheet``: as a kind of campaign evaluated it.
    ``instrument_um``: expanded uncertainty (k = 2) of a difference of two readings, from the instrument's certificate.
    """

    def complete(c: Characteristic, sound: bool) -> Characteristic:
        scatter = 0.0
        if c.dof > 0:
            factor = t_quantile(0.5 + _COVERED / 2, min(c.dof, _MANY_DOF))
            scatter = factor * c.deviation_um / math.sqrt(c.repeats)
        expanded = math.hypot(scatter, instrument_um or 0.0) if c.dof > 0 and sound else math.nan
        return replace(c, expanded_um=expanded, limits=limits.get(c.symbol))

    parts = tuple(
        replace(p, characteristics=tuple(complete(c, p.sound) for c in p.characteristics)) for p in sheet.parts
    )
    own = "" if instrument_um is None else f", with ±{instrument_um:g} µm of the instrument's certificate"
    known = any(math.isfinite(c.expanded_um) for p in parts for c in p.characteristics)
    basis = (
        f"U covers 95 %: {sheet.basis}{own}. Set-up and temperature are not in it."
        if known
        else "U is not known, for no sound run was repeated: no limit can be decided."
    )
    return replace(sheet, parts=parts, basis=basis)


HEAD = ("value, µm", "U (95 %), µm", "limit, µm", "decision")


def _rows(part: Mapping[str, Any]) -> list[list[str]]:
    shown = [(c, c["shown"]) for c in part["characteristics"]]
    return [
        [f"{c['symbol']}, {c['name']}", s["value"], s["expanded"], s["limit"], c["decision"] or "-"] for c, s in shown
    ]


def sheet_lines(sheet: Mapping[str, Any]) -> list[str]:
    """Return what :meth:`Sheet.as_dict` gave for a terminal: one condition in full, of several a line each."""
    parts = sheet["parts"]
    lines = [f"{sheet['standard']}: {sheet['verdict'] or 'no tolerance is stated'}"]
    if len(parts) == 1:
        lines += table((parts[0]["title"], *HEAD), _rows(parts[0])).splitlines()
    elif parts:
        symbols = list(dict.fromkeys(c["symbol"] for part in parts for c in part["characteristics"]))
        rows = []
        for part in parts:
            shown = {c["symbol"]: c["shown"] for c in part["characteristics"]}
            cells = [" ".join((shown[s]["value"], shown[s]["expanded"])) if s in shown else "-" for s in symbols]
            rows.append([part["title"], *(cell.removesuffix(" -") for cell in cells), part["verdict"] or "-"])
        lines += table(("µm", *symbols, "decision"), rows).splitlines()
    return [*lines, sheet["basis"], *sheet["notes"]]
