"""Files of a turning axis as runs: one run is one probe at one speed, or the run-outs of one probe over speed.

``[campaign.instrument.columns]`` names the house's column for a foreign head or channel: ``"CH3" = "radial_x_um"``; an empty one
leaves it out. A run's ``condition`` may state ``speed_rpm``, and ``angle_log``, a file of the same folder that holds the angle.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.acquire.campaign_folder import inside
from dtwin.errors import InputError
from dtwin.kinds.rotation._angles import angle_of_pulses, nominal_angle, smooth_angle, unwrapped
from dtwin.kinds.rotation._at_rest import is_at_rest
from dtwin.kinds.rotation._files import SUFFIXES, Channel, Reading, read_file
from dtwin.kinds.rotation._heads import ANGLE, AT_REST, OVER_SPEED, PULSE, SPEED, direction_of
from dtwin.schema import Campaign, Finding, Floats, Run, RunMeta
from dtwin.units import is_number, shown_number

_TOLD_OFF = 0.05
_UM_PER_MM = 1e3
_MOST_RPM = 1e6
_MOST_OF_TURN = 0.5
_FAR = 20.0
"""Times the range of nearly all readings that a reading without meaning lies off them at least."""
_FEW = 0.02
_FEW_TURNS = 0.3
_FEWEST_ROWS = 50
"""At one speed of several in a file."""


def _read_rotation(path: Path, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[list[Run], list[dict[str, Any]]]:
    """Return a run for each probe of a file, and the rows that hold no usable number.

    Raises ``InputError`` when there is no probe, and neither angle nor pulse nor speed.
    """
    recipe = campaign.instrument.get("columns", {})
    reading = read_file(path, recipe)
    if reading.by_speed:
        return _over_speed(reading, path), reading.rejects
    condition = stated.get("condition", {})
    by_hand = not reading.timed and set(reading.channels) == {ANGLE} and not {SPEED, "angle_log"} & set(condition)
    if by_hand and (at_rest := _at_rest(reading, path)):
        return at_rest, reading.rejects
    log = condition.get("angle_log")
    if log is not None:
        other = read_file(inside(path.parent, log, "condition.angle_log"), recipe, ANGLE)
        reading = _with_angle_of(reading, other)
    parts = _at_each_speed(reading, path)
    told = condition.get(SPEED)
    runs = [run for label, part in parts.items() for run in _labelled(_turning(part, told, path), label)]
    return runs, reading.rejects


def _at_each_speed(reading: Reading, path: Path) -> dict[str, Reading]:
    """Return the parts of a reading in which a column of speeds stands still, by the speed; the whole where it does throughout.

    Raises ``InputError`` when speeds change, neither in steps nor with a time that tells how fast the axis was.
    """
    speed = reading.channels.get(SPEED)
    if speed is None or reading.apart or not len(speed.value):
        return {"": reading}
    rpm = np.abs(speed.value)
    if np.ptp(rpm) <= _TOLD_OFF * np.median(rpm):
        return {"": reading}
    begins = [0, *(np.flatnonzero(np.abs(np.diff(rpm)) > _TOLD_OFF * rpm.max() / 4.0) + 1), len(rpm)]
    blocks = [slice(int(a), int(b)) for a, b in itertools.pairwise(begins)]
    steady = all(b.stop - b.start >= _FEWEST_ROWS and np.ptp(rpm[b]) <= _TOLD_OFF * rpm[b].mean() for b in blocks)
    if not steady and reading.timed:
        return {"": reading}
    if not steady:
        raise InputError(
            "the speed changes from row to row, and there is no time",
            code="rotation.speed",
            where=str(path),
            got=f"{shown_number(rpm.min(), 4)} to {shown_number(rpm.max(), 4)} rpm",
            allowed=f"one speed, or several of {_FEWEST_ROWS} rows each",
            hint="a column of time, such as t_s",
        )
    parts: dict[str, Reading] = {}
    for block in blocks:
        label = name = f"-{float(np.median(rpm[block])):.5g}rpm"
        again = 1
        while label in parts:
            again += 1
            label = f"{name}-{again}"
        first, last = speed.t_s[block.start], speed.t_s[block.stop - 1]
        inside_it = {
            kept: {
                name: Channel(c.t_s[(c.t_s >= first) & (c.t_s <= last)], c.value[(c.t_s >= first) & (c.t_s <= last)])
                for name, c in channels.items()
            }
            for kept, channels in (("channels", reading.channels), ("probes", reading.probes))
        }
        probes = {name: c for name, c in inside_it["probes"].items() if len(c.t_s) > 1}
        parts[label] = replace(reading, channels=inside_it["channels"], probes=probes, rejects=[])
    return parts


def _labelled(runs: list[Run], label: str) -> list[Run]:
    return [replace(run, meta=replace(run.meta, run_id=run.meta.run_id + label)) for run in runs]


def _over_speed(reading: Reading, path: Path) -> list[Run]:
    runs = []
    for name, probe in reading.probes.items():
        speed = reading.channels.get(SPEED)
        if speed is None:
            raise InputError(
                "a table of run-out does not say its speeds",
                code="columns.missing",
                where=str(path),
                got=name,
                allowed="a column of speed in rpm, 1/min or Hz; or time and angle",
            )
        at = np.isin(speed.t_s, probe.t_s)
        rpm = speed.value[at]
        wrong = (rpm < 0.0) | (rpm > _MOST_RPM) | (probe.value < 0.0)
        if wrong.any():
            n = int(np.flatnonzero(wrong)[0])
            raise InputError(
                "a run-out and a speed are not negative",
                code="rotation.negative",
                where=f"{path} row {int(probe.t_s[n]) + 1}",
                got=f"{rpm[n]:g} rpm, {probe.value[n] / _UM_PER_MM:g} mm",
                allowed=f"speeds from 0 to {_MOST_RPM:g} rpm, run-outs from 0 on",
            )
        samples = {"t_s": probe.t_s, SPEED: rpm, "runout_um": probe.value}
        condition = {"probe": name, "sense": direction_of(name), "form": OVER_SPEED}
        order = () if reading.timed else (_no_clock("its rows are taken to have been measured in their order"),)
        said = (*reading.assumed, *order)
        meta = RunMeta(run_id=_safe(name), kind="rotation", condition=condition, started=reading.started)
        runs.append(Run(meta, samples, source=str(path), findings=said))
    return runs


def _at_rest(reading: Reading, path: Path) -> list[Run]:
    """Return the runs of an axis that was turned by hand; none where the angles are those of one that turned."""
    runs = []
    angle = reading.channels[ANGLE]
    for name, probe in reading.probes.items():
        at = angle.value[np.isin(angle.t_s, probe.t_s)]
        if is_at_rest(at):
            samples = {"t_s": probe.t_s, ANGLE: at, "displacement_um": probe.value}
            condition = {"probe": name, "sense": direction_of(name), "form": AT_REST}
            meta = RunMeta(_safe(name), "rotation", condition=condition)
            runs.append(Run(meta, samples, source=str(path), findings=reading.assumed))
    return runs


def _no_clock(assumed: str) -> Finding:
    return Finding("clock.assumed", "info", f"the table has no clock: {assumed}")


def _timed(reading: Reading, angle: Channel, rpm: float) -> tuple[Reading, Channel]:
    """Return a reading without time, and its angle, with the times at which an axis of constant speed has these angles."""
    t_s = np.maximum.accumulate(np.abs(angle.value - angle.value[0])) / (6.0 * rpm)
    probes = {n: Channel(np.interp(p.t_s, angle.t_s, t_s), p.value) for n, p in reading.probes.items()}
    return replace(reading, probes=probes), Channel(t_s, angle.value)


def _with_angle_of(reading: Reading, other: Reading) -> Reading:
    """Return a reading with the channels of another file, whose stamps are of the same clock."""
    if not reading.started or not other.started:
        return replace(reading, channels={**other.channels, **reading.channels})
    later = (datetime.fromisoformat(other.started) - datetime.fromisoformat(reading.started)).total_seconds()
    moved = {role: Channel(c.t_s + later, c.value) for role, c in other.channels.items()}
    return replace(reading, channels={**moved, **reading.channels}, apart=True)


def _turning(reading: Reading, told: object, path: Path) -> list[Run]:
    if told is not None and (not is_number(told) or not 0.0 < float(told) < _MOST_RPM):
        raise InputError(
            "the speed of a run is not usable",
            code="rotation.speed",
            where=str(path),
            got=str(told)[:40],
            allowed=f"condition.speed_rpm above 0 and below {_MOST_RPM:g}",
        )
    angle, origin, findings = _angle(reading, path)
    findings += reading.assumed
    if angle is not None and not reading.timed:
        reading, angle = _timed(reading, angle, _speed(reading, told, path))
        findings.append(_no_clock("times are the angle over the speed that is told"))
    runs = []
    for name, probe in reading.probes.items():
        t, x, said = probe.t_s, probe.value, list(findings)
        if angle is None:
            speed = _speed(reading, told, path)
            _require_turn_seen(t, speed, path)
            a, taken_rpm = nominal_angle(t, speed, x)
            said.append(_no_angle(speed, taken_rpm))
        else:
            inside_it = (t >= angle.t_s[0]) & (t <= angle.t_s[-1])
            if inside_it.sum() < 2:
                raise InputError(
                    "probe and angle were not read at the same time", code="rotation.apart", where=str(path), got=name
                )
            t, x = t[inside_it], x[inside_it]
            a = np.interp(t, angle.t_s, angle.value)
        far = _far(a, x)
        if far.any():
            off = float(np.abs(x[far] - np.median(x)).max())
            text = f"{int(far.sum())} reading{'s lie' if far.sum() > 1 else ' lies'} up to {shown_number(off)} µm off the others, in few turns: a code for no reading, or a fault of the signal; they are left out"
            said.append(Finding("rotation.far", "warning", text, {"readings_1": float(far.sum()), "largest_um": off}))
            t, x, a = t[~far], x[~far], a[~far]
        rpm = abs(a[-1] - a[0]) / 6.0 / max(float(t[-1] - t[0]), 1e-12)
        if told is not None and abs(rpm - float(told)) > _TOLD_OFF * float(told):
            text = f"{told:g} rpm are stated, the axis turned at {shown_number(rpm, 4)} rpm"
            said.append(Finding("rotation.speed_told", "warning", text, {"told_rpm": float(told), "read_rpm": rpm}))
        condition: dict[str, Any] = {"probe": name, "sense": direction_of(name), "angle": origin}
        condition |= {SPEED: float(f"{rpm:.5g}")} if told is None else {}
        samples: dict[str, Floats] = {"t_s": t - t[0], ANGLE: a, "displacement_um": x}
        meta = RunMeta(_safe(name), "rotation", condition=condition, started=reading.started)
        rate = 1.0 / float(np.median(np.diff(t))) if len(t) > 1 and np.median(np.diff(t)) > 0.0 else float("nan")
        runs.append(Run(replace(meta, sample_rate_hz=rate), samples, source=str(path), findings=tuple(said)))
    return runs


def _far(angle_deg: Floats, x: Floats) -> NDArray[np.bool_]:
    """Return which readings lie so far off all others that no surface is there: a groove is in every turn, and these are in few."""
    low, middle, high = np.quantile(x, (0.05, 0.5, 0.95))
    far = np.asarray(np.abs(x - middle) > _FAR * (high - low))
    turn = np.floor(angle_deg / 360.0)
    few = len(np.unique(turn[far])) <= max(1.0, _FEW_TURNS * float(np.ptp(turn))) and far.mean() < _FEW
    return far if high > low and few and np.ptp(turn) > 1.0 else np.zeros_like(far)


def _angle(reading: Reading, path: Path) -> tuple[Channel | None, str, list[Finding]]:
    """Return the angle of a reading, what it is from, and what is noticed; no angle where there is but a speed."""
    angle, pulse = reading.channels.get(ANGLE), reading.channels.get(PULSE)
    if angle is not None and len(angle.t_s) > 1:
        if reading.apart:
            smooth, said = smooth_angle(angle, str(path))
            return smooth, "log", said
        return Channel(angle.t_s, unwrapped(angle.t_s, angle.value, str(path))), "encoder", []
    if pulse is not None and len(pulse.t_s) > 1:
        return angle_of_pulses(pulse, str(path)), "pulses", []
    return None, "speed", []


def _speed(reading: Reading, told: object, path: Path) -> float:
    read = reading.channels.get(SPEED)
    speed = float(np.median(np.abs(read.value))) if read is not None and len(read.value) else told
    if is_number(speed) and 0.0 < speed < _MOST_RPM:
        return float(speed)
    raise InputError(
        "a speed is not told, and there is no time, or neither angle nor pulses",
        code="rotation.angle",
        where=str(path),
        allowed="a column speed [rpm], or condition = { speed_rpm = 1200 } in the run; or time, and angle [deg] or pulse",
    )


def _require_turn_seen(t_s: Floats, rpm: float, path: Path) -> None:
    """Refuse readings that are farther apart than the axis takes for half a turn: where it stood at each, its speed does not tell."""
    step_s = float(np.median(np.diff(t_s))) if t_s.size > 1 else 0.0
    if step_s * rpm / 60.0 > _MOST_OF_TURN:
        raise InputError(
            "no angle was read, and the axis turns too far from one reading to the next to compute it",
            code="rotation.seldom",
            where=str(path),
            got=f"a reading every {shown_number(step_s)} s at {shown_number(rpm, 4)} rpm: {shown_number(step_s * rpm / 60.0)} turns",
            allowed=f"up to {_MOST_OF_TURN:g} of a turn, or a column of angles",
            hint="a log that drifts with temperatures: --kind drift",
        )


def _no_angle(told: float, taken_rpm: float) -> Finding:
    said = (
        f"no angle was read: it is computed from {told:g} rpm, taken as {taken_rpm:z.5g} rpm, at which the most repeats from turn to turn; angles mean "
        "nothing beyond this run, and what the speed varies by counts as asynchronous"
    )
    return Finding("rotation.nominal", "warning", said, {"told_rpm": told, "found_rpm": taken_rpm})


def _safe(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_+-]+", "-", name).strip("-_+")[:60] or "probe"


READERS = dict.fromkeys(SUFFIXES, _read_rotation)
