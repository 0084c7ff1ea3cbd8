"""What is wrong with a run of a turning axis, and what its surface or another body of the machine leaves in it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from dtwin.acquire.quality import judge_clock
from dtwin.kinds.rotation._at_rest import judge_at_rest
from dtwin.kinds.rotation._features import Feature
from dtwin.kinds.rotation._heads import AT_REST, OVER_SPEED
from dtwin.kinds.rotation._orders import order_of_a_turn, orders_of, pulses_a_turn, said_orders
from dtwin.kinds.rotation._runout import spoilt
from dtwin.kinds.rotation._turns import Turns, one_way, turns_of
from dtwin.schema import Finding, Floats, Run
from dtwin.statistics import usual_size
from dtwin.units import shown_number

_FEW_TURNS = 5
_STEADY = 0.05
_LARGE_UM = 20e3
_MUCH_UM = 1e3
"""More than a turning axis runs out, unless the target sits beside it."""
_SMALL_UM = 0.005
_CLIPPED = 0.02
_TURN = 360.0
_FEWEST_A_TURN = 16
_FINE_A_TURN = 60
_LATE = 0.02
_SPIKE = 12.0
_MANY = 6


def judge_rotation(run: Run) -> list[Finding]:
    """Return what is wrong with one run."""
    if run.meta.condition.get("form") == OVER_SPEED or "runout_um" in run.samples:
        return list(_judge_table(run))
    if run.meta.condition.get("form") == AT_REST:
        return judge_at_rest(run)
    findings = [f for f in judge_clock(run) if f.code != "clock.dropout"]
    if findings:
        return findings
    x, a = run.samples["displacement_um"], run.samples["angle_deg"]
    findings += _judge_probe(x)
    if any(f.code == "rotation.stuck" for f in findings):
        return findings
    stretch = one_way(a)
    turned = abs(float(a[stretch.stop - 1] - a[stretch.start])) / _TURN
    share = (stretch.stop - stretch.start) / max(len(a), 1)
    if share < 1.0 - _LATE:
        said = f"the axis turned back, or stood: {100 * share:z.0f} % of the readings are of the longest stretch in one direction, {turned:z.1f} turns, and only they are used"
        findings.append(Finding("rotation.turned_back", "warning", said, {"share_1": share, "turns_1": turned}))
    per_turn = (stretch.stop - stretch.start) / turned if turned else 0.0
    if turned < 1.0:
        said = f"the axis made {turned:z.2f} of a turn in one direction: no figure of a turning axis is known of less than one"
        return [*findings, Finding("rotation.no_turn", "error", said, {"turns_1": turned})]
    if per_turn < _FEWEST_A_TURN:
        said = f"{per_turn:z.1f} readings a turn: fewer than {_FEWEST_A_TURN}, so that neither form nor orders can be told; read faster, or turn slower"
        return [*findings, Finding("rotation.coarse", "error", said, {"readings_1": per_turn})]
    turns = turns_of(run)
    if turns is None:
        said = "no turn is whole: each has a gap of more than 6° or three steps"
        return [*findings, Finding("rotation.gaps", "error", said)]
    if per_turn < _FINE_A_TURN:
        said = f"{per_turn:z.0f} readings a turn: TIR and A miss what lies between them, no local feature is sought, and no order above {per_turn / 2:z.0f} is known"
        findings.append(Finding("rotation.sparse", "info", said, {"readings_1": per_turn}))
    findings += _judge_turns(turns, run)
    findings += _features(turns)
    lines = orders_of(turns)
    times = pulses_a_turn(lines, turns) if run.meta.condition.get("angle") == "pulses" else 1
    if times > 1:
        said = (
            f"most of what is read comes again after {times} pulses, not after one: the pulse comes {times} times a turn, most likely, "
            f"and all figures are of that part of a turn; keep one pulse of {times}"
        )
        findings.append(Finding("rotation.several_pulses", "error", said, {"pulses_1": float(times)}))
    elif run.meta.condition.get("angle") == "speed" and (order := order_of_a_turn(lines, turns)) != 1.0:
        rpm = order * 60.0 * turned / float(np.ptp(run.samples["t_s"][stretch]))
        said = (
            f"nearly all that is read comes at order {shown_number(order)} and its multiples, and next to nothing with the turn: the speed is "
            f"{shown_number(rpm, 4)} rpm, most likely, not the stated one, and no figure but TIR is right; state the true speed, or log the angle"
        )
        findings.append(Finding("rotation.other_speed", "error", said, {"order_1": order, "speed_rpm": rpm}))
    elif lines:
        said = said_orders(lines)
        numbers = {"order_1": [line.order for line in lines], "amplitude_um": [line.amplitude_um for line in lines]}
        findings.append(Finding("rotation.orders", "info", said, numbers))
    return findings


def _judge_table(run: Run) -> Iterator[Finding]:
    speed, runout = run.samples["speed_rpm"], run.samples["runout_um"]
    if float(runout.max()) > _MUCH_UM:
        yield _size(float(runout.max()), "the run-out is")
    for n in np.flatnonzero(spoilt(run)):
        said = f"{shown_number(runout[n])} µm at {speed[n]:g} rpm stands far off the other run-outs of that speed: dirt, a chip or a mistake; it is left out"
        yield Finding("rotation.spoilt", "warning", said, {"speed_rpm": float(speed[n]), "runout_um": float(runout[n])})
    if len(np.unique(speed)) == len(speed):
        said = (
            "no speed was measured twice (a row is a reading, a column a probe): what run-outs differ by from speed to speed cannot be "
            "compared with repeats"
        )
        yield Finding("rotation.no_repeats", "warning", said)
    if len(np.unique(speed)) < 2:
        yield Finding("rotation.one_speed", "info", "one speed: nothing is known of what changes with it")


def _size(um: float, what: str) -> Finding:
    unit = "millimetres under a head of micrometres, or a probe that sees nothing"
    if um > _MUCH_UM:
        unit = (
            "a wrong unit"
            if um > _LARGE_UM
            else "micrometres under a head of millimetres, or a target far off the axis"
        )
    shown = f"{shown_number(um / 1000.0)} mm" if um > _MUCH_UM else f"{shown_number(um, 2)} µm"
    severity: Literal["warning", "error"] = "warning" if _MUCH_UM < um <= _LARGE_UM else "error"
    return Finding("rotation.size", severity, f"{what} {shown}: {unit}?", {"range_um": um})


def _judge_probe(x: Floats) -> list[Finding]:
    wide = float(np.ptp(x))
    if wide == 0.0:
        return [
            Finding("rotation.stuck", "error", "all readings are equal: the probe sees nothing, or is not connected")
        ]
    if wide > _LARGE_UM or wide < _SMALL_UM:
        return [_size(wide, "the readings span")]
    much = [_size(wide, "the readings span")] if wide > _MUCH_UM else []
    # A form has few readings at its very end; a probe at the end of its range has many.
    ends = [int(np.count_nonzero(x == end)) for end in (x.min(), x.max())]
    digits = len(np.unique(x))
    if max(ends) > max(_CLIPPED * len(x), 20) and digits > 50:
        said = f"{max(ends)} readings of {len(x)} are equal, and the {'lowest' if ends[0] > ends[1] else 'highest'}: the probe was at the end of its range"
        return [*much, Finding("rotation.clipped", "error", said, {"readings_1": float(max(ends))})]
    return much


def _judge_turns(turns: Turns, run: Run) -> list[Finding]:
    findings = []
    if turns.n < turns.whole:
        said = f"{turns.whole - turns.n} of {turns.whole} turns have gaps, and are left out"
        findings.append(Finding("rotation.lost", "warning", said, {"turns_1": float(turns.whole - turns.n)}))
    if turns.n < _FEW_TURNS:
        said = f"{turns.n} whole turn{'s' if turns.n > 1 else ''}: what differs from turn to turn is hardly known, and with it every uncertainty; measure 20 or more"
        findings.append(Finding("rotation.few_turns", "warning", said, {"turns_1": float(turns.n)}))
    if turns.n > 2 and run.meta.condition.get("angle") != "speed":
        each = np.abs(np.diff(turns.t_s))
        if turns.n == turns.whole and np.ptp(each) > _STEADY * float(each.mean()):
            change = 100.0 * float(np.ptp(each) / each.mean())
            said = f"the speed changed by {change:z.0f} % during the run: figures are those of no one speed; measure each speed in a run of its own"
            findings.append(Finding("rotation.unsteady", "warning", said, {"change_pct": change}))
    return [*findings, *_spikes(turns)]


def _spikes(turns: Turns) -> Iterator[Finding]:
    """Name readings that stand far off in one turn alone."""
    if turns.n < 4:
        return
    off = turns.moved_um - np.median(turns.moved_um, axis=0)
    scale = max(usual_size(off), turns.step_um / 2.0)
    far = np.abs(off) > _SPIKE * scale
    alone = far & (far.sum(axis=0) == 1)
    rows = np.flatnonzero(alone.any(axis=1))
    if not rows.size or scale == 0.0 or alone.mean() > 0.01:
        return
    k, j = np.unravel_index(int(np.argmax(np.abs(np.where(alone, off, 0.0)))), off.shape)
    said = (
        f"readings stand out in one turn alone, by up to {shown_number(abs(off[k, j]))} µm (turn {k + 1}, {turns.angle_deg[j]:z.0f}°): dirt, a chip, or a "
        "disturbed signal; asynchronous error motion counts them"
    )
    yield Finding(
        "rotation.single", "warning", said, {"turns_1": float(rows.size), "largest_um": float(abs(off[k, j]))}
    )


def _features(turns: Turns) -> list[Finding]:
    if len(turns.features) <= _MANY:
        return [_feature(f) for f in turns.features]
    share = 100.0 * sum(len(f.bins) - 2 for f in turns.features) / turns.moved_um.shape[1]
    said = (
        f"an interrupted surface: readings stand out at {len(turns.features)} places, in {share:z.0f} % of the turn, in every turn: teeth, slots or "
        "segments, no error motion; TIR has them, the other figures are of the smooth rest"
    )
    numbers = {"places_1": float(len(turns.features)), "share_pct": share}
    return [Finding("rotation.interrupted", "warning", said, numbers)]


def _feature(feature: Feature) -> Finding:
    what = "dip" if feature.height_um < 0 else "bump"
    said = (
        f"a {what} of {shown_number(abs(feature.height_um))} µm, {feature.width_deg:z.0f}° wide, at {feature.angle_deg:z.0f}° in every turn: a groove, a hole or a "
        "seam of the surface, no error motion; TIR has it, the other figures do not"
    )
    numbers = {"angle_deg": feature.angle_deg, "height_um": feature.height_um, "width_deg": feature.width_deg}
    return Finding("rotation.feature", "info", said, numbers)
