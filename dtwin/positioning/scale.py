"""What differs between tables, checks and figures of axes that move along and of axes that turn: units, and words for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dtwin.schema import ALONG_KIND
from dtwin.units import LENGTHS_MM, UM_PER_MM


@dataclass(frozen=True)
class Scale:
    """In which units targets and deviations of an axis are told.

    ``kind``: kind of the runs; codes of findings begin with it.
    ``position``, ``error``, ``read``: columns of samples: targets, deviations, and what was read where that was a
    position.
    ``unit``, ``fine``: units of targets and of deviations, as people read them.
    ``figure``: unit of deviations, as names of columns end.
    ``per``: how many of ``fine`` one of ``unit`` is.
    ``units``: how many of ``unit`` each unit of a table is.
    ``largest``, ``longest``: beyond which a deviation (``fine``), or a travel (``unit``), is in another unit than it
    seems to be.
    ``allowed``, ``elsewhere``: units that are usual in tables; what to do with a table that is in others.
    ``turn``: after how many of ``unit`` the axis is at the same place again; 0 where it is not.
    ``stretch``: what a machine that is one kelvin warmer stretches by, ``fine`` in 1000 of ``unit``; 0 where heat
    stretches nothing.
    """

    kind: str
    position: str
    error: str
    read: str
    unit: str
    fine: str
    figure: str
    per: float
    units: Mapping[str, float]
    largest: float
    longest: float
    allowed: str
    elsewhere: str
    turn: float = 0.0
    stretch: float = 0.0

    def factor(self, unit: str) -> float:
        """Return how many of ``unit`` a unit of a table is: 1 where it is empty, NaN where it is not known."""
        return self.units.get(unit, float("nan")) if unit else 1.0


LENGTHS = Scale(
    kind=ALONG_KIND,
    position="position_mm",
    error="error_um",
    read="read_mm",
    unit="mm",
    fine="µm",
    figure="um",
    per=UM_PER_MM,
    units=LENGTHS_MM,
    largest=5_000.0,
    longest=1e5,
    allowed="mm, µm, nm, m, cm, in, mil, µin",
    elsewhere="a table of angles is one of a rotary axis: --kind rotary --axis C; where the axis is a linear one of this name, write [mm] into the heads; pitch and yaw of one are not read",
    stretch=11.5,
)
