"""What circles say together: readings that neither their neighbours nor other runs know, and repeats that disagree."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dtwin.physics.circular import fit_circle, residual_um
from dtwin.schema import Finding, Floats, Run
from dtwin.statistics import usual_size
from dtwin.units import shown_number

_BESIDE = 5
"""Readings before and after that one is held against."""
_FAR = 6.0
"""Robust standard deviations of all readings of a run about their neighbours."""
_APART = 2.5
"""How many times a spoilt reading is further off than what else stands off: in its run, and in others at its angle."""
_LEAST_UM = 1.0
"""Less is of the size of a ball bar's own uncertainty."""
_MOST_PLACES = 3
"""Places of one run that may be spoilt; more is something else, such as stick-slip or a loose cable."""
_NEAR_DEG = 10.0
"""Spikes of a reversal come so late after a quadrant, and so differently from run to run."""
_FEWEST_OTHERS = 4
"""Runs that must show the reversals, before a reading at one is called spoilt."""
_SHOWN = 6
_BIN_DEG = 2.0
_MANY_TIMES = 5.0
_LEAST_DIFFERENCE_UM = 0.5
_UNITS, _NEAR, _ALIKE = (10.0, 25.4, 1000.0), 0.1, 0.7
"""Factors between units, by which share one may be missed, and the correlation of curves that have one shape."""


@dataclass(frozen=True)
class _Off:
    """How far each reading of a run stands off those before and after it alike.

    ``off_um`` (n,): off the nearer side, 0 where the two do not agree; ``mean_um`` (n,): off both on the average.
    ``usual_um``: what readings scatter by about their neighbours.
    """

    angle_deg: Floats
    off_um: Floats
    mean_um: Floats
    usual_um: float

    def near(self, angle_deg: float, *, quadrants: bool) -> float:
        """Return the most that a reading stands off near an angle, or near any quadrant."""
        there = _at_quadrant(self.angle_deg) if quadrants else _apart_deg(self.angle_deg, angle_deg) <= _NEAR_DEG
        return float(np.abs(self.off_um[there]).max(initial=0.0))


@dataclass(frozen=True)
class _Spoilt:
    """A reading that neither its neighbours nor other runs know; ``row`` counts from 0 in the run's samples."""

    run: str
    row: int
    angle_deg: float
    off_um: float
    usual_um: float


def across_findings(runs: Sequence[Run]) -> list[Finding]:
    """Return spoilt readings and repeats that disagree; of runs without samples nothing."""
    whole = [run for run in runs if _can_be_judged(run)]
    spoilt = _spoilt_readings(whole)
    findings = [finding] if (finding := _spoilt_finding(spoilt)) is not None else []
    names = {s.run for s in spoilt}
    binned = [(run, _binned(run)) for run in whole]
    differing = _differing_finding([one for one in binned if one[0].meta.run_id not in names])
    return [*findings, *([] if differing is None else [differing]), *_of_another_unit(binned)]


def _of_another_unit(runs: Sequence[tuple[Run, Floats]]) -> Iterator[Finding]:
    """Yield a finding for each condition whose largest and smallest circle have one shape, and sizes that are a unit apart."""
    of_condition: dict[tuple[object, ...], list[tuple[str, Floats]]] = {}
    for run, curve in runs:
        m = run.meta
        of_condition.setdefault((m.plane, m.radius_mm, m.feed_mm_min), []).append((m.run_id, curve))
    for members in of_condition.values():
        curves = np.stack([curve for _, curve in members])
        curves = curves[:, np.isfinite(curves).all(axis=0)]
        size = np.sqrt(np.mean(curves**2, axis=1)) if curves.size else np.zeros(1)
        small, large = int(size.argmin()), int(size.argmax())
        ratio = float(size[large] / size[small]) if size[small] > 0.0 else 0.0
        unit = next((unit for unit in _UNITS if abs(ratio / unit - 1.0) < _NEAR), 0.0)
        if unit and float(np.mean(curves[large] * curves[small])) > _ALIKE * size[large] * size[small]:
            said = (
                f"{members[large][0]} and {members[small][0]} have one shape, and the first is {shown_number(ratio)} times as large: about {unit:g}, as between "
                "units (mm, µm, inch); one of both was written in another unit than it is read in"
            )
            yield Finding("circular.scale", "warning", said, {"ratio_1": ratio})


def with_spoilt_told(runs: Sequence[Run]) -> list[Run]:
    """Return the runs; those with a spoilt reading have an error that says so."""
    by_run: dict[str, list[_Spoilt]] = {}
    for spoilt in _spoilt_readings([run for run in runs if _can_be_judged(run)]):
        by_run.setdefault(spoilt.run, []).append(spoilt)
    told = {name: finding for name, own in by_run.items() if (finding := _spoilt_finding(own)) is not None}
    return [
        replace(run, findings=(*run.findings, told[run.meta.run_id])) if run.meta.run_id in told else run
        for run in runs
    ]


def _can_be_judged(run: Run) -> bool:
    if run.meta.radius_mm is None or not {"angle_deg", "deviation_um"} <= set(run.samples):
        return False
    return run.arc[0].size > 4 * _BESIDE and not any(f.severity == "error" for f in run.findings)


def _spoilt_readings(runs: Sequence[Run]) -> list[_Spoilt]:
    """Return the spoilt readings of runs with samples.

    A step, a slope or the edge of a slip agrees with one of its sides. A spike of a reversal stands off both, but
    other quadrants, and other runs at the same angle, have one, too.
    """
    offs = [_off(run) for run in runs]
    spoilt = []
    for run, own in zip(runs, offs, strict=True):
        others = [
            off
            for other, off in zip(runs, offs, strict=True)
            if off is not own and (other.meta.plane, other.meta.radius_mm) == (run.meta.plane, run.meta.radius_mm)
        ]
        for row in _candidates(own):
            angle = float(own.angle_deg[row])
            quadrant = bool(_at_quadrant(own.angle_deg[[row]])[0])
            if quadrant and len(others) < _FEWEST_OTHERS:
                continue
            known = max((other.near(angle, quadrants=quadrant) for other in others), default=0.0)
            if abs(own.off_um[row]) > _APART * known:
                first = run.marked.start or 0
                size = float(own.mean_um[row])
                spoilt.append(_Spoilt(run.meta.run_id, first + row, angle % 360.0, size, own.usual_um))
    return spoilt


def _off(run: Run) -> _Off:
    angle, deviation = run.arc
    windows = np.lib.stride_tricks.sliding_window_view(deviation, _BESIDE)
    beside = np.median(windows, axis=1)
    middle = slice(_BESIDE, deviation.size - _BESIDE)
    before, after = deviation[middle] - beside[: -_BESIDE - 1], deviation[middle] - beside[_BESIDE + 1 :]
    off, mean = np.zeros(deviation.size), np.zeros(deviation.size)
    mean[middle] = (before + after) / 2.0
    alike = np.sign(before) == np.sign(after)
    off[middle] = np.where(alike, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0.0)
    steps = np.diff(np.unique(np.round(deviation, 4)))
    # Readings that are rounded agree better than what was read: not to less than a step.
    rounded = float(steps.min()) / math.sqrt(12.0) if steps.size else 0.0
    return _Off(angle, off, mean, max(usual_size(mean[middle]), rounded))


def _candidates(own: _Off) -> list[int]:
    """Return where a run alone has readings that stand far off, the farthest of each place; none where many do.

    Reversals make spikes: at quadrants and between them are judged each by itself.
    """
    size, quadrant = np.abs(own.off_um), _at_quadrant(own.angle_deg)
    likely: list[int] = []
    for here in (quadrant, ~quadrant):
        rows = np.flatnonzero(here)
        places: list[int] = []
        for row in rows[np.argsort(-size[rows])[: (2 * _BESIDE + 1) * (_MOST_PLACES + 1)]].tolist():
            if all(abs(row - other) > _BESIDE for other in places):
                places.append(row)
        # One place more than may be spoilt tells what else the run stands off by.
        usual = size[places[_MOST_PLACES]] if len(places) > _MOST_PLACES else 0.0
        limit = max(_FAR * own.usual_um, _APART * usual, _LEAST_UM)
        likely += [row for row in places[:_MOST_PLACES] if size[row] > limit]
    return sorted(likely)


def _at_quadrant(angle_deg: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.abs((angle_deg + 45.0) % 90.0 - 45.0) <= _NEAR_DEG)


def _apart_deg(angle_deg: Floats, other_deg: float) -> Floats:
    return np.abs((angle_deg - other_deg + 180.0) % 360.0 - 180.0)


def _spoilt_finding(spoilt: Sequence[_Spoilt]) -> Finding | None:
    if not spoilt:
        return None
    one = len(spoilt) == 1
    told = "; ".join(
        f"{s.run} at {s.angle_deg:z.1f}° (sample {s.row + 1}): {shown_number(s.off_um, sign='+')} µm off the readings before and after it, which scatter by {shown_number(s.usual_um, 2)} µm"
        for s in spoilt[:_SHOWN]
    )
    runs = " ".join(dict.fromkeys(s.run for s in spoilt))
    more = f"; and {len(spoilt) - _SHOWN} more" if len(spoilt) > _SHOWN else ""
    said = (
        f"{len(spoilt)} reading{'' if one else 's'} {'is' if one else 'are'} spoilt ({told}{more}): a lost count, or a chip under the ball; no other run has it there. "
        f"Take the row out of the file, measure that run again, or leave the run out: dtwin leave-out CAMPAIGN {runs} --because REASON"
    )
    return Finding(
        "circular.spoilt_readings",
        "error",
        said,
        {"readings_1": float(len(spoilt)), "largest_um": max(abs(s.off_um) for s in spoilt)},
    )


def _differing_finding(runs: Sequence[tuple[Run, Floats]]) -> Finding | None:
    """Return that repeats differ by many times what readings of one run scatter by, None where they do not.

    Both are robust: spikes of reversals, which come a little later or higher each time, do not count.
    """
    of_condition: dict[tuple[object, ...], list[Floats]] = {}
    within = []
    for run, curve in runs:
        m = run.meta
        of_condition.setdefault((m.plane, m.radius_mm, m.feed_mm_min, m.direction), []).append(curve)
        within.append(_scatter_um(run.arc[1]))
    off = list(_off_their_mean(of_condition))
    if not off:
        return None
    differ_um, scatter_um = usual_size(np.concatenate(off)), float(np.median(within))
    if differ_um < max(_MANY_TIMES * scatter_um, _LEAST_DIFFERENCE_UM):
        return None
    said = (
        f"repeats of a condition differ by {shown_number(differ_um, 2)} µm RMS after centre and radius, readings within a run scatter by {shown_number(scatter_um, 2)} µm: the set-up or the "
        "machine moves between runs (a bar that is not seated, a cooler that switches, heat), and faults smaller than that are not seen. Seat the bar anew, warm the "
        "machine up, note what switches, and repeat one condition five times in a row until repeats agree"
    )
    return Finding("circular.repeats_differ", "warning", said, {"repeats_um": differ_um, "within_um": scatter_um})


def _off_their_mean(of_condition: Mapping[tuple[object, ...], Sequence[Floats]]) -> Iterable[Floats]:
    for members in of_condition.values():
        curves = np.stack(members)
        curves = curves[:, np.isfinite(curves).all(axis=0)]
        if len(curves) > 1 and curves.size:
            # The mean took a share of every run with it.
            yield ((curves - curves.mean(axis=0)) * math.sqrt(len(curves) / (len(curves) - 1))).ravel()


def _binned(run: Run) -> Floats:
    """Return the deviation after the run's own centre and radius in bins of the angle, NaN where there is none."""
    angle, deviation = run.arc
    radius = float(run.meta.radius_mm or 0.0)
    rest = residual_um(angle, deviation, radius, fit_circle(angle, deviation, radius))
    n_bins = round(360.0 / _BIN_DEG)
    number = np.floor(angle / _BIN_DEG).astype(np.int64) % n_bins  # -1e-14 % 360 would be 360
    count = np.bincount(number, minlength=n_bins)
    total = np.bincount(number, weights=rest, minlength=count.size)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _scatter_um(deviation: Floats) -> float:
    """Return what neighbouring readings scatter by: of second differences, which a curve hardly has."""
    return usual_size(np.diff(deviation, n=2)) / math.sqrt(6.0)
