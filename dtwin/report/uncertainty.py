"""The uncertainty of a figure after ISO/TR 230-9 and the GUM: a budget of contributions, combined and expanded.

It knows no kind of campaign: each kind says what contributes to its figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dtwin.errors import InputError
from dtwin.statistics import k2_factor
from dtwin.units import shown_number, shown_unit

REPEATABILITY = "repeatability"
_MANY_DOF = 1e6
_LARGEST = 1e6
_REFERENCE_C = 20.0
_UNKNOWN_OFF_K = 2.0
"""How far from 20 °C a machine is taken to be whose temperature nobody wrote down."""
_TEMPERATURE_K = 1.0
_EXPANSION = 11.5
_EXPANSION_K2 = 2.0


@dataclass(frozen=True)
class Contribution:
    """One reason why a figure is uncertain.

    ``standard_um``: standard uncertainty (k = 1) of the figure by this reason.
    ``basis``: where the number comes from.
    ``dof``: degrees of freedom; infinite for what is stated.
    ``assumed``: whether nobody stated it.
    ``within``: source of another contribution that has this one in it: only what goes beyond that one counts.
    ``zero``: whether the figure has its zero by this alone: where it is assumed, two tests have no common zero.
    """

    source: str
    standard_um: float
    basis: str
    dof: float = math.inf
    assumed: bool = False
    within: str = ""
    zero: bool = False


@dataclass(frozen=True)
class Budget:
    """Contributions, as they count, combined to ``standard_um`` with ``dof`` and expanded by ``factor``."""

    contributions: tuple[Contribution, ...]
    standard_um: float
    dof: float
    factor: float

    @property
    def expanded_um(self) -> float:
        """Half width of the interval."""
        return self.factor * self.standard_um

    def as_dict(self, unit: str = "um") -> dict[str, Any]:
        """Return a JSON-ready mapping, whose names end in the unit."""
        return {
            "contributions": [
                {
                    "source": c.source,
                    f"standard_{unit}": c.standard_um,
                    "basis": c.basis,
                    "assumed": c.assumed,
                    "zero": c.zero,
                }
                for c in self.contributions
            ],
            f"standard_{unit}": self.standard_um,
            "dof": self.dof if math.isfinite(self.dof) else None,
            "k": self.factor,
        }


def combined(contributions: Sequence[Contribution]) -> Budget:
    """Combine independent contributions by the root of their squares.

    k is 2, and more where the degrees of freedom (Welch and Satterthwaite) are few: it is the factor of Student's t
    that covers what 2 covers of a normal distribution.
    """
    known = {c.source: c for c in contributions}
    counted = []
    for c in contributions:
        holder = known.get(c.within)
        if holder is not None:
            beyond = math.sqrt(max(0.0, c.standard_um**2 - holder.standard_um**2))
            c = Contribution(
                c.source, beyond, f"{c.basis}; what goes beyond the {holder.source}", c.dof, c.assumed, c.within
            )
        counted.append(c)
    standard = math.sqrt(sum(c.standard_um**2 for c in counted))
    spread = sum(c.standard_um**4 / c.dof for c in counted if c.standard_um)
    dof = standard**4 / spread if spread else math.inf
    factor = k2_factor(max(1.0, min(dof, _MANY_DOF)))
    return Budget(tuple(counted), standard, dof, factor)


@dataclass(frozen=True)
class Variation:
    """How far a reading moves while the machine stands still (EVE): the range within ``hours`` of a drift test."""

    range_um: float
    hours: float
    campaign: str


@dataclass(frozen=True)
class _Stated:
    """A number, and whether nobody stated it."""

    value: float
    assumed: bool

    def basis(self, unit: str) -> str:
        """Return where the number comes from."""
        return f"{self.value:g} {unit} {'assumed, for none is stated' if self.assumed else 'stated'}"


@dataclass(frozen=True)
class Circumstances:
    """Under what a test was made, as far as it is known.

    ``instrument``: ``[campaign.instrument]``.
    ``temperature_c``: of the machine during the test, NaN when it was not written down.
    ``variation``: from a drift test of the machine.
    ``where``: whose statements these are, for error messages.
    """

    instrument: Mapping[str, Any] = field(default_factory=dict)
    temperature_c: float = math.nan
    variation: Variation | None = None
    where: str = "instrument"

    def stated(self, name: str, otherwise: float) -> _Stated:
        """Return a number of the instrument's table, ``otherwise`` when it is not there.

        Raises ``InputError`` when it is no number from 0 to a million.
        """
        value = self.instrument.get(name)
        if value is None:
            return _Stated(otherwise, True)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < _LARGEST:
            raise InputError(
                "the uncertainty of the instrument is not usable",
                code="sheet.uncertainty",
                where=f"{self.where}.{name}",
                got=str(value)[:60],
                allowed=f"a number from 0 to {_LARGEST:g}",
            )
        return _Stated(float(value), False)

    def reading(self, otherwise: float, unit: str = "um") -> Contribution:
        """Return what the instrument contributes to a difference of two readings, ``uncertainty_um`` (k = 2), or in another unit."""
        told = self.stated(f"uncertainty_{unit}", otherwise)
        return Contribution(
            "instrument", told.value / 2, told.basis(f"{shown_unit(unit)} (k = 2)"), assumed=told.assumed
        )

    def probe(self, otherwise: float, figure_um: float) -> tuple[Contribution, ...]:
        """Return what a probe contributes to a range: to any difference of two readings, and ``uncertainty_percent`` (k = 2) of it."""
        told = self.stated("uncertainty_percent", 0.0)
        share = Contribution("probe's sensitivity", told.value / 200.0 * figure_um, told.basis("% (k = 2)"))
        return (self.reading(otherwise), *([share] if told.value else []))

    def length(self, metres: float) -> list[Contribution]:
        """Return what temperature and expansion contribute to a length that is to hold at 20 °C."""
        expansion = self.stated("expansion_um_per_m_k", _EXPANSION)
        doubt = self.stated("expansion_uncertainty_um_per_m_k", _EXPANSION_K2)
        reading = self.stated("temperature_uncertainty_k", _TEMPERATURE_K)
        known = math.isfinite(self.temperature_c)
        off = abs(self.temperature_c - _REFERENCE_C) if known else _UNKNOWN_OFF_K
        place = f"at {self.temperature_c:z.1f} °C" if known else f"{off:g} K from 20 °C, assumed, for none was written"
        return [
            Contribution(
                "temperature",
                metres * expansion.value * reading.value / 2,
                f"{reading.basis('K (k = 2)')}; {expansion.basis('µm/(m K)')}",
                assumed=reading.assumed or expansion.assumed,
            ),
            Contribution(
                "expansion",
                metres * off * doubt.value / 2,
                f"{doubt.basis('µm/(m K) (k = 2)')}; {place}",
                assumed=doubt.assumed or not known,
            ),
        ]

    def environment(self, repeats: int) -> list[Contribution]:
        """Return what the surroundings contribute to a difference of two readings, mean of repeats.

        Repeats show it, so only what goes beyond their scatter counts.
        """
        if self.variation is None:
            return []
        # Both readings lie anywhere in the range: a rectangular distribution each.
        standard = self.variation.range_um / math.sqrt(6.0 * repeats)
        basis = f"{shown_number(self.variation.range_um)} µm within {self.variation.hours:g} h, drift test {self.variation.campaign}"
        return [Contribution("environment", standard, basis, within=REPEATABILITY)]


def off_line_um(offset_mm: float, length_mm: float) -> float:
    """Return the standard uncertainty by an instrument that lies aslant by up to ``offset_mm`` over a length."""
    return 1000.0 * offset_mm**2 / (2.0 * length_mm) / math.sqrt(3.0) if length_mm > 0 else 0.0
