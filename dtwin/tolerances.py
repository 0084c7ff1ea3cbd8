"""What a figure of a test may be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dtwin.errors import InputError
from dtwin.units import is_number


@dataclass(frozen=True)
class Limits:
    """What a figure may be, in µm, bounds included; None where there is no bound."""

    low_um: float | None = None
    high_um: float | None = None

    def __str__(self) -> str:
        if self.low_um is None:
            return f"≤ {self.high_um:g}"
        return f"≥ {self.low_um:g}" if self.high_um is None else f"{self.low_um:g} to {self.high_um:g}"

    def stated(self) -> float | dict[str, float]:
        """Return the limits as a file states them: one number, or a table."""
        bounds = {"low": self.low_um, "high": self.high_um}
        known = {name: bound for name, bound in bounds.items() if bound is not None}
        return known if "low" in known else known["high"]


def limits_from(stated: Mapping[str, Any], where: str) -> dict[str, Limits]:
    """Read limits by symbol: a largest value, or a table with ``low`` and ``high``, in µm.

    Raises
    ------
    InputError
        When one is no number, or its bounds are exchanged.
    """
    by_symbol = {}
    for symbol, value in stated.items():
        bounds = value if isinstance(value, Mapping) else {"high": value}
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
