"""Numbers that a control sends beside its state, each good for as long as its rate promises."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dtwin.links.state import Floats

# Periods of its own rate for which a value holds.
_GOOD_FOR = 3.0


class LiveValues:
    """Newest values of the inputs that a control provides.

    Args:
        rates_hz: Rate at which each is renewed, by name.

    Attributes:
        names (tuple of str): In the order of ``values``.
        values (ndarray, shape (n,)): NaN while there is none, or only an old one. Overwritten in place. Shape (n,).
    """

    def __init__(self, rates_hz: Mapping[str, float]) -> None:
        self.names = tuple(rates_hz)
        self.values: Floats = np.full(len(self.names), math.nan)
        self._place = {name: number for number, name in enumerate(self.names)}
        self._good_s = np.array([_GOOD_FOR / rate for rate in rates_hz.values()])
        self._until_s = np.full(len(self.names), -math.inf)

    def take(self, given: Mapping[str, float], stamp_s: float) -> None:
        """Take what came with a state, and drop what is too old.

        Args:
            given: Finite numbers; names that were not asked for are left alone.
            stamp_s: The control's stamp of the state.
        """
        for name, value in given.items():
            place = self._place.get(name)
            if place is not None:
                self.values[place] = value
                self._until_s[place] = stamp_s + self._good_s[place]
        self.values[self._until_s < stamp_s] = math.nan

    def old(self) -> tuple[str, ...]:
        """Return the names without a value that holds."""
        missing = np.isnan(self.values)
        return tuple(name for name, gone in zip(self.names, missing, strict=True) if gone)

    def forget(self) -> None:
        """Drop every value, as for another connection."""
        self.values[:] = math.nan
        self._until_s[:] = -math.inf
