"""What is wrong with a circular test, said before anyone models it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dtwin.acquire.motion_quality import judge_motion
from dtwin.acquire.quality import judge_clock
from dtwin.kinds.circular._across_runs import across_findings
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.schema import Campaign, Finding, Floats, Run, SignalGroup
from dtwin.units import shown_number

# A ball bar measures about a millimetre each way; more is a wrong unit or a lost ball.
_SAME_RADIUS = 0.01
_OTHER_FEED = 0.25
"""Of the feed that is told, and of the rows."""
_MAX_DEVIATION_UM = 2_500.0
# A zero is off by so many times what readings differ by.
_MANY_TIMES = 2.0
# Share of squares that a straight line over the angle takes of no circle, over so much of it.
_STRAIGHT, _STRAIGHT_DEG = 0.9999, 90.0
_BALL_BAR_MM = (10.0, 5_000.0)
_STUCK_S = 0.1
# Of run-in and run-out beside the turn that is evaluated.
_LONG_DEG = 380.0
_TURN_DEG = 360.0
# Less tells no centre.
_FEWEST, _SHORTEST_DEG = 3, 30.0
# An angle that runs back by more is that of the other direction, too.
_BACK_DEG = 30.0
_STANDING = 8
_FED_TIMES = 3.0
"""Times the range of all other readings that a bar is fed in by at least."""
# What another version of a ball bar's program may compute otherwise, of circular deviation and centre.
_OTHERWISE, _OTHERWISE_UM = 0.2, 2.0
# More than this share of a recording lost is a link that does not keep up, not a hiccup.
_MOST_LOST = 0.05


def judge_circular_run(run: Run) -> list[Finding]:
    """Return the findings of one circle, with its samples and signals."""
    findings = [*judge_clock(run), *_reading(run), *_angles(run), *_radius(run)]
    told = any(finding.code == "recording.gap" for finding in run.findings)
    for group in run.signals:
        findings += _signals(group, gaps_told=told)
    if not any(finding.severity == "error" for finding in findings):
        findings += judge_motion(run)
        findings += _as_the_file_says(run)
    return findings


def with_whole_angle(run: Run, _campaign: Campaign) -> Run:
    """Return a run whose angle runs on where the file's begins anew after a turn."""
    steps = np.diff(run.samples.get("angle_deg", np.empty(0)))
    typical = float(np.median(np.abs(steps))) if steps.size else 0.0
    # No step of a circle is half a turn, however far apart its readings are.
    begins = np.abs(np.abs(steps) - _TURN_DEG) < min(max(20.0 * typical, 5.0), 0.5 * _TURN_DEG)
    if not begins.any():
        return run
    turns = np.concatenate([[0.0], np.cumsum(np.where(begins, -np.sign(steps), 0.0))])
    text = f"the angle of the file begins anew at {np.count_nonzero(begins)} places: it was made to run on"
    samples = dict(run.samples) | {"angle_deg": run.samples["angle_deg"] + _TURN_DEG * turns}
    return replace(run, samples=samples, findings=(*run.findings, Finding("angle.unwrapped", "info", text)))


def judge_circular_campaign(runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield what circles lack as a whole, directions and repeats, and what their samples say together where they are there."""
    yield from across_findings(runs)
    conditions = Counter((m.plane, m.radius_mm, m.feed_mm_min, m.direction) for m in (run.meta for run in runs))
    pairs = Counter(key[:3] for key in conditions)
    lonely = sum(count == 1 for count in pairs.values())
    if lonely:
        yield Finding(
            "campaign.one_direction",
            "warning",
            f"{lonely} of {len(pairs)} conditions were run in one direction only",
            {"conditions_1": float(lonely)},
        )
    single = sum(count == 1 for count in conditions.values())
    if single:
        yield Finding(
            "campaign.no_repeat",
            "warning",
            f"{single} of {len(conditions)} conditions have no repeat: their noise floor is unknown",
            {"conditions_1": float(single)},
        )


def _radius(run: Run) -> list[Finding]:
    radius, (low, high) = run.meta.radius_mm, _BALL_BAR_MM
    feed, feeds = run.meta.feed_mm_min, run.samples.get("feed_mm_min")
    if feed is not None and feeds is not None and np.mean(np.abs(feeds - feed) > _OTHER_FEED * feed) > _OTHER_FEED:
        said = f"the file has a column of feeds from {feeds.min():z.6g} to {feeds.max():z.6g} mm/min, and {feed:g} mm/min is told: rows are of another test"
        return [Finding("feed.told", "error", said, {"read_mm_min": float(np.median(feeds)), "told_mm_min": feed})]
    if radius is not None and "radius_mm" in run.samples:
        read = float(np.median(run.samples["radius_mm"]))
        if abs(read - radius) > _SAME_RADIUS * radius:
            said = f"the file has a column of radii about {read:z.6g} mm, and a radius of {radius:g} mm is told: one of them is of another test"
            return [Finding("radius.told", "error", said, {"read_mm": read, "told_mm": radius})]
    if radius is None or low <= radius <= high:
        return []
    return [
        Finding(
            "radius.implausible",
            "error",
            f"a radius of {radius:g} mm is none of a ball bar ({low:g} to {high:g} mm): another unit?",
            {"radius_mm": radius},
        )
    ]


def _reading(run: Run) -> Iterator[Finding]:
    deviation = run.samples["deviation_um"]
    largest = float(np.max(np.abs(deviation)))
    if largest > _MAX_DEVIATION_UM:
        yield Finding(
            "reading.out_of_range",
            "error",
            f"a deviation of {largest:z.0f} µm is beyond any ball bar: wrong unit, or the ball was lost",
            {"largest_um": largest},
        )
    shift, spread = float(np.mean(deviation)), float(np.ptp(deviation))
    if spread > 0.0 and abs(shift) > _MANY_TIMES * spread:
        said = (
            f"all deviations are off by {shift:+z.1f} µm, alike to within {shown_number(spread)} µm: a datum, such as an instrument whose length is not "
            "calibrated, or a radius other than the one stated; G does not count it, Fmax, Fmin and D do"
        )
        yield Finding("reading.datum", "warning", said, {"shift_um": shift, "spread_um": spread})
    angle = run.samples["angle_deg"]
    if spread > 0.0 and np.ptp(angle) > _STRAIGHT_DEG and np.corrcoef(angle, deviation)[0, 1] ** 2 > _STRAIGHT:
        said = f"deviations rise or fall evenly with the angle, by {shown_number(spread, 4)} µm: a column of angles or times, and no error of a circle"
        yield Finding("reading.ramp", "error", said, {"spread_um": spread})
    rate = run.meta.sample_rate_hz
    limit = max(8, int(_STUCK_S * rate)) if np.isfinite(rate) else 20
    length, value = _longest_constant(deviation)
    if length >= limit:
        extreme = bool(value in (deviation.max(), deviation.min())) and np.ptp(deviation) > 0
        code, what = ("reading.clipped", "the travel limit") if extreme else ("reading.stuck", "a stuck sensor")
        yield Finding(
            code,
            "error",
            f"{length} equal readings in a row at {value:z.1f} µm look like {what}",
            {"samples_1": float(length), "value_um": float(value)},
        )


def _angles(run: Run) -> list[Finding]:
    angle_deg = run.samples["angle_deg"]
    marked_deg = angle_deg[run.marked]
    turned_deg = float(np.ptp(marked_deg)) if marked_deg.size else 0.0
    if marked_deg.size < _FEWEST or turned_deg < _SHORTEST_DEG:
        text = f"{marked_deg.size} samples over {turned_deg:z.1f} deg: no circle can be fitted to less than {_FEWEST} samples and {_SHORTEST_DEG:g} deg"
        return [Finding("angle.short", "error", text, {"arc_deg": turned_deg})]
    steps = np.diff(angle_deg)
    sign = 1.0 if run.meta.direction == "CCW" else -1.0
    findings = []
    if float(np.median(steps)) * sign < 0:
        findings.append(
            Finding("angle.direction", "error", f"the angle runs against the stated direction {run.meta.direction}")
        )
    arc_deg = float(np.ptp(angle_deg))
    if run.window is None and arc_deg > _LONG_DEG:
        text = f"the angle runs over {arc_deg:z.0f} deg, and all of it is evaluated: leave rows of run-in and run-out out of the table"
        findings.append(Finding("arc.long", "warning", text, {"arc_deg": arc_deg}))
    typical = float(np.median(np.abs(steps)))
    jumps = np.flatnonzero(np.abs(steps) > max(20.0 * typical, 5.0))
    if jumps.size:
        findings.append(
            Finding(
                "angle.jump",
                "error",
                f"the angle jumps by {steps[jumps[0]]:z.1f} deg at sample {jumps[0] + 1}",
                {"jump_deg": float(steps[jumps[0]]), "jumps_1": float(jumps.size)},
            )
        )
        return findings
    along = sign * angle_deg
    back_deg = float(np.max(np.maximum.accumulate(along) - along))
    if run.window is None and back_deg > _BACK_DEG and not any(f.code == "angle.direction" for f in findings):
        text = f"the angle turns and runs back by {back_deg:z.0f} deg: circles of both directions are mixed in this run; part the table where it turns, one file for each direction"
        findings.append(Finding("angle.both_ways", "error", text, {"back_deg": back_deg}))
    return [*findings, *_fed(run, typical)]


def _fed(run: Run, typical_deg: float) -> list[Finding]:
    """Tell the start or the end at one angle, where the bar was fed in or out, which is no part of the circle."""
    angle_deg, deviation_um = run.samples["angle_deg"], run.samples["deviation_um"]
    if run.window is not None:
        return []
    moves = np.flatnonzero(np.abs(np.diff(angle_deg)) > 0.5 * typical_deg)
    if not moves.size:
        return []
    first, last = int(moves[0]), int(moves[-1]) + 1
    usual_um = float(np.ptp(deviation_um[first + 1 : last])) if last > first + 1 else 0.0
    for rows, where in ((slice(0, first + 1), "first"), (slice(last, None), "last")):
        still = deviation_um[rows]
        if still.size >= _STANDING and usual_um > 0.0 and float(np.ptp(still)) > _FED_TIMES * usual_um:
            fed_um = float(np.ptp(still))
            text = f"the {where} {still.size} readings stand at {angle_deg[rows][0]:z.1f} deg while the deviation moves by {fed_um:z.0f} µm: the bar is fed in or out there; leave these rows out of the table, at both ends"
            return [Finding("angle.fed", "error", text, {"rows_1": float(still.size), "moved_um": fed_um})]
    return []


def _as_the_file_says(run: Run) -> list[Finding]:
    """Hold circular deviation and centre of a whole circle against those that the file itself states; its axes may be exchanged here."""
    told = run.meta.vendor
    angle_deg, deviation_um = run.arc
    whole = angle_deg.size > _FEWEST and float(np.ptp(angle_deg)) > _TURN_DEG - 2.0
    if not whole or run.meta.radius_mm is None or not {"circularity_um", "centre_a_um", "centre_b_um"} <= set(told):
        return []
    circle = fit_circle(angle_deg, deviation_um, run.meta.radius_mm)
    read_um = float(np.ptp(residual_um(angle_deg, deviation_um, run.meta.radius_mm, circle)))
    centre = circle.centre_a_um, circle.centre_b_um
    stated = told["centre_a_um"], told["centre_b_um"]
    apart_um = min(np.hypot(a - stated[0], b - stated[1]) for a, b in (centre, centre[::-1]))
    size_um = max(read_um, told["circularity_um"])
    if (
        max(abs(read_um - told["circularity_um"]), apart_um)
        <= _OTHERWISE * (size_um + np.hypot(*stated)) + _OTHERWISE_UM
    ):
        return []
    said = (
        f"the readings give a circular deviation of {read_um:z.1f} µm about a centre at {centre[0]:+z.1f} and {centre[1]:+z.1f} µm, the file itself states "
        f"{told['circularity_um']:z.1f} µm at {stated[0]:+z.1f} and {stated[1]:+z.1f} µm: they are of another unit, sign or run, or the file was changed"
    )
    return [Finding("vendor.differs", "warning", said, {"read_um": read_um, "stated_um": told["circularity_um"]})]


def _signals(group: SignalGroup, *, gaps_told: bool) -> Iterator[Finding]:
    """Judge signals; samples without any value are lost ones when the recorder told of gaps."""
    floats = {n: v for n, v in group.columns.items() if v.dtype.kind == "f"}
    lost = np.zeros(group.n_samples, dtype=bool)
    if gaps_told and floats:
        lost = np.logical_and.reduce([np.isnan(values) for values in floats.values()])
        if lost.mean() > _MOST_LOST:
            text = f"{lost.sum()} of {lost.size} samples of {group.name} are lost"
            yield Finding("signal.lost", "error", text, {"share_1": float(lost.mean())})
    for name, whole in floats.items():
        values = whole[~lost]
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            yield Finding(
                "signal.not_finite",
                "error",
                f"{bad} values of {group.name} {name} are not finite",
                {"values_1": float(bad)},
            )
        elif name.endswith("_g"):
            yield from _accelerometer(group.name, name, values)


def _accelerometer(group: str, name: str, values: Floats) -> Iterator[Finding]:
    if not values.size:
        return
    top = float(np.max(np.abs(values)))
    clipped = int(np.count_nonzero(np.abs(values) >= 0.999 * top))
    if top > 0 and clipped > 20 and clipped > 1e-4 * values.size:
        yield Finding(
            "signal.clipped",
            "warning",
            f"{clipped} values of {group} {name} sit at its extreme {shown_number(top)} g",
            {"values_1": float(clipped), "extreme_g": top},
        )
        return
    if float(np.ptp(values)) == 0.0:
        yield Finding("signal.dead", "error", f"{group} {name} does not move")


def _longest_constant(values: Floats) -> tuple[int, float]:
    change = np.flatnonzero(np.diff(values) != 0)
    edges = np.concatenate([[-1], change, [values.size - 1]])
    lengths = np.diff(edges)
    longest = int(np.argmax(lengths))
    return int(lengths[longest]), float(values[edges[longest + 1]])
