"""Runs averaged over bins of one degree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.physics.grid import Grid, PathCondition, Row
from dtwin.physics.state import AXES_OF, State, circular_state
from dtwin.schema import Direction, Floats, Plane, Run, RunMeta

N_BINS = 360
# Gauss-Legendre, within a bin from 0 to 1: the mean of what is, within a degree, a polynomial of degree 5 is exact.
_WITHIN_BIN = 0.5 * (1.0 + np.polynomial.legendre.leggauss(3)[0])
_WEIGHTS = 0.5 * np.polynomial.legendre.leggauss(3)[1]
_SAMPLE_COLUMNS = ("t_s", "angle_deg", "deviation_um")
_MIN_BINS = 30
_GAP_BINS = 3
_TURN_OVERHEAD_S = 20.0
_DESCRIBED_HARMONICS = 60
_SMOOTH_HARMONICS = 3
# From standstill, loops of a machine need about so long to follow; part of a circle is shorter than this.
_SETTLED_S, _WHOLE_DEG = 0.3, 350.0
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Condition:
    """What is set for a circular run; repeats share it."""

    plane: Plane
    radius_mm: float
    feed_mm_min: float
    direction: Direction

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that move."""
        return AXES_OF[self.plane]

    @property
    def sense(self) -> float:
        """Sense of motion: +1 for CCW, -1 for CW."""
        return 1.0 if self.direction == "CCW" else -1.0

    @property
    def turned(self) -> Condition:
        """The same circle the other way round."""
        return replace(self, direction="CW" if self.direction == "CCW" else "CCW")

    @property
    def mounted(self) -> str:
        """Plane and radius: another one needs another set-up."""
        return f"{self.plane} R{self.radius_mm:g}"

    @property
    def swept(self) -> Mapping[str, float]:
        """What campaigns change."""
        return {"feed": self.feed_mm_min, "radius": self.radius_mm}

    @property
    def seconds(self) -> float:
        """Time of two turns, with what comes before and after."""
        length_mm = 4.0 * np.pi * self.radius_mm
        return float(length_mm / (self.feed_mm_min / 60.0)) + _TURN_OVERHEAD_S

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))

    def __str__(self) -> str:
        """Return it as people write it."""
        return f"{self.plane} R{self.radius_mm:g} F{self.feed_mm_min:g} {self.direction}"


def _condition_of_run(meta: RunMeta) -> Condition:
    """Return the condition of a circular run."""
    radius, feed = meta.radius_mm, meta.feed_mm_min
    if meta.plane is None or meta.direction is None or radius is None or feed is None:
        raise InputError(
            "a twin of circular tests needs plane, radius, feed and direction of every run",
            code="twin.condition",
            where=f"run {meta.run_id}",
            got=f"plane {meta.plane}, radius {radius}, feed {feed}, direction {meta.direction}",
        )
    return Condition(meta.plane, radius, feed, meta.direction)


def rows_of(run: Run, time_h: float) -> list[Row]:
    """Average one run over the bins of each of its turns.

    ``run``: with ``angle_deg`` and ``deviation_um``.
    Raises ``InputError`` when columns are missing or the run is too short.
    """
    condition = _condition_of_run(run.meta)
    if not {"angle_deg", "deviation_um"} <= set(run.samples):
        raise InputError(
            "a circular run needs angle_deg and deviation_um",
            code="twin.columns",
            where=f"run {run.meta.run_id}",
            got=", ".join(run.samples),
        )
    marked = slice(*run.window) if run.window else slice(None)
    angle = np.asarray(run.samples["angle_deg"], dtype=float)[marked]
    if len(angle) < _MIN_BINS:
        raise _too_short(run, len(angle))
    sign = 1.0 if condition.direction == "CCW" else -1.0
    settled = _settled(run, angle)
    # A sample on the seam belongs to the turn that it ends, not to one of its own.
    turn = np.floor((sign * (angle - angle[0]) - 1e-9) / 360.0).astype(int).clip(0)
    bins = np.floor(angle).astype(int) % N_BINS
    feed_mm_s = _reached_feed_mm_s(run, marked, angle, condition)
    names = [n for n in run.samples if n not in _SAMPLE_COLUMNS and not n.startswith(("cmd_", "act_"))]
    out = []
    for number in range(int(turn.max()) + 1):
        here = (turn == number) & settled
        count = np.bincount(bins[here], minlength=N_BINS)
        mask = count > 0
        if mask.sum() < _MIN_BINS:
            continue

        gaps = _short_gaps(mask)
        means = {
            name: _filled(np.asarray(run.samples[name], dtype=float)[marked][here], bins[here], count, gaps)
            for name in ("deviation_um", *names)
        }
        y_um = means.pop("deviation_um")
        y_um += _off_centre_um(run, marked, angle, here, mask | gaps)
        columns = {"time_h": time_h, **run.meta.covariates, **means}
        out.append(Row(run, condition, y_um, mask | gaps, columns, feed_mm_s))
    if not out:
        raise _too_short(run, len(angle))
    return out


def _settled(run: Run, angle_deg: Floats) -> NDArray[np.bool_]:
    """Return which samples of the marked arc are not still on the way from standstill, in whole degrees, shape (n,).

    Part of a circle begins a few degrees after the machine was fed in and stopped; where the record does not show that, and on
    whole circles, all are.
    """
    passed = np.abs(angle_deg - angle_deg[0])
    begun = run.on_circle.start if run.window else 0
    if not begun or passed[-1] > _WHOLE_DEG or "t_s" not in run.samples:
        return np.ones(angle_deg.size, dtype=bool)
    wait = int(np.searchsorted(run.samples["t_s"][run.marked] - run.samples["t_s"][begun], _SETTLED_S))
    return np.asarray(passed >= np.ceil(passed[min(wait, passed.size - 1)]) - 1e-6)


def _off_centre_um(
    run: Run, marked: slice, angle_deg: Floats, here: NDArray[np.bool_], known: NDArray[np.bool_]
) -> Floats:
    """Return what samples that do not lie evenly in their bins leave out of the bin means.

    A centre offset of 0.1 mm changes by 2 um from one bin to the next: where the samples lie
    inside a bin matters. The smooth part of the run is known well enough to correct for it.
    """
    values = np.asarray(run.samples["deviation_um"], dtype=float)[marked][here]
    theta = np.radians(angle_deg[here])
    fitted = np.linalg.lstsq(_waves(theta), values, rcond=1e-8)[0]
    bins = np.floor(angle_deg[here]).astype(int) % N_BINS
    count = np.bincount(bins, minlength=N_BINS)
    sampled = _filled(_waves(theta) @ fitted, bins, count, known & (count == 0))
    whole = _averaged(_waves(fine_angle_rad()) @ fitted[:, None])[:, 0]
    return np.where(known, whole - sampled, 0.0)


def _waves(theta: Floats) -> Floats:
    parts = [f(h * theta) for h in range(1, _SMOOTH_HARMONICS + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(theta), *parts], axis=1)


def _short_gaps(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the empty bins that have a neighbour with samples within two degrees."""
    near = mask.copy()
    for shift in range(1, _GAP_BINS + 1):
        near |= np.roll(mask, shift) & np.roll(mask, shift - _GAP_BINS - 1)
    return near & ~mask


def _filled(values: Floats, bins: Indices, count: Indices, gaps: NDArray[np.bool_]) -> Floats:
    """Return bin means, short gaps interpolated from their neighbours, else zero."""
    mean = np.bincount(bins, values, N_BINS) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    mean[gaps] = np.interp(np.flatnonzero(gaps), known, mean[known], period=N_BINS)
    return np.asarray(mean)


def _too_short(run: Run, n: int) -> InputError:
    return InputError(
        "a run is too short for a circle",
        code="twin.short",
        where=f"run {run.meta.run_id}",
        got=f"{n} samples",
        allowed=f"at least {_MIN_BINS} different degrees",
    )


def _reached_feed_mm_s(run: Run, marked: slice, angle_deg: Floats, condition: Condition) -> float:
    """Return the mean path speed, from the clock when there is one."""
    programmed = condition.feed_mm_min / 60.0
    if "t_s" not in run.samples:
        return programmed
    t_s = np.asarray(run.samples["t_s"], dtype=float)[marked]
    spent = float(t_s[-1] - t_s[0])
    if spent <= 0.0:
        return programmed
    return abs(float(np.radians(angle_deg[-1] - angle_deg[0]))) * condition.radius_mm / spent


def fine_angle_rad() -> Floats:
    """Return the angles at which effects are evaluated, several in each bin."""
    return np.asarray(np.radians(np.add.outer(np.arange(N_BINS), _WITHIN_BIN)).ravel(), dtype=np.float64)


def _averaged(fine: Floats) -> Floats:
    """Return bin means, shape (..., 360, k), of values at the fine angles, shape (..., n, k)."""
    parts = fine.reshape(*fine.shape[:-2], N_BINS, len(_WEIGHTS), fine.shape[-1])
    return np.asarray(np.einsum("i,...ik->...k", _WEIGHTS, parts))


def bin_angle_rad() -> Floats:
    """Return the middle of every bin, shape (360,)."""
    return np.asarray((np.arange(N_BINS) + 0.5) * (np.pi / 180.0), dtype=np.float64)


def _state(meta: RunMeta, condition: PathCondition, feed_mm_s: float, geometry: Mapping[str, Any]) -> State:
    return circular_state(meta, fine_angle_rad(), feed_mm_s=feed_mm_s, columns={}, geometry=geometry)


def _circle() -> Grid:
    theta = bin_angle_rad()
    return Grid(
        kind="circular",
        coordinate="angle_deg",
        points=np.arange(0.5, N_BINS),
        setup=np.stack([np.ones(N_BINS), np.cos(theta), np.sin(theta)], axis=1),
        setup_names=("radius_um", "centre_first_um", "centre_second_um"),
        fine=len(_WEIGHTS),
        averaged=_averaged,
        state=_state,
        described=_DESCRIBED_HARMONICS,
        wave="harmonic {}".format,
        in_plane=True,
    )


CIRCLE = _circle()
