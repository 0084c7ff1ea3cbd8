"""Equations of a tone's amplitude and phase error: given forms, and free search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.sinusoidal._groups import ToneGroups, dead_features
from dtwin.schema import Floats
from dtwin.serve.builder import Expression, GraphBuilder
from dtwin.train.formula import Formula
from dtwin.train.symbolic import Engine, Found, OperonEngine, refit

MOST_FEATURES = 3
# Among formulas that leave less than this share of the target's spread, the shortest is taken.
_ENOUGH = 0.005
_SYMBOLS = "add,sub,mul,div,square,sqrt,tanh,constant,variable"


@dataclass(frozen=True)
class Law:
    """One equation with its constants.

    ``formula``: over scaled features.
    ``constants``, (k,): values.
    ``scales``: what each feature is divided by, so that constants are of ordinary size.
    """

    formula: Formula
    constants: Floats
    scales: Mapping[str, float]

    @property
    def features(self) -> tuple[str, ...]:
        """Columns that the equation uses."""
        return tuple(sorted(self.formula.inputs))

    def values(self, columns: Mapping[str, Floats]) -> Floats:
        """Return the value for rows of features, shape (n,)."""
        scaled = _scaled(columns, self.scales)
        n = len(next(iter(columns.values())))
        values: Floats = np.broadcast_to(self.formula.values(scaled, self.constants), (n,))
        return np.nan_to_num(values, nan=1e6, posinf=1e6, neginf=-1e6)

    def build(self, builder: GraphBuilder, features: Mapping[str, Expression]) -> Expression:
        """Add the equation to a graph, from handles of its features."""
        return _built(self.formula, builder, self.constants, features, self.scales)

    def text(self) -> str:
        """Return the equation over scaled features, readable by ``parse_formula``."""
        return self.formula.text(self.constants)

    def readable(self) -> str:
        """Return the equation with what its features are divided by."""
        units = ", ".join(f"{n} / {self.scales[n]:.4g}" for n in self.features)
        return f"{self.text()}   with {units}" if units else self.text()


def _given_form(groups: ToneGroups, amplitude: Sequence[str], phase: Sequence[str]) -> tuple[Law, Law]:
    """Fit equations whose form is given; the best of several starts is kept.

    ``amplitude``, ``phase``: formulas with starting values; ``{rms}`` and the other short names stand for features.
    """
    names = {n: c for n, c in zip(groups.contract.features, groups.names, strict=True)}
    scales = _scales_of(groups)
    fits = []
    for starts, target in ((amplitude, groups.amplitude_error_um), (phase, groups.phase_error_deg)):
        fitted = refit([Found(s.format(**names), 0, 0.0) for s in starts], _scaled(groups.columns, scales), target)
        if not fitted:
            raise InputError("the equation cannot be fitted", code="train.form", got=starts[0])
        best = min(fitted, key=lambda f: f.rms)
        fits.append(Law(best.formula, best.constants, scales))
    return fits[0], fits[1]


def power_law(groups: ToneGroups) -> tuple[Law, Law]:
    """Fit amplitude error = c acceleration^p and phase error = c frequency^p."""
    return _given_form(groups, ["3.0 * exp(1.0 * log({rms}))"], ["3.0 * exp(1.5 * log({dominant_frequency}))"])


def printed_form(groups: ToneGroups) -> tuple[Law, Law]:
    """Fit the published forms anew: as printed they cannot be evaluated."""
    starts = [
        f"2.0 + 2.0 * tanh({a} * {{dominant_frequency}} + 0.1 * {{shape_factor}} + {b})"
        for a, b in ((1.0, -1.0), (0.5, -2.0), (2.0, -3.0))
    ]
    return _given_form(groups, ["3.0 * {crest_factor} * exp(0.8 * log({variance} / {rms}))"], starts)


def two_modes(groups: ToneGroups) -> tuple[Law, Law]:
    """Fit what a servo and a structure in series give, to second order below resonance.

    With gains 1 / (1 - f^2 / f_1^2) and 1 / (1 - f^2 / f_2^2) the amplitude error is the acceleration
    times a constant, less a term of f^2; the lag of both is f times a series in f^2.
    """
    frequency = "{dominant_frequency}"
    return _given_form(
        groups,
        [f"{{rms}} * (3.0 - 0.5 * square({frequency}))"],
        [f"{frequency} * (1.0 + 1.0 * square({frequency}) / (1.0 - {c} * square({frequency})))" for c in (0.05, 0.2)],
    )


def searched(groups: ToneGroups, engine: Engine | None, seed: int) -> tuple[Law, Law, list[dict[str, float]]]:
    """Search formulas of at most three features freely; return them and the front of amplitudes.

    Features that are constants on clean tones are not offered to the search.

    ``engine``: search engine; Operon with this module's operators without.
    """
    search = engine or OperonEngine(max_length=20, symbols=_SYMBOLS)
    scales, dead = _scales_of(groups), dead_features(groups)
    offered = {name: values for name, values in groups.columns.items() if name not in dead}
    columns = _scaled(offered, scales)
    laws, front = [], []
    for target in (groups.amplitude_error_um, groups.phase_error_deg):
        fitted = [
            f
            for f in refit(search.search(columns, target, seed), columns, target)
            if len(f.formula.inputs) <= MOST_FEATURES
        ]
        if not fitted:
            raise InputError("no formula of three features was found", code="train.search")
        enough = max(1.02 * min(f.rms for f in fitted), _ENOUGH * float(np.std(target)))
        best = min((f for f in fitted if f.rms <= enough), key=lambda f: f.complexity)
        laws.append(Law(best.formula, best.constants, scales))
        front.append([{"nodes": float(f.complexity), "rms": f.rms} for f in fitted])
    return laws[0], laws[1], front[0]


def _scales_of(groups: ToneGroups) -> dict[str, float]:
    """Return the median size of each feature."""
    return {name: float(np.median(np.abs(values))) or 1.0 for name, values in groups.columns.items()}


def _scaled(columns: Mapping[str, Floats], scales: Mapping[str, float]) -> dict[str, Floats]:
    return {name: values / scales[name] for name, values in columns.items()}


def _built(
    formula: Formula,
    builder: GraphBuilder,
    constants: Floats,
    features: Mapping[str, Expression],
    scales: Mapping[str, float],
) -> Expression:
    if formula.op == "constant":
        return builder.constant(float(constants[formula.place]))
    if formula.op == "input":
        return features[formula.name] / scales[formula.name]
    parts = (_built(a, builder, constants, features, scales) for a in formula.args)
    return builder.apply(formula.op, *parts)
