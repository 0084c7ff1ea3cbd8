"""What one test of a machine adds to the series of its figures, and of the sizes of its faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.machine_record import MachineRecord
from dtwin.physics.fit import fit
from dtwin.physics.machine_terms import own_term
from dtwin.physics.problem import Term
from dtwin.physics.several_twin import SeveralTwin
from dtwin.physics.twin import Twin
from dtwin.pipeline.kept import kept
from dtwin.pipeline.machine_series import Point, Series
from dtwin.report.faults import sizes_of
from dtwin.report.sheet import number_of
from dtwin.twins.measured import load


def add_figures(
    series: dict[tuple[str, ...], Series],
    others: dict[tuple[str, ...], Series],
    sheet: Mapping[str, Any] | None,
    kind: str,
    record: MachineRecord,
    point: Point,
) -> None:
    """Add the figures of a test sheet: the one that stands for the whole, and those that have a tolerance; apart the others."""
    for part in [] if sheet is None else sheet["parts"]:
        symbols = [c["symbol"] for c in part["characteristics"]]
        wanted = {*kind_named(kind).limits(record.tolerances), (sheet or {})["headline"]}
        for c in part["characteristics"]:
            watched = c["symbol"] in (wanted if wanted & set(symbols) else symbols[:1])
            new = Series(part["title"], c["symbol"], c["unit"], (), number_of(c, "low"), number_of(c, "high"))
            expanded = float("nan") if number_of(c, "expanded") is None else number_of(c, "expanded")
            _append(
                series if watched else others,
                ("figure", kind, part["title"], c["symbol"]),
                new,
                point,
                number_of(c, "value"),
                expanded,
            )


def add_sizes(series: dict[tuple[str, ...], Series], sizes: Sequence[Sequence[Any]], point: Point) -> None:
    """Add the sizes of effects."""
    for title, figure, value, expanded, unit in sizes:
        half = float("nan") if expanded is None else expanded
        _append(series, ("size", title, figure), Series(title, figure, unit, ()), point, value, half)


def _append(
    series: dict[tuple[str, ...], Series],
    key: tuple[str, ...],
    new: Series,
    point: Point,
    value: float,
    expanded: float,
) -> None:
    known = series.get(key, new)
    series[key] = replace(known, points=(*known.points, replace(point, value=value, expanded=expanded)))


def sizes(home: Home, campaign: str, stamp: str, twins: Sequence[Twin]) -> list[list[Any]]:
    """Return title, parameter, value, uncertainty (k = 2) and unit of the effects of twins, fitted to this campaign alone."""
    by_effect: dict[tuple[str, str], list[Any]] = {}
    # One name for each cause, whichever twin it is in: that of a twin of several tests, where there is one.
    ordered = sorted(twins, key=lambda twin: not isinstance(twin, SeveralTwin))
    named = [term for twin in ordered for term in twin.terms]
    for twin in twins:
        terms = [(t.label, dict(t.shape), own_term(t, named).label) for t in twin.terms]
        fitted = partial(_fitted, home, campaign, twin, named)
        made = kept(home, f"sizes/{twin.name}", campaign, f"{stamp} {terms}", fitted)
        by_effect |= {(row[0], row[1]): row for row in made}
    return list(by_effect.values())


def _fitted(home: Home, campaign: str, twin: Twin, named: Sequence[Term]) -> list[list[Any]]:
    try:
        obs = load(home, campaign).obs
        if isinstance(twin, SeveralTwin):
            kinds = [about["kind"] for about in twin.about]
            pairs = zip(twin.parts, kinds, strict=True)
            alike = [p for p, kind in pairs if kind == obs.grid.kind and set(p.box.planes) == set(obs.planes)]
            if not alike:
                return []
            twin = alike[-1]
        if any(obs.grid.kind not in term.instance.effect.kinds for term in twin.terms):
            return []
        estimates = fit(obs, twin.terms).estimates
    except InputError:  # Of another kind, or of planes and axes that the twin does not have.
        return []
    rows: list[list[Any]] = []
    for term in twin.terms:
        effect, axis = term.instance.effect, term.instance.axis
        title = own_term(term, named).instance.effect.title
        title = f"{title}, {axis}" if axis else title
        mine = sizes_of([e for e in estimates if (e.effect, e.axis) == (effect.name, axis)])
        rows += [[title, name if len(mine) > 1 else "", value, spread, unit] for name, value, spread, unit in mine]
    return rows
