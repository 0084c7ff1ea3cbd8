"""What a ball-array campaign says hour by hour: error motions, temperatures, and what balls see."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.volumetric._drivers import Drivers, drivers_of
from dtwin.schema import Floats

_SPANS = 5
# What drives motions of some campaigns, by all that it follows from: every command about a twin asks for the same.
_MOST_KEPT = 300
_kept: dict[bytes, Drivers] = {}
FEWEST_CYCLES = 19
"""For temperatures to be chosen twice with hours left out."""
_NUMBERED = re.compile(r"_?\d*_c$")


def body_of(sensor: str) -> str:
    """Return what a thermocouple sits on: ``bed_07_c`` on ``bed``."""
    return _NUMBERED.sub("", sensor)


def require_temperatures(
    wanted: Sequence[str], measured: Collection[str], campaign: str, offered: Sequence[str]
) -> None:
    """Refuse a campaign without the temperatures that are wanted.

    ``wanted``, ``measured``: names; measured are those without gaps.
    """
    absent = [name for name in wanted if name not in measured]
    if absent:
        raise InputError(
            "the campaign lacks temperatures, or has gaps in them",
            code="volumetric.sensors",
            where=campaign,
            got=", ".join(absent)[:160],
            allowed=", ".join(offered)[:300],
        )


@dataclass(frozen=True)
class HeatSeries:
    """A campaign cycle by cycle, as differences to its reference cycles.

    The residual of a cycle at the balls is what the motions leave themselves, and ``r' G r`` of what
    is left of the motions: the least squares that found them make the two add up.

    ``hour``, (n,): begin of each cycle.
    ``names``: error motions that were identified, all at once.
    ``values``, (n, m): error motions, um or um/m.
    ``covariance``, (n, m, m): of the values, from what the probe's noise does to them.
    ``at_balls``, (n, m, m): mean square at the balls, per coordinate, of a product of two motions: ``G``.
    ``left_ms_um2``, (n,): mean square per coordinate of what the motions leave.
    ``rise_c``, (n,): every temperature without gaps, since the reference.
    ``begun_c``: what they read in the reference.
    ``thermocouples``: those of them that sit on the machine; the others were logged beside them.
    """

    campaign: str
    machine: str
    hour: Floats
    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    at_balls: Floats
    left_ms_um2: Floats
    rise_c: Mapping[str, Floats]
    begun_c: Mapping[str, float]
    thermocouples: tuple[str, ...]

    @property
    def offered(self) -> tuple[str, ...]:
        """Temperatures that were logged beside the thermocouples."""
        return tuple(name for name in self.rise_c if name not in self.thermocouples)

    @property
    def bodies(self) -> dict[str, tuple[str, ...]]:
        """Thermocouples by body."""
        by_body: dict[str, list[str]] = {}
        for name in self.thermocouples:
            by_body.setdefault(body_of(name), []).append(name)
        return {body: tuple(names) for body, names in by_body.items()}

    @property
    def floor_um(self) -> float:
        """RMS at the balls that a perfect twin would leave: noise, and what it does to the motions."""
        noise = np.einsum("nij,nji->n", self.at_balls, self.covariance)
        return float(np.sqrt((self.left_ms_um2 + noise).mean()))

    def uncertainty_of(self, column: int) -> Floats:
        """Return the standard uncertainty of a motion in every cycle, shape (n,)."""
        return np.sqrt(self.covariance[:, column, column])

    def rms_um(self, left: Floats, cycles: Sequence[int] | slice = slice(None)) -> float:
        """Return the RMS at the balls when this is left of the motions.

        ``left``, (n, m): motions less what was predicted.
        """
        squares = self.left_ms_um2 + np.einsum("ni,nij,nj->n", left, self.at_balls, left)
        return float(np.sqrt(squares[cycles].mean()))

    def share_um(self, values: Floats, column: int) -> float:
        """Return the RMS at the balls of one motion alone, its values given, shape (n,)."""
        return float(np.sqrt((values**2 * self.at_balls[:, column, column]).mean()))

    def spans(self) -> list[NDArray[np.int64]]:
        """Return spans of neighbouring cycles, which are left out of a fit as a whole."""
        return [np.asarray(s, np.int64) for s in np.array_split(np.arange(len(self.hour)), _SPANS)]

    def rises(self, names: Sequence[str]) -> Floats:
        """Return temperatures by name, shape (n, names)."""
        require_temperatures(names, self.rise_c, self.campaign, [*self.bodies, *self.offered])
        return np.column_stack([np.zeros((len(self.hour), 0)), *(self.rise_c[n] for n in names)])

    def driven(self, name: str, motion: Floats, sources: Sequence[str] = ()) -> Drivers:
        """Fit a motion, values (n,), to temperatures of these sources, or of the bodies that are found to drive it without any.

        ``sources``: bodies, or temperatures by name. What a user names is not doubted.
        """
        asked = tuple(dict.fromkeys(name for source in sources for name in self.bodies.get(source, (source,))))
        self.rises(asked)
        names = asked or self.thermocouples
        content = blake2b(repr((name, names, bool(sources))).encode())
        for column in (motion, self.hour, *(self.rise_c[one] for one in names)):
            content.update(column.tobytes())
        key = content.digest()
        drivers = _kept.get(key)
        if drivers is None:
            rises: dict[str, dict[str, Floats]] = {}
            for one in names:
                rises.setdefault(body_of(one), {})[one] = self.rise_c[one]
            drivers = drivers_of(name, motion, rises, self.hour, self.spans(), named=bool(sources))
            if len(_kept) >= _MOST_KEPT:
                _kept.pop(next(iter(_kept)), None)
            _kept[key] = drivers
        return drivers
