"""What a figure of a test may be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dtwin.errors import InputError
from dtwin.units import is_number

_SIGNED = ("D", "B̄")
"""Figures that may be negative: mean radial deviation of a circle, mean reversal error of an axis."""


@dataclass(frozen=True)
class Limits:
    """What a figure may be, in µm, bounds included; None where there is no bound."""

    low_um: float | None = None
    high_um: float | None = None

    def __str__(self) -> str:
        if self.low_um is None:
            return f"≤ {self.high_um:g}"
        return f"≥ {self.low_um:g}" if self.high_um is None else f"{self.low_um:g} to {self.high_um:g}"

    def stated(self, symbol: str) -> float | dict[str, float]:
        """Return the limits of a figure as a file states them: one number that is read as the same again, or a table."""
        bounds = {"low": self.low_um, "high": self.high_um}
        known = {name: bound for name, bound in bounds.items() if bound is not None}
        high = known.get("high")
        return high if high is not None and _bounds(symbol, high) == known else known


def limits_from(stated: Mapping[str, Any], where: str) -> dict[str, Limits]:
    """Read limits by symbol: a largest value, or a table with ``low`` and ``high``, in µm.

    One number of a figure that has a sign is a limit of its size: a deviation of -30 is not within 10. Of ``Fmin``, the
    smallest deviation of a circle, it is how far down it may be.

    Raises ``InputError`` when one is no number, or its bounds are exchanged.
    """
    by_symbol = {}
    for symbol, value in stated.items():
        bounds = value if isinstance(value, Mapping) else _bounds(symbol, value)
        low, high = bounds.get("low"), bounds.get("high")
        numbers = [b for b in (low, high) if b is not None]
        good = bool(numbers) and set(bounds) <= {"low", "high"} and all(map(is_number, numbers))
        if not good or (len(numbers) == 2 and numbers[0] >= numbers[1]):
            raise InputError(
                "a tolerance is not usable",
                code="sheet.tolerance",
                where=f"{where}: {symbol}",
                got=str(value)[:60],
                allowed="a largest value in µm, or low and high with low below high",
            )
        by_symbol[symbol] = Limits(*(None if b is None else float(b) for b in (low, high)))
    return by_symbol


def _bounds(symbol: str, value: Any) -> dict[str, Any]:
    """Return the bounds that one number states; what is no number as it is, to be refused."""
    symbol = symbol.rpartition(":")[2]
    if is_number(value) and value > 0.0 and symbol in _SIGNED:
        return {"low": -value, "high": value}
    if is_number(value) and symbol.startswith("Fmin"):
        return {"low": -abs(value)}
    return {"high": value}
