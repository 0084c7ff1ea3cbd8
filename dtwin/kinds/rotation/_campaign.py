"""What runs of a turning axis tell together: findings over speed, and figures as JSON and as lines."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dtwin.documents import finite
from dtwin.kinds.rotation._laws import CONSTANT, RESONANCE, SPEED, SQUARE, TIME, Law
from dtwin.kinds.rotation._orders import Order
from dtwin.kinds.rotation._runout import run_outs, runout_sentences
from dtwin.kinds.rotation._speeds import OverSpeed, Point, next_speed, over_speed, points_of
from dtwin.progress import Progress, silent
from dtwin.report.text import decimals, table
from dtwin.schema import Finding, Floats, Run
from dtwin.units import shown_number

_LARGE = 4.0
_MATTERS = 0.05
_LINEAR = 1e-3
"""Part of what comes once per turn that probes and their mounting do not hold better: no change below it is named."""
_SAME_ORDER = 0.02
_APART = 0.2


def _over_speeds(runs: Sequence[Run]) -> list[OverSpeed]:
    """Return every probe of a campaign over its speeds."""
    return [over_speed(key, points) for key, points in points_of(runs).items()]


def judge_speeds(runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield what changes with speed or time, and what cannot be told."""
    whole = [run for run in runs if run.samples]
    for over in _over_speeds(whole):
        yield from _judge(over)
    for told in run_outs(whole):
        yield from (
            Finding(code, "warning" if severity == "warning" else "info", text)
            for code, severity, text in runout_sentences(told)
        )


def _judge(over: OverSpeed) -> Iterator[Finding]:
    if len(over.points) < 2:
        return
    if over.delay is not None:
        d = over.delay
        way = "behind" if d.ms > 0 else "ahead of"
        said = (
            f"{over.probe}: the form of the surface turns with the speed: the angle is {shown_number(abs(d.ms))} ± {shown_number(d.k2_ms, 1)} ms {way} the probe "
            f"(up to {d.largest_deg:z.1f}°), a delay of the recording; it is taken out before speeds are compared"
        )
        yield Finding("rotation.delay", "warning", said, {"delay_ms": d.ms, "k2_ms": d.k2_ms})
    if over.odd_wave:
        said = (
            f"{over.probe}: what comes {over.odd_wave} times per turn turns from speed to speed, and the rest of the form does not turn with it: a force of that order "
            "(poles of a motor, teeth, a coupling) through a structure that lags looks so; it is not taken for a delay of the angle"
        )
        yield Finding("rotation.odd_wave", "info", said, {"per_turn_1": float(over.odd_wave)})
    if (w := over.wave) is not None:
        said = (
            f"{over.probe}: what comes {w.times} times per turn is {shown_number(w.least_um)} µm at {shown_number(w.least_rpm, 4)} rpm and {shown_number(w.most_um)} µm at "
            f"{shown_number(w.most_rpm, 4)} rpm: no form of the target changes so; forces of that order (poles of a motor, rolling elements, teeth) on a structure "
            "do, and a probe that is too slow"
        )
        numbers = {"per_turn_1": float(w.times), "least_um": w.least_um, "most_um": w.most_um}
        yield Finding("rotation.wave_changes", "warning", said, numbers)
    yield from _judge_once(over)
    yield from _judge_mean(over)
    yield from _judge_orders(over)


def _few(over: OverSpeed, what: str, spread_um: float) -> list[Finding]:
    said = f"{over.probe}: {what}; what it follows cannot be told with these speeds: measure {_asked(over)} too"
    return [Finding("rotation.few_speeds", "info", said, {"spread_um": spread_um})]


def _matters(noise_um: float, size_um: float) -> float:
    """Return from which size on a change is told that no law explains; noise may not be known."""
    return max(_LARGE * noise_um if math.isfinite(noise_um) else 0.0, _MATTERS * size_um)


def _speeds(over: OverSpeed) -> Floats:
    return np.array([p.speed_rpm for p in over.points])


def _asked(over: OverSpeed, law: Law | None = None) -> str:
    if law is None or all(TIME not in name for name in law.rivals):
        return f"{next_speed(_speeds(over)):z.6g} rpm"
    last = max(over.points, key=lambda p: p.place)
    again = last.speed_rpm < 1.01 * float(_speeds(over).min())
    return "the same speeds in another order" if again else "the lowest speed again at the end"


def _judge_once(over: OverSpeed) -> list[Finding]:
    law = over.vector
    if not math.isfinite(over.spread_um):
        return []
    size = max(abs(p.figures.once) for p in over.points)
    unsure = 0.0 if over.delay is None else math.radians(over.delay.k2_ms * 6e-3 * float(_speeds(over).max()))
    if law is not None and law.change < max(_LINEAR, unsure) * size:
        law = replace(law, name=CONSTANT)
    changed = f"what comes once per turn changes by {shown_number(over.spread_um)} µm between speeds"
    if law is None:
        return _few(over, changed, over.spread_um) if over.spread_um > _LARGE * over.noise_um else []
    # Without a form a delay is not known, and turns the vector, too.
    delay = (
        ""
        if over.form_known
        else " No form of the surface shows whether the angle has a delay, which turns the vector, too."
    )
    if law.name == SQUARE and over.sense != "axial":
        least = (
            ""
            if law.speeds >= 6
            else f"; whether a resonance makes it grow faster cannot be told with {law.speeds} speeds"
        )
        where = "" if over.sense else ", where the probe is a radial one"
        if law.bent:
            least = (
                f"; it does not grow quite so: a resonance looks so, measure {next_speed(_speeds(over)):z.6g} rpm too"
            )
        said = f"{over.probe}: what comes once per turn moves by {shown_number(law.change)} µm with the square of the speed: unbalance{where}{least}.{delay}"
        return [Finding("rotation.unbalance", "warning", said, {"change_um": law.change, "p_value": law.p_value})]
    if law.name == RESONANCE:
        said = (
            f"{over.probe}: what comes once per turn moves by {shown_number(law.change)} µm as that of an unbalanced rotor with a critical speed near {shown_number(law.critical_rpm)} "
            f"rpm does: unbalance and a resonance.{delay}"
        )
        return [
            Finding("rotation.resonance", "warning", said, {"change_um": law.change, "critical_rpm": law.critical_rpm})
        ]
    if law.name == CONSTANT:
        if over.spread_um > _matters(over.noise_um, size):
            near = f"; a resonance looks so, measure {next_speed(_speeds(over)):z.6g} rpm too" if law.bent else ""
            said = f"{over.probe}: {changed}, more than turns of one run differ by, and in no way that predicts a speed held out: set-ups, few repeats{near}"
            return [Finding("rotation.once_unknown", "info", said, {"spread_um": over.spread_um})]
        said = f"{over.probe}: what comes once per turn is the same at all speeds within {shown_number(over.spread_um, 2)} µm: {_mounting(over.sense)}, no unbalance"
        return [Finding("rotation.once_constant", "info", said, {"spread_um": over.spread_um})]
    words = " or ".join(_WORDS[name] for name in law.rivals)
    said = f"{over.probe}: what comes once per turn moves by {shown_number(law.change)} µm with {words}; {_open(law)}{'' if law.name else f' measure {_asked(over, law)} too'}.{delay}"
    return [
        Finding(
            "rotation.once_ambiguous" if not law.name else "rotation.once_moves",
            "warning",
            said,
            {"change_um": law.change},
        )
    ]


_WORDS: Mapping[str, str] = {
    SPEED: "the speed",
    SQUARE: "the square of the speed",
    TIME: "the time (warming, or a target that moves)",
    RESONANCE: "a resonance",
    f"{SPEED}+{TIME}": "the speed and the time",
    f"{SQUARE}+{TIME}": "the square of the speed and the time",
}


def _open(law: Law) -> str:
    if not law.name:
        return "these cannot be told apart with these speeds;"
    return "a face that tilts or yields, by unbalance or by heat" if law.name == SQUARE else "no unbalance does so"


def _mounting(sense: str) -> str:
    if sense == "axial":
        return "a face that is not square to the axis, or the axial fundamental of the bearing"
    return "a target off the axis, or its form" if sense == "radial" else "how the target is mounted"


def _judge_mean(over: OverSpeed) -> list[Finding]:
    law = over.mean
    means = [p.figures.mean_um for p in over.points]
    spread, noise = max(means) - min(means), max(p.figures.mean_k2_um for p in over.points)
    if law is None or law.name == CONSTANT:
        size = max(p.figures.total.um for p in over.points)
        if not spread > _matters(noise, size):
            return []
        if law is None:
            return _few(over, f"the mean reading changes by {shown_number(spread)} µm", spread)
        said = (
            f"{over.probe}: the mean reading changes by {shown_number(spread)} µm between runs, by none of speed, its square and time alone: heat that lags behind "
            "the speed looks so, and a probe that was moved; a log of temperatures (kind drift) tells"
        )
        return [Finding("rotation.mean_unknown", "info", said, {"spread_um": spread})]
    both = "heat of the bearings and warming do so, and heat that lags behind the speed nearly so"
    code, cause = {
        f"{SPEED}+{TIME}": ("rotation.mean_both", both),
        f"{SQUARE}+{TIME}": ("rotation.mean_both", f"{both}; what grows with the square alone is centrifugal growth"),
        SQUARE: ("rotation.centrifugal", "forces that grow with the square of the speed do so: centrifugal growth"),
        TIME: ("rotation.drift", "drift: warming, or an instrument that settles"),
        SPEED: ("rotation.mean_speed", "heat of the bearings, or a film of oil or air"),
    }.get(
        law.name,
        ("rotation.mean_ambiguous", f"these cannot be told apart with these speeds; measure {_asked(over, law)} too"),
    )
    words = " or ".join(_WORDS[name] for name in law.rivals)
    said = f"{over.probe}: the mean reading moves by {shown_number(law.change)} µm with {words}: {cause}"
    return [Finding(code, "warning", said, {"change_um": law.change, "p_value": law.p_value})]


def _judge_orders(over: OverSpeed) -> Iterator[Finding]:
    """Say of lines that stand at several speeds whether they turn with the axis, or have a frequency of their own."""
    speeds = sorted(over.points, key=lambda p: p.speed_rpm)
    hertz_told: list[float] = []
    orders_told: list[Order] = []
    # A frequency may be a whole order at the highest speed, and no line there.
    for fast, line in ((p, line) for p in reversed(speeds) for line in p.orders):
        hertz = line.order * fast.speed_rpm / 60.0
        others = [p for p in speeds if p.speed_rpm < fast.speed_rpm / (1.0 + _APART)]
        same_hz = [abs(hertz - hz) < _SAME_ORDER * hz for hz in hertz_told]
        if not others or any(same_hz) or any(_near(line.order, o.order, line, o) for o in orders_told):
            continue
        by_order = [p for p in others if any(_near(o.order, line.order, o, line) for o in p.orders)]
        by_hertz = [p for p in others if any(_near(o.order * p.speed_rpm / 60.0, hertz, o, line) for o in p.orders)]
        if by_hertz and len(by_hertz) > len(by_order):
            hertz_told.append(hertz)
            # The slowest run resolves it best.
            slow = by_hertz[0]
            hertz = min((o.order * slow.speed_rpm / 60.0 for o in slow.orders), key=lambda at: abs(at - hertz))
            often = {shown_number(p.speed_rpm, 4): (60.0 * hertz / p.speed_rpm, p.turns.n) for p in speeds}
            whole = [rpm for rpm, (times, n) in often.items() if times > 0.5 and abs(times - round(times)) * n < 1.0]
            counted = (
                f"; at {', '.join(whole)} rpm it comes a whole number of times a turn, and counts as synchronous"
                if whole
                else ""
            )
            said = f"{over.probe}: {shown_number(hertz, 4)} Hz at {len(by_hertz) + 1} speeds: a frequency of its own, so that no bearing makes it: mains, a pump, a structure{counted}"
            yield Finding("rotation.frequency", "info", said, {"frequency_hz": hertz})
        elif by_order and len(by_order) > len(by_hertz):
            orders_told.append(line)
            said = f"{over.probe}: order {shown_number(line.order)} at {len(by_order) + 1} speeds: it follows the axis at no whole number: rolling elements, a cage, a belt"
            yield Finding("rotation.order", "info", said, {"order_1": line.order, "amplitude_um": line.amplitude_um})


def _near(one: float, other: float, a: Order, b: Order) -> bool:
    """Return whether two places are one, within what both are resolved to."""
    share = max(_SAME_ORDER * 0.5, (a.resolution / a.order + b.resolution / b.order) / 2.0)
    return abs(one - other) < min(share, 0.05) * max(one, other)


def run_figures(run: Run) -> dict[str, Any]:
    """Return the figures of a run of displacements, JSON-ready; nothing of one without a whole turn, or of a table of run-outs."""
    points = [point for of_probe in points_of([run]).values() for point in of_probe]
    return {"rotation": _figures(points[0])} if points else {}


def rotation_figures(runs: Sequence[Run], progress: Progress = silent) -> dict[str, Any]:
    """Return what probes follow over speed, JSON-ready."""
    return {
        "over_speed": [
            {
                "probe": s.probe,
                "speeds_rpm": [p.speed_rpm for p in s.points],
                "once_um": [[p.figures.once.real, p.figures.once.imag] for p in s.points],
                "delay_ms": None if s.delay is None else s.delay.ms,
                "vector": _law(s.vector),
                "mean": _law(s.mean),
            }
            for s in _over_speeds(runs)
            if len(s.points) > 1
        ],
        "run_out": [
            {
                "run": told.run_id,
                "probe": told.probe,
                "speeds": [
                    {"speed_rpm": g.speed_rpm, "mean_um": float(g.runout_um.mean()), "repeats": len(g.runout_um)}
                    for g in told.groups
                ],
                "repeat_um": finite(told.repeat_um),
                "law": _law(told.law),
            }
            for told in run_outs(runs)
        ],
    }


def _law(law: Law | None) -> dict[str, Any] | None:
    if law is None:
        return None
    return {
        "name": law.name,
        "rivals": list(law.rivals),
        "change_um": law.change,
        "held_out_um": dict(law.left),
        "p_value": law.p_value,
        "critical_rpm": finite(law.critical_rpm),
    }


def _figures(point: Point) -> dict[str, Any]:
    f = point.figures
    named = {
        "total_um": f.total,
        "once_um": f.once_amplitude,
        "synchronous_um": f.synchronous,
        "residual_um": f.residual,
        "asynchronous_um": f.asynchronous,
        "asynchronous_rms_um": f.asynchronous_rms,
    }
    out: dict[str, Any] = {
        "sense": point.sense,
        "speed_rpm": point.speed_rpm,
        "turns": f.turns,
        "mean_um": f.mean_um,
        "drift_um": point.turns.drift_um,
    }
    out |= {
        name: {"value": finite(v.um), "expanded": finite(v.expanded_um), "blocks": v.blocks}
        for name, v in named.items()
    }
    out["once_deg"] = math.degrees(math.atan2(f.once.imag, f.once.real)) if point.phased else None
    out["floor_um"] = finite(f.floor_um)
    out["features"] = [
        {"angle_deg": x.angle_deg, "width_deg": x.width_deg, "height_um": x.height_um} for x in point.turns.features
    ]
    out["orders"] = [{"order": o.order, "amplitude_um": o.amplitude_um, "p_value": o.p_value} for o in point.orders]
    return out


_HEAD = ("run", "rpm", "turns", "once at, °", "noise of S, µm", "asynchronous RMS, µm", "drift, µm")


def rotation_lines(result: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what stands beside the test sheet: figures of runs, and what is noticed.

    ``result``: of :func:`rotation_figures`. ``runs``: of the check, with their findings.
    """
    rows = []
    senses = set()
    for run in runs:
        if (f := run.get("rotation")) is None:
            continue
        senses.add(f["sense"])
        at = "-" if f["once_deg"] is None else f"{f['once_deg']:z.0f}"
        floor = "-" if f["floor_um"] is None else shown_number(f["floor_um"])
        drift = shown_number(f["drift_um"])
        rows.append(
            [run["run"], f"{f['speed_rpm']:z.5g}", str(f["turns"]), at, floor, _shown(f["asynchronous_rms_um"]), drift]
        )
    lines = table(_HEAD, rows).splitlines() if rows else []
    if rows:
        lines.append(
            "noise of S: the range that turns by turns would leave where nothing is synchronous. A grows with the number of turns, its RMS does not."
        )
        lines.append(
            "S holds the form of the target, too: only a reversal of target and probe, or a better target, tells them apart"
        )
    if "radial" in senses:
        lines.append("radial: e is where the target sits, no error motion; S is about the least-squares centre")
    if "axial" in senses:
        lines.append("axial: e (the face, or the axial fundamental) is part of S, R is without it")
    if "" in senses:
        lines.append(
            "probes whose names say neither radial nor axial are evaluated as radial ones: name them, radial_x_um, axial_um"
        )
    for told in result["run_out"]:
        repeats = (
            "nothing was repeated"
            if told["repeat_um"] is None
            else f"repeats scatter by {shown_number(told['repeat_um'], 2)} µm"
        )
        lines.append(f"{told['run']}: {len(told['speeds'])} speeds, {repeats}")
    return [*lines, *_noticed(runs)]


def _noticed(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the findings of runs, those of one code as one line with the first of them."""
    told: dict[tuple[str, str], list[str]] = {}
    for run in runs:
        for f in run["findings"]:
            told.setdefault((f["severity"], f["code"]), []).append(f"{run['run']}: {f['message']}")
    ranked = sorted(told.items(), key=lambda item: ("error", "warning", "info").index(item[0][0]))
    lines = [
        f"{severity}, {said[0]}" + (f" (and {len(said) - 1} more: {code})" if len(said) > 1 else "")
        for (severity, code), said in ranked
    ]
    return ["", *lines] if lines else []


def _shown(value: Mapping[str, Any]) -> str:
    if value["value"] is None:
        return "-"
    if value["expanded"] is None:
        return shown_number(value["value"])
    digits = decimals(value["expanded"])
    return f"{value['value']:z.{digits}f} ± {value['expanded']:z.{digits}f}"
