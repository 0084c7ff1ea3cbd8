"""Split a measured circle into what the controller saw, quasi-static and dynamic error.

The three parts are those of Andolfatto, Lavernhe and Mayer (arXiv 1107.3541): the controller's own
following error, and of what its encoders do not see, the slow part (geometry, scales, lost motion)
and the fast part (vibration, jolts). They add up to the measured error at every angle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.schema import Floats, RunMeta
from dtwin.statistics import rms
from dtwin.units import UM_PER_MM

DEFAULT_CYCLES_PER_REV = 15.0


@dataclass(frozen=True)
class Cutoff:
    """Where quasi-static ends and dynamic begins; exactly one of the two is given.

    ``cycles_per_rev``: in waves per revolution: a shape in space, whatever the feed.
    ``hz``: in waves per second: a shape in time, whatever the radius.
    """

    cycles_per_rev: float | None = None
    hz: float | None = None

    def __post_init__(self) -> None:
        """Refuse a split that is not declared, or declared twice."""
        given = [v for v in (self.cycles_per_rev, self.hz) if v is not None]
        if len(given) != 1 or not 0.0 < given[0] < 1e6:
            raise InputError(
                "quasi-static and dynamic are split at one frequency",
                code="split.cutoff",
                got=", ".join(f"{v:g}" for v in given) or "none",
                allowed="cycles per revolution or Hz, one of them, above 0",
            )

    def cycles(self, radius_mm: float, feed_mm_min: float) -> float:
        """Return the split in cycles per revolution of one condition."""
        if self.cycles_per_rev is not None:
            return self.cycles_per_rev
        assert self.hz is not None
        return self.hz * 2.0 * np.pi * radius_mm / (feed_mm_min / 60.0)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {name: value for name, value in vars(self).items() if value is not None}


def seen_by_controller_um(meta: RunMeta, samples: Mapping[str, NDArray[Any]], angle_deg: Floats) -> Floats | None:
    """Return the controller's own following error along the radius.

    ``samples``, (n,): ``cmd_x_mm``, ``act_x_mm`` and the same of the plane's other axis, in machine axes.
    ``angle_deg``, (n,): path angle, from the plane's first axis towards its second.

    Returns (n,): actual minus commanded, projected on the outward radius, um; None when a column of either
    axis is not there: half of a vector has no projection.
    """
    axes = (meta.plane or "").lower()
    wanted = [f"{kind}_{axis}_mm" for axis in axes for kind in ("cmd", "act")]
    if not wanted or any(name not in samples for name in wanted):
        return None
    theta = np.radians(angle_deg)
    out = np.zeros(len(theta))
    for axis, along in zip(axes, (np.cos(theta), np.sin(theta)), strict=True):
        behind_mm = samples[f"act_{axis}_mm"] - samples[f"cmd_{axis}_mm"]
        out += UM_PER_MM * np.asarray(behind_mm, dtype=float) * along
    return out


def slow_part(values: Floats, known: NDArray[np.bool_], cycles_per_rev: float) -> Floats:
    """Return the part of a circle up to a number of cycles per revolution, shape (bins,); zero where nothing is known.

    A full turn is taken apart into its harmonics. An arc is not periodic: it is continued by its
    mirror image (cosine transform), so that its ends make no jump, and half cycles per arc count.

    ``values``: at equal steps of a turn, shape (bins,).
    ``known``: where there is a value, shape (bins,); the longest gap separates the ends of an arc, shorter ones are
    bridged by straight lines.
    """
    n = len(values)
    if known.all():
        spectrum = np.fft.rfft(values)
        spectrum[np.arange(len(spectrum)) > cycles_per_rev] = 0.0
        return np.asarray(np.fft.irfft(spectrum, n))
    places = _arc(known)
    here = known[places]
    arc = np.interp(np.arange(len(places)), np.flatnonzero(here), values[places[here]])
    spectrum = np.fft.rfft(np.concatenate([arc, arc[::-1]]))
    cycles = np.arange(len(spectrum)) * n / (2.0 * len(arc))
    spectrum[cycles > cycles_per_rev] = 0.0
    out = np.zeros(n)
    out[places] = np.fft.irfft(spectrum, 2 * len(arc))[: len(arc)]
    return np.where(known, out, 0.0)


def _arc(known: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the bins of an arc in order, from the end of the longest gap to its start."""
    n = len(known)
    steps = np.flatnonzero(known)
    gaps = np.diff(np.append(steps, steps[0] + n))
    first = int(steps[(int(np.argmax(gaps)) + 1) % len(steps)])
    return np.asarray((first + np.arange(n - int(gaps.max()) + 1)) % n)


@dataclass(frozen=True)
class _Part:
    """Size of one part of the error.

    ``floor_um``: by which repeats of the same condition disagree about it; NaN without repeats.
    """

    rms_um: float
    floor_um: float


_PARTS = ("measured", "controller", "quasi_static", "dynamic")


@dataclass(frozen=True)
class Split:
    """The parts of measured circles, one row for each run.

    ``parts_um``, (rows, bins): by the names of ``_PARTS``; the first is the sum of the others.
    ``known``, (rows, bins): where something was measured.
    ``condition_of``, (rows,): rows of one number are repeats.
    """

    parts_um: Mapping[str, Floats]
    known: NDArray[np.bool_]
    condition_of: NDArray[np.int64]

    def sizes(self, rows: NDArray[np.bool_] | None = None) -> dict[str, _Part]:
        """Return RMS and noise floor of every part, over the chosen rows, shape (rows,), or over all."""
        chosen = np.ones(len(self.known), dtype=bool) if rows is None else rows
        known, conditions = self.known[chosen], self.condition_of[chosen]
        return {
            name: _Part(rms(v[chosen][known]), _repeat_floor(v[chosen], known, conditions))
            for name, v in self.parts_um.items()
        }

    def seen_unseen_correlation(self, rows: NDArray[np.bool_]) -> float:
        """Return how alike the controller's part is to the rest; NaN when one of them is zero.

        The squares of two parts add up only when this is zero.
        """
        known = self.known[rows]
        seen = self.parts_um["controller"][rows][known]
        rest = (self.parts_um["measured"][rows] - self.parts_um["controller"][rows])[known]
        size = rms(seen) * rms(rest)
        return float(np.mean(seen * rest) / size) if size > 0.0 else float("nan")


def split(
    measured_um: Floats,
    controller_um: Floats,
    known: NDArray[np.bool_],
    condition_of: NDArray[np.int64],
    cycles_per_rev: Floats,
) -> Split:
    """Split measured circles into what the controller saw, quasi-static and dynamic error.

    Args:
        measured_um: Reference instrument, what belongs to its mounting taken out. Shape (rows, bins).
        controller_um: The controller's following error along the radius, the same taken out. Shape (rows, bins).
        known: Where something was measured. Shape (rows, bins).
        condition_of: Condition of each row. Shape (rows,).
        cycles_per_rev: Where quasi-static ends, for each row. Shape (rows,).
    """
    unseen = np.where(known, measured_um - controller_um, 0.0)
    rows = zip(unseen, known, cycles_per_rev.tolist(), strict=True)
    slow = np.array([slow_part(row, mask, cycles) for row, mask, cycles in rows])
    values = (measured_um, controller_um, slow, unseen - slow)
    parts = {n: np.where(known, v, 0.0) for n, v in zip(_PARTS, values, strict=True)}
    return Split(parts, known, condition_of)


def _repeat_floor(values: Floats, known: NDArray[np.bool_], condition_of: NDArray[np.int64]) -> float:
    """Return the RMS by which one run differs from the mean of its condition.

    ``values``, (rows, bins): one row for each run.
    ``known``, (rows, bins): where there are values.
    ``condition_of``, (rows,): rows of one number are repeats.
    With the freedom that the means take; NaN without repeats.
    """
    squares = share = 0.0
    freedom = 0
    for number in np.unique(condition_of):
        rows = condition_of == number
        if rows.sum() < 2:
            continue
        squares += float(((values[rows] - values[rows].mean(axis=0)) ** 2).sum())
        share += float(known[rows].sum(axis=1).mean()) * (int(rows.sum()) - 1)
        freedom += int(rows.sum()) - 1
    return float(np.sqrt(squares / share)) if freedom else float("nan")
