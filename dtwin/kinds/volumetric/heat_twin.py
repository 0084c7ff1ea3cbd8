"""A twin of a machine that heat deforms: error motions, each driven by a few temperatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import coefficient
from dtwin.kinds.volumetric._drivers import Drivers
from dtwin.kinds.volumetric._heat_series import FEWEST_CYCLES, HeatSeries
from dtwin.kinds.volumetric._thermal_model import ThermalModel, independent
from dtwin.kinds.volumetric.motions import HeatTerm, motion_words
from dtwin.schema import Floats

FORMAT = "dtwin-heat-twin-1"
KIND = "volumetric"
_DAY_H = 24.0
_COVERAGE = 2.0
# Readings that leave what the fit saw by more are told, as a served bundle heeds them.
_BEYOND_C = 2.0


@dataclass(frozen=True)
class HeatFit:
    """Terms fitted to a campaign.

    ``expected`` (n, m): what they say of every motion; 0 for those that the twin does not have.
    ``drivers``: of each term: its model, and what is said of hours that were left out.
    """

    drivers: tuple[Drivers, ...]
    expected: Floats

    @property
    def models(self) -> tuple[ThermalModel, ...]:
        """Models of the terms."""
        return tuple(found.model for found in self.drivers)


@dataclass(frozen=True)
class HeatTwin:
    """A fitted twin.

    Attributes:
        version: From 1.
        machine, campaign, action: What it is of, what it was fitted to, and what was done to it.
        uncertainties: Expanded (k = 2) uncertainty of what a kelvin does, for each model.
        seen_c: Least and largest reading of every temperature that it uses.
        figures: Errors before and after, and the noise floor, in um.
        by_condition: The same for every day.
    """

    name: str
    version: int
    machine: str
    campaign: str
    action: str
    terms: tuple[HeatTerm, ...]
    models: tuple[ThermalModel, ...]
    uncertainties: tuple[tuple[float, ...], ...]
    seen_c: Mapping[str, tuple[float, float]]
    figures: Mapping[str, float]
    by_condition: tuple[Mapping[str, Any], ...]
    data: Mapping[str, Any]

    @property
    def campaigns(self) -> tuple[str, ...]:
        """Campaigns that it was fitted to."""
        return (self.campaign,)

    @property
    def labels(self) -> tuple[str, ...]:
        """Terms as a user writes them."""
        return tuple(term.label for term in self.terms)

    def expected(self, series: HeatSeries) -> Floats:
        """Return what the twin says of every motion of a campaign, shape (n, m).

        Raises ``InputError`` when a temperature is missing there.
        """
        return _expected(series, self.models)

    def outside(self, series: HeatSeries) -> list[str]:
        """Return the temperatures that leave what the fit saw, and by how many kelvin."""
        found = []
        for name, (low, high) in self.seen_c.items():
            read = series.rise_c[name] + series.begun_c[name]
            beyond = max(low - float(read.min()), float(read.max()) - high)
            if beyond > _BEYOND_C:
                found.append(f"{name} by {beyond:z.1f} K")
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping, from which :func:`heat_twin_from` makes it again."""
        return {
            "format": FORMAT,
            "kind": KIND,
            "twin": self.name,
            "version": self.version,
            "machine": self.machine,
            "campaign": self.campaign,
            "action": self.action,
            "effects": [
                {
                    "effect": term.motion,
                    "axis": term.axis,
                    "label": term.label,
                    "title": motion_words(term.motion),
                    "sources": list(term.sources),
                    "temperatures": list(model.sensors),
                }
                for term, model in zip(self.terms, self.models, strict=True)
            ],
            "parameters": [
                {
                    "effect": term.motion,
                    "axis": term.axis,
                    "name": sensor,
                    "value": float(value),
                    "uncertainty": spread,
                    "unit": f"{coefficient(term.motion).unit}/K",
                }
                for term, model, spreads in zip(self.terms, self.models, self.uncertainties, strict=True)
                for sensor, value, spread in zip(model.sensors, model.per_k, spreads, strict=True)
            ],
            "seen_c": {name: list(reach) for name, reach in self.seen_c.items()},
            "figures": dict(self.figures),
            "by_condition": [dict(c) for c in self.by_condition],
            "data": dict(self.data),
            "replication": "cycle",
        }


def heat_twin_from(document: Mapping[str, Any]) -> HeatTwin:
    """Return a twin from its stored form.

    Raises ``KeyError``, ``TypeError``, ``ValueError`` or ``InputError`` when it is not one.
    """
    terms = tuple(HeatTerm(e["effect"], tuple(e["sources"])) for e in document["effects"])
    rows: dict[str, list[Mapping[str, Any]]] = {term.motion: [] for term in terms}
    for row in document["parameters"]:
        rows[row["effect"]].append(row)
    models = tuple(
        ThermalModel(
            term.motion,
            tuple(row["name"] for row in rows[term.motion]),
            np.array([row["value"] for row in rows[term.motion]], dtype=float),
            0.0,
            0.0,
        )
        for term in terms
    )
    return HeatTwin(
        document["twin"],
        int(document["version"]),
        document["machine"],
        document["campaign"],
        document["action"],
        terms,
        models,
        tuple(tuple(row["uncertainty"] for row in rows[term.motion]) for term in terms),
        {name: (float(low), float(high)) for name, (low, high) in document["seen_c"].items()},
        document["figures"],
        tuple(document["by_condition"]),
        document["data"],
    )


def fit_heat(series: HeatSeries, terms: Sequence[HeatTerm]) -> HeatFit:
    """Fit terms to a campaign; each motion was identified already, so that none disturbs another.

    Raises ``InputError`` with too few cycles, or when a temperature is not known.
    """
    if len(series.hour) < FEWEST_CYCLES:
        raise InputError(
            "too few cycles to leave hours out of the fit",
            code="volumetric.cycles",
            where=series.campaign,
            got=str(len(series.hour)),
            allowed=f"at least {FEWEST_CYCLES}",
            hint="measure on: a cycle an hour, some days, with sources of heat going on and off",
        )
    drivers = [
        series.driven(term.motion, series.values[:, series.names.index(term.motion)], term.sources) for term in terms
    ]
    return HeatFit(tuple(drivers), _expected(series, [found.model for found in drivers]))


def heat_twin_of(
    fitted: HeatFit,
    series: HeatSeries,
    terms: Sequence[HeatTerm],
    *,
    name: str,
    version: int,
    action: str,
    data: Mapping[str, Any],
) -> HeatTwin:
    """Return the twin that a fit makes. ``name``, ``version``, ``action``, ``data``: as of :class:`HeatTwin`."""
    left, left_out = series.values - fitted.expected, series.values.copy()
    for term, found in zip(terms, fitted.drivers, strict=True):
        left_out[:, series.names.index(term.motion)] -= found.expected
    used = sorted({sensor for model in fitted.models for sensor in model.sensors})
    readings = {sensor: series.rise_c[sensor] + series.begun_c[sensor] for sensor in used}
    return HeatTwin(
        name,
        version,
        series.machine,
        series.campaign,
        action,
        tuple(terms),
        fitted.models,
        tuple(_uncertainty(series, model) for model in fitted.models),
        {sensor: (float(read.min()), float(read.max())) for sensor, read in readings.items()},
        heat_figures(series, left) | {"held_out_rms_um": series.rms_um(left_out)},
        by_day(series, left),
        data,
    )


def heat_figures(series: HeatSeries, left: Floats) -> dict[str, float]:
    """Return the errors at the balls before and after, and the floor, in um.

    ``left`` (n, m): what is left of the motions.
    """
    after, floor = series.rms_um(left), series.floor_um
    return {
        "rms_before_um": series.rms_um(series.values),
        "rms_after_um": after,
        "systematic_rms_um": float(np.sqrt(max(after**2 - floor**2, 0.0))),
        "noise_floor_um": floor,
        "n_cycles": len(series.hour),
    }


def by_day(series: HeatSeries, left: Floats) -> tuple[dict[str, Any], ...]:
    """Return the errors at the balls, before and after, of every day."""
    day = np.floor((series.hour - series.hour[0]) / _DAY_H).astype(int)
    out = []
    for number in sorted(set(day.tolist())):
        cycles = np.flatnonzero(day == number).tolist()
        begin = float(series.hour[0]) + _DAY_H * number
        out.append(
            {
                "hours": [begin, begin + _DAY_H],
                "cycles": len(cycles),
                "rms_before_um": series.rms_um(series.values, cycles),
                "rms_after_um": series.rms_um(left, cycles),
            }
        )
    return tuple(out)


def _expected(series: HeatSeries, models: Sequence[ThermalModel]) -> Floats:
    out = np.zeros_like(series.values)
    for model in models:
        out[:, series.names.index(model.name)] = model.run(series.rises(model.sensors))
    return out


def _uncertainty(series: HeatSeries, model: ThermalModel) -> tuple[float, ...]:
    """Return the expanded uncertainty of what a kelvin does; the residual's autocorrelation counts."""
    rise = series.rises(model.sensors)
    left = series.values[:, series.names.index(model.name)] - model.run(rise)
    free = max(independent(left) - rise.shape[1], 1.0)
    # As many independent cycles as the residual leaves, with its mean square.
    each = np.diag(np.linalg.pinv(rise.T @ rise)) * len(left) * float((left**2).mean()) / free
    return tuple((_COVERAGE * np.sqrt(each)).tolist())
