"""A twin of a machine that heat deforms: error motions, each driven by a few temperatures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import coefficient
from dtwin.kinds.volumetric._drivers import Drivers
from dtwin.kinds.volumetric._heat_series import FEWEST_CYCLES, HeatSeries
from dtwin.kinds.volumetric._thermal_model import ThermalModel, independent
from dtwin.kinds.volumetric.motions import HeatTerm, motion_words
from dtwin.schema import Floats
from dtwin.twins.term_twins import TermTwin

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
        return tuple(driver.model for driver in self.drivers)


class HeatTwin(TermTwin[HeatTerm]):
    """A fitted twin."""

    @cached_property
    def models(self) -> tuple[ThermalModel, ...]:
        """What drives each term."""
        driven: dict[str, list[Mapping[str, Any]]] = {term.motion: [] for term in self.terms}
        for parameter in self.document["parameters"]:
            driven[parameter["effect"]].append(parameter)
        return tuple(
            ThermalModel(
                motion,
                tuple(parameter["name"] for parameter in own),
                np.array([parameter["value"] for parameter in own], dtype=float),
            )
            for motion, own in driven.items()
        )

    def expected(self, series: HeatSeries) -> Floats:
        """Return what the twin says of every motion of a campaign, shape (n, m).

        Raises ``InputError`` when a temperature is missing there.
        """
        return _expected(series, self.models)

    def outside(self, series: HeatSeries) -> list[str]:
        """Return the temperatures that leave what the fit saw, and by how many kelvin."""
        places = []
        for name, (low, high) in self.document["seen_c"].items():
            read = series.rise_c[name] + series.begun_c[name]
            beyond = max(low - float(read.min()), float(read.max()) - high)
            if beyond > _BEYOND_C:
                places.append(f"{name} by {beyond:z.1f} K")
        return places


def heat_twin_from(document: Mapping[str, Any]) -> HeatTwin:
    """Return a twin from its stored form. Raises ``KeyError``, ``TypeError`` or ``ValueError`` when it is not one."""
    return HeatTwin.of(document, tuple(HeatTerm(e["effect"], tuple(e["sources"])) for e in document["effects"]))


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
    return HeatFit(tuple(drivers), _expected(series, [driver.model for driver in drivers]))


def heat_told(series: HeatSeries, terms: Sequence[HeatTerm]) -> dict[str, Any]:
    """Fit terms to a campaign, and return what is stored of that.

    ``uncertainty``: expanded (k = 2), of what a kelvin does. ``seen_c``: least and largest reading of every temperature that is used.
    """
    fitted = fit_heat(series, terms)
    left, left_out = series.values - fitted.expected, series.values.copy()
    for term, driver in zip(terms, fitted.drivers, strict=True):
        left_out[:, series.names.index(term.motion)] -= driver.expected
    used = sorted({sensor for model in fitted.models for sensor in model.sensors})
    readings = {sensor: series.rise_c[sensor] + series.begun_c[sensor] for sensor in used}
    return {
        "effects": [
            {
                "effect": term.motion,
                "axis": term.axis,
                "label": term.label,
                "title": motion_words(term.motion),
                "sources": list(term.sources),
                "temperatures": list(model.sensors),
            }
            for term, model in zip(terms, fitted.models, strict=True)
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
            for term, model in zip(terms, fitted.models, strict=True)
            for sensor, value, spread in zip(model.sensors, model.per_k, _uncertainty(series, model), strict=True)
        ],
        "seen_c": {sensor: [float(read.min()), float(read.max())] for sensor, read in readings.items()},
        "figures": heat_figures(series, left) | {"held_out_rms_um": series.rms_um(left_out)},
        "by_condition": list(by_day(series, left)),
        "replication": "cycle",
    }


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
