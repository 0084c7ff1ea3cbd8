"""What is wrong with a positioning test, said before anyone compensates by it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.quality import judge_clock, judge_places
from dtwin.positioning._cycles import ORDINARY, moving_zero, shifted_zero, zero_of_each_cycle
from dtwin.positioning._moving_reversal import moving_reversal
from dtwin.positioning._spoilt import spoilt_finding
from dtwin.positioning.matrix import TARGET_MM, LinearTest, clock_is_assumed, linear_test
from dtwin.positioning.ways import BOTH, LENGTHS, Scale, Ways, ways_of
from dtwin.schema import Finding, Floats, Run
from dtwin.units import is_number, shown_number

# Fewer phases of the screw than this leave a second harmonic without redundancy.
FEWEST_PHASES = 5
_FEWEST_WAVES = 2.1
"""Of a wave of the screw that targets show as a long one, in the travel: fewer look like an error of the slope."""
_EQUAL = 0.1
"""Parts of a pitch that equal steps may differ by; random parts after ISO 230-2 are larger."""
_GOLDEN = (0.382, 0.618)
_STUCK_READINGS = 12
_FEWEST_FOR_DRIFT = 8
_FEWEST_EQUAL = 3
"""Cycles that do not differ by chance."""
_FEWEST_TURNED, _TURNED = 5, 4.0
"""Targets, and how many times as well the other order must fit, that readings stand upside down."""
_CLIPPED, _CLIPPED_TIMES = 10, 5
"""Readings of one value at the end of all, and how many times as often as any other value, that are clipped; and fewest values of a fine display."""


def _targets_of(position_mm: Floats) -> Floats:
    """Return the targets among positions, ascending, in multiples of ``TARGET_MM``."""
    return np.unique(np.round(np.asarray(position_mm, float) / TARGET_MM)) * TARGET_MM


def phases_of(position_mm: Floats, pitch_mm: float) -> int:
    """Return at how many different angles of the screw there are targets.

    ``position_mm``, (n,): targets.
    ``pitch_mm``: travel in one turn of the screw.
    """
    turned = np.sort(np.mod(np.asarray(position_mm, float), pitch_mm))
    gaps = np.diff(turned, append=turned[0] + pitch_mm)
    return max(1, int(np.count_nonzero(gaps > TARGET_MM)))


def beat_of(step: float, span: float, pitch: float) -> tuple[float, float] | None:
    """Return which wave of the screw equal steps show as a long one, and how long that is; None where they show none so.

    ``step``, ``span``, ``pitch``: of the targets, of all of them, and of the screw, in one unit. Long is about half of the span or more:
    such a wave looks like an error of the slope. The first of the pitch and its half counts.
    """
    for wave in (pitch, pitch / 2.0):
        turns = round(step / wave)
        apart = abs(1.0 / wave - turns / step)
        if turns and apart * span < _FEWEST_WAVES:
            return wave, 1.0 / apart if apart > 0.0 else math.inf
    return None


def judge_positioning_run(run: Run, scale: Scale = LENGTHS) -> Iterator[Finding]:
    """Yield the findings of one positioning run.

    ``run``: with positions, ``direction`` and deviations, as ``scale`` calls them.
    """
    position, error = run.samples[scale.position], run.samples[scale.error]
    # Of a clock that was assumed, a gap is a reading that is missing.
    assumed = clock_is_assumed([run])
    clock = [f for f in judge_clock(run, _turns(run, scale)) if not assumed or f.code != "clock.dropout"]
    yield from clock
    yield from _missed(run, scale)
    largest = float(np.max(np.abs(error)))
    if largest > scale.largest:
        yield Finding(
            "reading.out_of_range",
            "error",
            f"an error of {largest:z.0f} {scale.fine} is beyond any axis: wrong unit, a lost beam, or the "
            "instrument was not zeroed at the first target",
            {f"largest_{scale.figure}": largest},
        )
    yield from judge_places(error, position, scale.error, f"{scale.kind}.positions")
    constant = _longest_constant(error)
    if constant >= _STUCK_READINGS:
        yield Finding(
            "reading.stuck",
            "error",
            f"{constant} equal errors in a row: the beam was broken or the instrument not read",
            {"readings_1": float(constant)},
        )
    pitch = run.meta.condition.get("screw_pitch_mm")
    if is_number(pitch) and pitch > 0.0:
        yield from _aliased(_targets_of(position), pitch)


def _turns(run: Run, scale: Scale) -> NDArray[np.bool_]:
    """Return between which readings, (readings - 1,), the axis turned or went back to where a sweep begins."""
    position, way = run.samples[scale.position], run.samples["direction"]
    return np.asarray((way[1:] != way[:-1]) | (np.abs(np.diff(position)) > np.ptp(position) - TARGET_MM))


def judge_positioning_campaign(runs: Sequence[Run], scale: Scale = LENGTHS) -> list[Finding]:
    """Return what the positioning runs of a campaign say together: repeats, spoilt readings, drift."""
    runs = [run for run in runs if run.samples]
    said = "one run only: repeatability and noise floor are unknown"
    single = [Finding("campaign.no_repeat", "warning", said, {"conditions_1": 1.0})] if len(runs) == 1 else []
    tests = tests_by_axis(runs, scale) if runs else []
    told = [finding for test in tests for finding in _across_cycles(test)]
    datum, zeroed, clipped, equal = (
        [finding for test in tests if (finding := judge(test)) is not None]
        for judge in (shifted_zero, zero_of_each_cycle, _clipped, _equal_cycles)
    )
    of_axes = [alike for _, alike in by_axis(runs)]
    unknown = [test for test, alike in zip(tests, of_axes, strict=True) if not _read_backwards(alike, scale)]
    turned = [finding for test in unknown if (finding := _turned(test)) is not None]
    drift = [finding for alike in of_axes for finding in _drift(alike, scale)]
    short = [finding for test, alike in zip(tests, of_axes, strict=True) for finding in _ended_early(test, alike)]
    return [*single, *short, *clipped, *equal, *turned, *(told or drift), *datum, *zeroed]


def _ended_early(test: LinearTest, runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield what runs that read a part of the travel do to the figures, which are of the targets that all runs read."""
    scale = test.scale
    targets = {run.meta.run_id: _targets_of(run.samples[scale.position]) for run in runs}
    most = max(map(len, targets.values()))
    short = [name for name, own in targets.items() if len(own) < most]
    if test.left_out and short and len(test.position_mm) and most > len(test.position_mm):
        yield Finding(
            f"{scale.kind}.ended_early",
            "warning",
            f"{len(short)} of {len(targets)} runs read a part of the travel: all figures are of {len(test.position_mm)} of {most} targets, "
            f"from {test.position_mm[0]:z.6g} to {test.position_mm[-1]:z.6g} {scale.unit}; "
            f"leave {', '.join(short[:3])} out, or measure to the end",
            {"targets_1": float(len(test.position_mm))},
        )


def tests_by_axis(runs: Sequence[Run], scale: Scale) -> list[LinearTest]:
    """Return the test of each axis: of both directions, or of each one of an axis that has none of both."""
    return [linear_test(alike, ways, scale) for ways, alike in by_axis(runs)]


def by_axis(runs: Sequence[Run]) -> list[tuple[Ways, list[Run]]]:
    """Return the runs axis by axis with their directions: those of both, or those of one where an axis has no others."""
    axes: dict[str, dict[Ways, list[Run]]] = {}
    for run in runs:
        of_axis = axes.setdefault(str(run.meta.condition.get("axis", "")), {})
        of_axis.setdefault(ways_of(run), []).append(run)
    return [
        (ways, alike)
        for of_axis in axes.values()
        for ways, alike in of_axis.items()
        if ways == BOTH or BOTH not in of_axis
    ]


def _across_cycles(test: LinearTest) -> list[Finding]:
    if test.position_mm.size < 2:
        return []
    reversal = moving_reversal(test)
    moving = moving_zero(reversal.taken_out(test) if reversal else test)
    told = (spoilt_finding(test), *(moved.finding if moved else None for moved in (reversal, moving)))
    return [finding for finding in told if finding is not None]


def _clipped(test: LinearTest) -> Finding | None:
    """Return that the largest or the smallest deviation was read again and again, as no other one: the instrument was at the end of its range."""
    read = np.concatenate([test.forward_um.ravel(), test.reverse_um.ravel()])
    values, counts = np.unique(np.round(read, 4), return_counts=True)
    for end in (0, -1) if values.size > _CLIPPED else ():
        # What a coarse display reads often, other values are, too.
        if counts[end] >= _CLIPPED and counts[end] > _CLIPPED_TIMES * np.delete(counts, end).max():
            said = (
                f"axis {test.axis}: {counts[end]} readings of {read.size} are {values[end]:g} {test.scale.fine}, the {'smallest' if end == 0 else 'largest'} of all, and no "
                "other value is nearly as frequent: the instrument, or what wrote the table, was at the end of its range"
            )
            return Finding(f"{test.scale.kind}.clipped", "error", said, {"readings_1": float(counts[end])})
    return None


def _equal_cycles(test: LinearTest) -> Finding | None:
    """Return that no reading differs from cycle to cycle: nothing tells how well the axis repeats."""
    read = np.vstack([test.forward_um, test.reverse_um])
    if read.shape[1] < _FEWEST_EQUAL or np.any(np.ptp(read, axis=1) != 0.0):
        return None
    said = (
        f"axis {test.axis}: all {read.shape[1]} cycles read the same at every target, to the last digit: copies of one cycle, or a display too coarse "
        "to show scatter; repeatability is not known"
    )
    return Finding(f"{test.scale.kind}.equal_cycles", "warning", said, {"cycles_1": float(read.shape[1])})


def _read_backwards(runs: Sequence[Run], scale: Scale) -> bool:
    """Return whether the clock of the readings tells that reverse targets were read from the last to the first in every run."""
    reverse = [run.samples[scale.position][run.samples["direction"] == "reverse"] for run in runs]
    falls = all(places.size > 1 and float(np.median(np.diff(places))) < 0.0 for places in reverse)
    return falls and not clock_is_assumed(runs)


def _turned(test: LinearTest) -> Finding | None:
    """Return that the reverse readings fit the forward ones far better in the other order of the targets: they were written as they came."""
    if test.ways != BOTH or len(test.position_mm) < _FEWEST_TURNED:
        return None
    forward, reverse = test.forward_um.mean(axis=1), test.reverse_um.mean(axis=1)
    as_told, as_read = (float(np.std(forward - means)) for means in (reverse, reverse[::-1]))
    runs = test.forward_um.shape[1]
    scatter = np.concatenate([test.forward_um, test.reverse_um])
    noise = float(np.sqrt(2.0 * scatter.var(axis=1, ddof=1).mean() / runs)) if runs > 1 else 0.0
    if as_told < _TURNED * max(as_read, noise):
        return None
    said = (
        f"axis {test.axis}: forward and reverse means differ by {shown_number(as_told)} {test.scale.fine} RMS about the mean reversal, and by {shown_number(as_read)} {test.scale.fine} when the reverse "
        "readings are taken from the last target to the first: were they written in the order in which they were read? B, E and A would be wrong"
    )
    return Finding(f"{test.scale.kind}.turned", "warning", said, {"ratio_1": as_told / max(as_read, 1e-9)})


def _missed(run: Run, scale: Scale) -> Iterator[Finding]:
    position, direction = run.samples[scale.position], run.samples["direction"]
    wanted = _targets_of(position)
    ways = [way for way in ("forward", "reverse") if np.any(direction == way)]
    if len(ways) == 1:
        yield Finding(
            f"{scale.kind}.one_direction", "warning", f"the targets were approached {ways[0]} only: play cannot be seen"
        )
        return
    forward, reverse = (np.round(_targets_of(position[direction == way]), 6) for way in BOTH)
    if not np.intersect1d(forward, reverse).size:
        told = [", ".join(f"{t:z.6g}" for t in targets[:2]) for targets in (forward, reverse)]
        yield Finding(
            f"{scale.kind}.other_targets",
            "error",
            f"the directions share no target (forward {told[0]} … {scale.unit}, reverse {told[1]} … {scale.unit}): no reversal follows, nor any figure of both; "
            "measure the same targets from both sides; a file for each direction tells the figures of that one",
        )
        return
    absent: list[float] = []
    twice = 0
    for way in ways:
        at = position[direction == way]
        targets = _targets_of(at)
        absent += np.setdiff1d(np.round(wanted, 6), np.round(targets, 6)).tolist()
        twice += len(at) - len(targets)
    if absent:
        yield Finding(
            f"{scale.kind}.missed_targets",
            "error",
            f"{len(absent)} readings of {2 * len(wanted)} are missing, the first at "
            f"{absent[0]:z.3f} {scale.unit}: window too small, or the dwell too short",
            {"missed_1": float(len(absent)), f"first_{scale.position.partition('_')[2]}": float(absent[0])},
        )
    if twice:
        yield Finding(
            f"{scale.kind}.read_twice",
            "warning",
            f"{twice} targets were read more than once in one sweep",
            {"readings_1": float(twice)},
        )


def _aliased(wanted: Floats, pitch_mm: float) -> list[Finding]:
    if len(wanted) < 2:
        return []
    phases, step = phases_of(wanted, pitch_mm), float(np.median(np.diff(wanted)))
    if phases < FEWEST_PHASES:
        seen = "one angle" if phases == 1 else f"{phases} angles"
        said = (
            f"the step of {step:z.3f} mm meets the screw (pitch {pitch_mm:g} mm) at {seen} only: its "
            "cyclic error is folded into the slow error, and a table made of this does not see it"
        )
        return [Finding("linear.step_divides_pitch", "warning", said, {"step_mm": step, "phases_1": float(phases)})]
    line = np.arange(len(wanted)) * np.ptp(wanted) / (len(wanted) - 1)
    if float(np.ptp(wanted - line)) > _EQUAL * pitch_mm:
        return []
    step, span = float(line[1]), float(np.ptp(wanted))
    beat = beat_of(step, span, pitch_mm)
    if beat is None:
        return []
    wave, alias = beat
    what = "a turn of the screw" if wave == pitch_mm else "half a turn of the screw"
    turns = np.array([k + part for k in range(int(step / pitch_mm) + 1) for part in _GOLDEN])
    shorter = turns[turns * pitch_mm < step]
    better = round((float(shorter.max()) if shorter.size else _GOLDEN[0]) * pitch_mm, 1)
    said = (
        f"equal steps of {step:z.5g} mm show {what} ({wave:g} mm) as a wave of {alias:z.0f} mm, of a travel of {span:z.0f} mm: an error of the screw looks like an "
        f"error of the slope, and a table made of this compensates what is not there. Add a random part of up to a pitch to each target, as ISO 230-2 asks, or take "
        f"steps of {better:g} mm"
    )
    return [Finding("linear.step_beats_pitch", "warning", said, {"step_mm": step, "alias_mm": alias})]


def _drift(runs: Sequence[Run], scale: Scale) -> Iterator[Finding]:
    """Tell drift from noise by whether neighbouring readings of a run deviate alike.

    Deviations from the mean over the runs are put in the order of time; the mean square of their
    successive differences is twice their variance when each reading is on its own (von Neumann,
    Annals of Mathematical Statistics 12, 1941) and far less when they wander.
    """
    deviations = _run_deviations_um(runs, scale)
    n = len(deviations)
    if n < 2 or deviations.shape[1] < _FEWEST_FOR_DRIFT:
        return
    # The mean over the runs took a share of every run with it.
    share = n / (n - 1)
    variance = share * float(np.mean(deviations**2))
    noise = share * float(np.mean(np.diff(deviations, axis=1) ** 2)) / 2.0
    if variance <= 0.0:
        return
    expected_scatter = 4.0 / math.sqrt(deviations.size)
    if noise / variance > min(0.7, 1.0 - expected_scatter):
        return
    drift_um, noise_um = math.sqrt(max(variance - noise, 0.0)), math.sqrt(noise)
    why = (
        "A coupling or an encoder that slips irregularly, lost steps, or heat: mark the coupling, compare the axis's own encoder with the reference, log temperatures"
        if drift_um >= ORDINARY
        else "Ordinary air, heat and mounting of the instrument: let both settle, shield the beam"
    )
    yield Finding(
        f"{scale.kind}.drift",
        "warning",
        f"the runs disagree by drift, not by noise: {drift_um:z.2f} {scale.fine} RMS wander from run to "
        f"run, {noise_um:z.2f} {scale.fine} RMS from one reading to the next; R counts it as scatter, and more runs do not average "
        f"it away. {why}",
        {f"drift_{scale.figure}": drift_um, f"noise_{scale.figure}": noise_um},
    )


def _run_deviations_um(runs: Sequence[Run], scale: Scale) -> Floats:
    """Return deviations from the mean over the runs, shape (runs, readings), in order of time.

    ``runs``: those whose targets and directions are not the first one's are left out.
    """
    if not runs:
        return np.empty((0, 0))
    first = runs[0].samples
    alike = [
        run.samples[scale.error]
        for run in runs
        if np.array_equal(run.samples["direction"], first["direction"])
        and np.allclose(run.samples[scale.position], first[scale.position], atol=TARGET_MM)
    ]
    stacked = np.stack(alike)
    return stacked - stacked.mean(axis=0)


def _longest_constant(values: Floats) -> int:
    edges = np.concatenate([[-1], np.flatnonzero(np.diff(values) != 0), [len(values) - 1]])
    return int(np.max(np.diff(edges)))
