"""One recording as passes over the same path: what repeats, and the state at every sample."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtwin.acquire.motion_quality import Motion, aligned_angle_deg, motion_of
from dtwin.errors import InputError
from dtwin.physics.state import State, circular_state
from dtwin.schema import Floats, Run
from studies.recording_effects import ARC_SHARE, ARC_SIGN, SINCE_STOP

_STOP_S = 0.15
_SHORTEST = 0.15
_LAG_RANGE = (0.96, 1.04)


@dataclass(frozen=True)
class Stretch:
    """Part of a recording that is seen again one revolution later.

    ``first``, ``end``: samples of the first pass, end excluded.
    ``lag_samples``: how much later the second pass is.
    ``non_repeatable_um``: RMS of one pass about the mean of both.
    """

    run_id: str
    first: int
    end: int
    lag_samples: int
    non_repeatable_um: float

    @property
    def second(self) -> slice:
        """Samples of the second pass."""
        return slice(self.first + self.lag_samples, self.end + self.lag_samples)

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return dict(vars(self))


@dataclass(frozen=True)
class Aligned:
    """A run with the angles that its stops give.

    ``state``: state at every sample, angles aligned.
    ``file_state``: state at every sample, angles as the file says.
    """

    run: Run
    motion: Motion
    state: State
    file_state: State
    stretches: tuple[Stretch, ...]

    @property
    def misregistered_deg(self) -> float:
        """Largest difference between the file's angles and the aligned ones in the window."""
        inside = self.run.marked
        apart = self.state.angle_rad[inside] - self.file_state.angle_rad[inside]
        return float(np.degrees(np.abs(apart).max()))


def align(run: Run, geometry: Mapping[str, Any]) -> Aligned:
    """Align a run by its stops and find what it repeats.

    ``run``: a circular run that stops every half turn, longer than one revolution.
    ``geometry``: ``machine_geometry``; empty when it is not known.
    """
    motion = motion_of(run)
    angle_deg = aligned_angle_deg(run, motion)
    if angle_deg is None:
        raise InputError(
            "the recording cannot be aligned",
            code="single.no_stops",
            where=f"run {run.meta.run_id}",
            got=f"{len(motion.stops)} stops and {'a' if run.window else 'no'} marked window",
            allowed="two or more stops half a turn apart, and a marked window",
            hint="dtwin ingest reads arcs and single turns, too; for dtwin twin fit and diagnose measure each several times",
        )
    stretches = _repeated(run, motion)
    if not stretches:
        raise InputError(
            "the recording repeats nothing, so nothing can be held out",
            code="single.no_repeat",
            where=f"run {run.meta.run_id}",
            hint="record two revolutions or more",
        )
    return Aligned(
        run,
        motion,
        _state(run, motion, angle_deg, geometry),
        _state(run, motion, run.samples["angle_deg"], geometry),
        stretches,
    )


def _repeated(run: Run, motion: Motion) -> tuple[Stretch, ...]:
    """Return the parts of half turns that are seen again, each with a lag of its own."""
    deviation = run.samples["deviation_um"]
    margin = round(_STOP_S * run.meta.sample_rate_hz)
    # What follows the last stop has no other half turn to be counted by.
    usable = int(motion.stops[-1]) - margin
    start = motion.lead_in_samples
    bounds = [start - margin, *(int(s) for s in motion.stops if s > start)]
    stretches = []
    for begin, end in itertools.pairwise(bounds):
        stretch = _best(run.meta.run_id, deviation[:usable], begin + margin, end - margin, motion)
        if stretch is not None:
            stretches.append(stretch)
    return tuple(stretches)


def within_run_floor_um(stretches: tuple[Stretch, ...]) -> float:
    """Return the RMS of one pass about the mean of two, all stretches together, in um. ``stretches``: at least one."""
    weight = np.array([s.end - s.first for s in stretches], dtype=float)
    square = np.array([s.non_repeatable_um**2 for s in stretches])
    return float(np.sqrt((weight * square).sum() / weight.sum()))


def _best(run_id: str, deviation: Floats, first: int, end: int, motion: Motion) -> Stretch | None:
    revolution = motion.revolution_samples
    longest = min(int(_LAG_RANGE[1] * revolution), deviation.size - first - 1)
    best: Stretch | None = None
    for lag in range(int(_LAG_RANGE[0] * revolution), longest + 1):
        stop = min(end, deviation.size - lag)
        if stop - first < _SHORTEST * revolution:
            continue
        apart = deviation[first:stop] - deviation[first + lag : stop + lag]
        size = float(np.std(apart) / np.sqrt(2.0))
        if best is None or size < best.non_repeatable_um:
            best = Stretch(run_id, first, stop, lag, size)
    return best


def _state(run: Run, motion: Motion, angle_deg: Floats, geometry: Mapping[str, Any]) -> State:
    radius = run.meta.radius_mm
    assert radius is not None
    rate = run.meta.sample_rate_hz
    return circular_state(
        run.meta,
        np.radians(angle_deg),
        feed_mm_s=2.0 * np.pi * radius * rate / motion.revolution_samples,
        columns=_clock(motion, angle_deg, rate, run.n_samples),
        geometry=geometry,
    )


def _clock(motion: Motion, angle_deg: Floats, rate_hz: float, n: int) -> dict[str, Floats]:
    half = motion.revolution_samples / 2.0
    before = motion.stops[0] - half
    starts = np.array([before - half, before, *motion.stops.astype(float)])
    index = np.arange(n, dtype=float)
    arc = np.clip(np.searchsorted(starts, index, side="right") - 1, 0, len(starts) - 1)
    lengths = np.append(np.diff(starts), half)
    middle_deg = np.interp(starts[arc] + lengths[arc] / 2.0, index, angle_deg)
    return {
        "time_h": index / rate_hz / 3600.0,
        SINCE_STOP: (index - starts[arc]) / rate_hz,
        ARC_SHARE: (index - starts[arc]) / lengths[arc],
        ARC_SIGN: np.where(np.sin(np.radians(middle_deg)) >= 0.0, 1.0, -1.0),
    }
