"""What the motion really was, against what the file's marks and programme say."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.stops import find_stops, lead_in_samples, true_period
from dtwin.schema import Finding, Floats, Run

_WINDOW_TOLERANCE = 0.03
_FEED_TOLERANCE = 0.02
_TURN_TOLERANCE, _MARKS_TOLERANCE = 0.05, 0.25
# A control that cannot reach a feed runs slower, but hardly by this factor.
_OTHER_FEED = 4.0
_STOP_S = 0.15
_LEAD_IN = 3.0
_AT_REVERSAL_DEG = 10.0
# Share of a turn that must be seen twice, and correlation of both times, before a record tells its own period.
_SEEN_TWICE, _REPEATS = 0.45, 0.75
_Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Motion:
    """The motion that a ball-bar record shows by itself.

    ``stops``: samples at which the machine stopped between half turns.
    ``period_samples``: samples of one revolution by correlation; NaN when the record holds less than about one and a
    half, or does not repeat.
    ``lead_in_samples``: samples before the record begins to repeat one revolution later.
    ``half_turns_samples``: samples from stop to stop.
    """

    stops: _Indices
    period_samples: float
    lead_in_samples: int
    half_turns_samples: tuple[int, ...]

    @property
    def revolution_samples(self) -> float:
        """Samples of one revolution: by the stops when there are three, else by correlation."""
        if len(self.half_turns_samples) >= 2:
            return float(2.0 * np.mean(self.half_turns_samples))
        return self.period_samples


def motion_of(run: Run) -> Motion:
    """Find stops and period of a circular run of more than one revolution, from its deviation alone."""
    deviation, rate = run.samples["deviation_um"], run.meta.sample_rate_hz
    stops = np.array([round(stop.sample) for stop in find_stops(deviation, rate)], dtype=np.int64)
    expected = _programmed_revolution(run)
    inner = _half_turn_chain(stops, expected / 2.0)
    halves = tuple(int(n) for n in np.diff(inner))
    period = _period(deviation[run.on_circle], rate, expected)
    first_turn = float(sum(halves[:2])) if len(halves) > 1 else period
    lead_in = lead_in_samples(deviation, rate, first_turn, _LEAD_IN) if np.isfinite(first_turn) else 0
    return Motion(inner, period, lead_in, halves)


def aligned_angle_deg(run: Run, motion: Motion) -> Floats | None:
    """Return angles that put every stop on a half turn; None with fewer than two stops.

    Which half turn a stop belongs to is taken from the file's own angles, rounded. Bursts between half turns, where the
    second axis reverses, are steps of a large backlash and no stops.
    """
    if len(motion.stops) < 2 or run.window is None:
        return None
    sign = 1.0 if run.meta.direction == "CCW" else -1.0
    start_deg = float(run.samples["angle_deg"][run.window[0]])
    counted = sign * 180.0 * np.arange(len(motion.stops))
    off = float(np.median(run.samples["angle_deg"][motion.stops] - start_deg - counted))
    if abs((start_deg + off) % 180.0 - 90.0) < _AT_REVERSAL_DEG:
        return None
    at_stops = start_deg + counted + 180.0 * np.round(off / 180.0)
    index = np.arange(run.n_samples)
    angle = np.interp(index, motion.stops, at_stops)
    mean_step = 360.0 / motion.revolution_samples * sign
    before, after = index < motion.stops[0], index > motion.stops[-1]
    angle[before] = at_stops[0] + (index[before] - motion.stops[0]) * mean_step
    angle[after] = at_stops[-1] + (index[after] - motion.stops[-1]) * mean_step
    return angle


def judge_motion(run: Run) -> list[Finding]:
    """Return findings about window, stops, angles and feed of a circular run; without a window only on its feed."""
    if not run.meta.radius_mm or not run.meta.feed_mm_min:
        return []
    if run.window is None:
        return list(_feed_by_angle(run, _TURN_TOLERANCE))
    # Marks may be off, but hardly by so much; then a period that is sought near the programmed one is none.
    by_marks = list(_feed_by_angle(run, _MARKS_TOLERANCE))
    if by_marks or run.n_samples < 1.3 * _programmed_revolution(run):
        return by_marks
    motion = motion_of(run)
    findings = [*_stops(motion), *_window(run, motion), *_feed(run, motion)]
    return [*findings, *_misregistered(run, motion), *_repeats(run, motion)]


def non_repeatable_um(run: Run, motion: Motion) -> tuple[float, float, float] | None:
    """Compare every half turn with the same one a revolution later.

    A machine that stops does not run on a clock: the lag is found anew for each half turn.
    The lead-in is left out, and so is the burst of each stop.

    RMS values; the non-repeatable part is that of one revolution. None when no half turn is seen twice.
    """
    deviation, margin = run.samples["deviation_um"], round(_STOP_S * run.meta.sample_rate_hz)
    first, second = [], []
    stops = [int(stop) for stop in motion.stops]
    last = stops[-1] - margin if stops else 0
    start = motion.lead_in_samples - margin
    bounds = [start, *(stop for stop in stops if stop > start + margin)]
    for begin, end in itertools.pairwise(bounds):
        stretch = slice(begin + margin, end - margin)
        lag = _best_lag(deviation[:last], stretch, motion.revolution_samples)
        if lag is not None:
            first.append(deviation[stretch])
            second.append(deviation[stretch.start + lag : stretch.stop + lag])
    if not first:
        return None
    one, two = np.concatenate(first), np.concatenate(second)
    correlation = float(np.corrcoef(one, two)[0, 1])
    repeatable = float(np.std((one + two) / 2.0))
    return correlation, repeatable, float(np.std(one - two) / np.sqrt(2.0))


def _best_lag(deviation: Floats, stretch: slice, revolution: float) -> int | None:
    """Return the lag near one revolution at which a stretch agrees best with a later one."""
    length = stretch.stop - stretch.start
    if not np.isfinite(revolution) or length < 0.15 * revolution:
        return None
    longest = min(int(1.04 * revolution), deviation.size - stretch.stop)
    lags = range(int(0.96 * revolution), longest + 1)
    apart = [float(np.std(deviation[stretch] - deviation[stretch.start + lag : stretch.stop + lag])) for lag in lags]
    return lags[int(np.argmin(apart))] if apart else None


def _period(deviation: Floats, rate_hz: float, expected: float) -> float:
    """Return the period, NaN where the record does not show it; the lead-in is left out and the period found again."""
    if deviation.size < (1.0 + _SEEN_TWICE) * expected:
        return np.nan
    skip, samples, repeats = 0, np.nan, 0.0
    for _ in range(2):
        try:
            period = true_period(deviation, rate_hz, expected / rate_hz, skip_samples=skip)
        except InputError:
            break
        samples, repeats = period.samples, period.correlation
        skip = lead_in_samples(deviation, rate_hz, samples)
    return samples if repeats > _REPEATS else np.nan


def _programmed_revolution(run: Run) -> float:
    radius, feed = run.meta.radius_mm, run.meta.feed_mm_min
    if radius is None or feed is None:
        return np.nan
    return 2.0 * np.pi * radius / (feed / 60.0) * run.meta.sample_rate_hz


def _half_turn_chain(stops: _Indices, half: float) -> _Indices:
    """Keep the longest chain of stops that follow each other about half a turn apart."""
    best: list[int] = []
    for start in range(len(stops)):
        chain = [int(stops[start])]
        for stop in stops[start + 1 :]:
            if 0.85 * half <= stop - chain[-1] <= 1.25 * half:
                chain.append(int(stop))
        best = chain if len(chain) > len(best) else best
    return np.asarray(best if len(best) > 1 else [], dtype=np.int64)


def _stops(motion: Motion) -> Iterator[Finding]:
    if len(motion.stops) < 2:
        return
    listed = ", ".join(map(str, motion.stops))
    yield Finding(
        "motion.stops",
        "info",
        f"the machine stops every half turn: bursts above 20 Hz near samples {listed}",
        {"samples_1": [float(s) for s in motion.stops]},
    )


def _window(run: Run, motion: Motion) -> Iterator[Finding]:
    assert run.window is not None
    marked = run.window[1] - run.window[0]
    angle = run.samples["angle_deg"]
    stated_deg = abs(float(angle[run.window[1] - 1] - angle[run.window[0]])) * marked / (marked - 1)
    period = motion.period_samples
    if not np.isfinite(period) or abs(stated_deg - 360.0) > 1.0:
        return
    true_deg = 360.0 * marked / period
    if abs(true_deg - 360.0) <= 360.0 * _WINDOW_TOLERANCE:
        return
    short = true_deg < 360.0
    yield Finding(
        "arc.window_short" if short else "arc.window_long",
        "error" if short else "warning",
        f"the window marked as a full circle is about {true_deg:z.0f} deg: {marked} samples are "
        f"marked, the true period is {period:z.0f}",
        {"marked_samples_1": float(marked), "period_samples_1": float(period), "true_deg": true_deg},
    )


def _feed(run: Run, motion: Motion) -> Iterator[Finding]:
    revolution = motion.revolution_samples
    radius, told = run.meta.radius_mm, run.meta.feed_mm_min
    if not np.isfinite(revolution) or radius is None or told is None:
        return
    real = 2.0 * np.pi * radius / (revolution / run.meta.sample_rate_hz) * 60.0
    yield from _feed_differs(real, told, "mean", _FEED_TOLERANCE)


def _feed_by_angle(run: Run, tolerance: float) -> Iterator[Finding]:
    """Hold the feed that angles and times show against the programmed one."""
    angle, t_s = run.samples["angle_deg"], run.samples["t_s"]
    if len(angle) < 3 or run.meta.radius_mm is None or run.meta.feed_mm_min is None:
        return
    # The median: starts, stops and dwells do not count.
    speed_rad_s = float(np.median(np.radians(np.abs(np.gradient(angle, t_s)))))
    yield from _feed_differs(speed_rad_s * run.meta.radius_mm * 60.0, run.meta.feed_mm_min, "median", tolerance)


def _feed_differs(real: float, told: float, which: str, tolerance: float) -> Iterator[Finding]:
    if abs(real - told) <= tolerance * told:
        return
    wrong = not 1.0 / _OTHER_FEED < real / told < _OTHER_FEED
    why = ": a wrong feed, or a radius in another unit" if wrong else ""
    yield Finding(
        "feed.differs",
        "error" if wrong else "warning",
        f"the {which} feed is {real:z.0f} mm/min, {100 * (real / told - 1):+z.1f} % of the programmed {told:z.0f}{why}",
        {"real_mm_min": real, "programmed_mm_min": told},
    )


def _misregistered(run: Run, motion: Motion) -> Iterator[Finding]:
    aligned = aligned_angle_deg(run, motion)
    if aligned is None or run.window is None:
        return
    inside = run.marked
    apart = np.abs(run.samples["angle_deg"][inside] - aligned[inside])
    worst = float(apart.max())
    if worst < 5.0:
        return
    yield Finding(
        "angle.misregistered",
        "error" if worst > 20.0 else "warning",
        f"the file's angles are misregistered by up to {worst:z.0f} deg against the stops",
        {"worst_deg": worst},
    )


def _repeats(run: Run, motion: Motion) -> Iterator[Finding]:
    scatter = non_repeatable_um(run, motion)
    if scatter is None:
        return
    correlation, repeatable, rest = scatter
    yield Finding(
        "repeat.revolutions",
        "info",
        f"consecutive revolutions, lead-in of {motion.lead_in_samples} samples left out: {repeatable:z.1f} µm RMS repeats "
        f"(correlation {correlation:z.2f}), {rest:z.1f} µm does not",
        {"correlation_1": correlation, "repeatable_um": repeatable, "non_repeatable_um": rest},
    )
