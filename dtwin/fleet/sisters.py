"""Sister machines: what machines of one type have in common, which one differs, and what that says of a short test."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.fleet.jobs import DIAGNOSES
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import moved_in
from dtwin.lake.store import Lake
from dtwin.machine_record import read_record
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.twin import chosen_terms
from dtwin.pipeline.kept import kept_already, sheet_of_campaign, stamp_of, variation_of
from dtwin.pipeline.machine_joint import newest_tests
from dtwin.progress import Progress, silent
from dtwin.report.sheet import number_of
from dtwin.schema import Floats
from dtwin.statistics import chi2_quantile, holm, t_tail
from dtwin.twins.measured import load

_FEWEST = 4
_Flags = NDArray[np.bool_]
_ALPHA = 0.05
_CAUTION = 0.1
_ONE_WAY = re.compile(r"[↑↓]$|\(C?CW\)$")
"""In the symbol of a figure of one direction."""


@dataclass(frozen=True)
class _Sister:
    """One size of one machine beside those of its sisters; unit of replication: the machine.

    ``value``, ``k2``: as its own runs tell it, with the uncertainty at k = 2.
    ``with_sisters``, ``with_sisters_k2``: the same with what its sisters say of machines of this type (empirical Bayes,
    the prior made without it); of one that differs its own.
    ``p_value``: of the hypothesis that it is drawn like its sisters, after Holm over all sizes and machines.
    """

    machine: str
    campaign: str
    value: float
    k2: float
    with_sisters: float
    with_sisters_k2: float
    p_value: float
    differs: bool


@dataclass(frozen=True)
class _SisterSize:
    """A size of an effect, or a figure of a test sheet, over machines of one type.

    ``effect``, ``title``: name and title of the effect; of a figure its symbol and what it is called.
    ``name``: which of its sizes; of a figure the condition.
    ``mean``, ``spread``: mean of the machines that do not differ, and standard deviation between them beyond their
    uncertainties.
    """

    effect: str
    title: str
    name: str
    unit: str
    mean: float
    spread: float
    machines: tuple[_Sister, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return asdict(self)


def _pooled(values: Floats, errors: Floats, chance: float | None = None) -> tuple[float, float, float]:
    """Return mean, its standard error, and the standard deviation between machines (Paule and Mandel).

    ``values``, ``errors`` (n,): sizes and their standard uncertainties.
    ``chance``: take the deviation that is exceeded with this chance (Q profile; Viechtbauer 2007), not the most likely
    one.
    """
    dof = values.size - 1
    wanted = dof if chance is None else chi2_quantile(chance, dof)

    def mean_at(between: float) -> tuple[float, Floats]:
        weights = 1.0 / (errors**2 + between)
        return float(weights @ values / weights.sum()), weights

    def too_much(between: float) -> float:
        mean, weights = mean_at(between)
        return float(weights @ (values - mean) ** 2) - wanted

    # At this much the sum of squares is below what is wanted.
    most = float(np.sum((values - values.mean()) ** 2)) / wanted + float(np.max(errors)) ** 2
    between = float(brentq(too_much, 0.0, most)) if too_much(0.0) > 0.0 else 0.0
    mean, weights = mean_at(between)
    return mean, float(weights.sum() ** -0.5), math.sqrt(between)


@dataclass(frozen=True)
class _Compared:
    """Sizes of n machines with what sisters say; arrays of shape (n,).

    ``values``, ``errors``: with sisters, and the standard uncertainties.
    ``p_values``: after Holm, of being drawn like the others.
    ``differs``: those keep the size that their own runs tell.
    """

    values: Floats
    errors: Floats
    p_values: Floats
    differs: _Flags


def _compared(values: Floats, errors: Floats, many: int = 1) -> _Compared:
    """Compare each machine with its sisters: the prior is made without it, and without those that differ already.

    ``values``, ``errors``, shape (n,): sizes that the machines' own runs tell, and standard uncertainties.
    ``many``: number of all tests that are made, for Holm.
    """
    # Few repeats tell little of their own noise: half of it is what the sisters' runs show.
    own, errors = errors, np.sqrt((errors**2 + np.mean(errors**2)) / 2.0)
    differs = _differing(values, errors, many)
    priors = [_prior(values, errors, ~differs, i) for i in range(values.size)]
    p_values = holm([p.p_value(values[i], errors[i]) for i, p in enumerate(priors)], many)
    # That machines are alike is believed only as far as their number shows it.
    careful = [_prior(values, errors, ~differs, i, _CAUTION) for i in range(values.size)]
    shares = np.array([1.0 if differs[i] else p.share(errors[i]) for i, p in enumerate(careful)])
    means = np.array([p.mean for p in careful])
    spread = np.where(differs, own, np.sqrt(shares) * errors)
    return _Compared(shares * values + (1.0 - shares) * means, spread, p_values, differs)


@dataclass(frozen=True)
class _Prior:
    """What sisters say of a machine."""

    mean: float
    error: float
    between: float
    count: int

    def p_value(self, value: float, error: float) -> float:
        """Return the chance of a size as far away, drawn like those of the sisters."""
        apart = abs(value - self.mean) / math.sqrt(self.between**2 + self.error**2 + error**2)
        return 2.0 * t_tail(apart, self.count - 1)

    def share(self, error: float) -> float:
        """Return how much of a size remains its own."""
        prior = self.between**2 + self.error**2
        return prior / (prior + error**2)


def _differing(values: Floats, errors: Floats, many: int) -> _Flags:
    """Return which machines differ: the generalised test of Rosner (1983), in which several do not hide each other.

    The farthest machine is set aside again and again, up to a third; all differ up to the last one that did when it was
    set aside.
    """
    aside = np.zeros(values.size, dtype=bool)
    differs = aside.copy()
    while np.sum(aside) < values.size // 3 and np.sum(~aside) > _FEWEST:
        rest = [int(i) for i in np.flatnonzero(~aside)]
        chances = [_prior(values, errors, ~aside, i).p_value(values[i], errors[i]) for i in rest]
        aside[rest[int(np.argmin(chances))]] = True
        if holm([min(chances)], many)[0] < _ALPHA:
            differs = aside.copy()
    return differs


def _prior(values: Floats, errors: Floats, usual: _Flags, but: int, chance: float | None = None) -> _Prior:
    others = usual.copy()
    others[but] = False
    return _Prior(*_pooled(values[others], errors[others], chance), int(others.sum()))


def sisters(
    home: Home, machines: Sequence[str] = (), type_name: str = "", progress: Progress = silent
) -> list[_SisterSize]:
    """Compare machines of one type by the newest campaign of each: figures of its test sheet, and sizes of effects.

    Figures are those of both directions and those with a tolerance; of tests in one direction all. Effects are those that a
    diagnosis found in any of the machines, each fitted to all that it can act in.

    ``machines``: which; those of the type without.
    ``type_name``: as the records of machines state it.
    Raises ``InputError`` when there are not enough machines with campaigns of the same sort, or neither figures nor
    effects to compare.
    """
    wanted = list(machines) or [m for m in _known(home) if _type(home, m) == type_name]
    tests = _tests(home, wanted)
    names = {name for campaign in tests.values() for name in _found(home, campaign)}
    where = type_name or ", ".join(wanted)[:80]
    if len(tests) < _FEWEST:
        raise InputError(
            "too few sister machines to compare",
            code="fleet.sisters",
            where=where,
            got=f"{len(tests)} machines with a campaign of one sort, of {len(wanted)} machines",
            allowed=f"{_FEWEST} machines at least",
            hint="dtwin machine add NAME --type TYPE; a sort is one kind of test under the same conditions",
        )
    sizes = _figures(home, tests)
    if names:
        sizes |= _sizes(home, tests, sorted(names), progress)
    # Those that enough machines tell; the others say nothing of a type.
    common = {key: rows for key, rows in sizes.items() if len(rows) >= _FEWEST}
    if not common:
        raise InputError(
            "nothing to compare: no figure with an uncertainty under the same conditions, and no effect that a diagnosis found",
            code="fleet.sisters",
            where=where,
            got=", ".join(tests.values())[:80],
            hint="dtwin fleet diagnose; two runs of one condition give figures an uncertainty",
        )
    many = sum(len(rows) for rows in common.values())
    return [_size(key, rows, many) for key, rows in common.items()]


_Key = tuple[str, str, str, str]
_Row = tuple[str, str, float, float]


def _size(key: _Key, rows: Sequence[_Row], many: int) -> _SisterSize:
    values, errors = np.array([row[2] for row in rows]), np.array([row[3] for row in rows]) / 2.0
    comparison = _compared(values, errors, many)
    mean, _, between = _pooled(values[~comparison.differs], errors[~comparison.differs])
    of_machine = tuple(
        _Sister(
            machine,
            campaign,
            value,
            k2,
            float(comparison.values[i]),
            2.0 * float(comparison.errors[i]),
            float(comparison.p_values[i]),
            bool(comparison.differs[i]),
        )
        for i, (machine, campaign, value, k2) in enumerate(rows)
    )
    return _SisterSize(*key, mean, between, of_machine)


def _figures(home: Home, tests: Mapping[str, str]) -> dict[_Key, list[_Row]]:
    """Return the figures of test sheets, condition by condition."""
    figures: dict[_Key, list[_Row]] = {}
    for machine, campaign in tests.items():
        rows = Lake(home.lake).runs(campaign, left_out=True)
        if not kind_named(rows[0]["kind"]).offers("sheet"):
            continue
        sheet = sheet_of_campaign(home, campaign, machine, stamp_of(rows), variation_of(home, machine))
        for part in sheet["parts"]:
            both = [c for c in part["characteristics"] if not _ONE_WAY.search(c["symbol"])]
            for c in part["characteristics"]:
                # One more for each direction would say the same again, and every comparison costs the others power.
                if number_of(c, "expanded") and (c in both or not both or c["decision"]):
                    row = (machine, campaign, number_of(c, "value"), number_of(c, "expanded"))
                    figures.setdefault((c["symbol"], c["name"], part["title"], c["unit"]), []).append(row)
    return figures


def _sizes(home: Home, tests: Mapping[str, str], effects: Sequence[str], progress: Progress) -> dict[_Key, list[_Row]]:
    library = Library()
    sizes: dict[_Key, list[_Row]] = {}
    for done, (machine, campaign) in enumerate(tests.items(), start=1):
        try:
            obs = load(home, campaign).obs
        except InputError:  # No twin can be fitted to its runs.
            continue
        terms = []
        for name in effects:
            try:
                terms += chosen_terms([name], library, obs)
            except InputError:  # It cannot act in these runs.
                continue
        for e in fit(obs, terms).estimates:
            if e.identifiable and e.uncertainty > 0.0 and not e.name.startswith(("cosine", "sine")):
                key = (f"{e.effect} {e.axis}".rstrip(), library[e.effect].title, e.name.replace("_", " "), e.unit)
                sizes.setdefault(key, []).append((machine, campaign, e.value, e.uncertainty))
        progress(done, len(tests), machine)
    return sizes


def _tests(home: Home, machines: Sequence[str]) -> dict[str, str]:
    """Return a campaign of each machine: the newest of the sort that most of them have."""
    lake = Lake(home.lake)
    of_sort: dict[tuple[str, ...], dict[str, str]] = {}
    for machine in machines:
        for name, rows in newest_tests(lake.runs(left_out=True, machine=machine), machine).items():
            of_sort.setdefault((str(rows[0]["kind"]), *moved_in(rows)), {})[machine] = name
    return max(of_sort.values(), key=len, default={})


def _found(home: Home, campaign: str) -> Iterator[str]:
    """Yield the effects without open shapes that the diagnosis of a campaign found, and backlash."""
    library, kept = Library(), kept_already(home, DIAGNOSES, campaign)
    for group in [] if kept is None else kept["found"]:
        name, axis = group[0]["effect"], group[0]["axis"]
        # A shape of its own makes sizes that cannot be compared; play is as large whatever it yields by before it is taken up.
        if name in library and (name == "backlash" or not library[name].shapes):
            yield f"{name}:{axis}" if axis else name


def _known(home: Home) -> list[str]:
    return sorted({str(row["machine"]) for row in Lake(home.lake).runs()})


def _type(home: Home, machine: str) -> str:
    record = read_record(home, machine)
    return "" if record is None else record.facts.get("type", "")
