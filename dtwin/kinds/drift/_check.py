"""What is wrong with logs of drift, and what their displacement follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dtwin.documents import finite
from dtwin.kinds.drift._diagnosis import beside_noise
from dtwin.kinds.drift._model import Fitted, Series, Term, steady
from dtwin.kinds.drift._search import Step, missing
from dtwin.kinds.drift._series import series_of, shifts, slips
from dtwin.kinds.drift._standing import probe_standing
from dtwin.progress import Progress, silent
from dtwin.report.text import decimals, table
from dtwin.schema import Finding, Run
from dtwin.statistics import f_tail
from dtwin.units import shown_number

_FEWEST = 100
_MOST_SENSORS = 48
"""Beyond them the search takes hours."""
_LARGE_UM = 3000.0
"""More than heat moves a machine."""
_JUMP_UM = 200.0
_JUMPS = 50.0
_OF_SPAN = 0.25
_NOISY = 0.1
_CHANCE = 1e-3
_PAUSE_S, _TIMES_PAUSE, _USUAL_PCT, _LISTED = 300.0, 10.0, 90.0, 4
_HOUR_S = 3600.0
_MOST_APART = 2.0
"""How far two runs of one machine may differ before a step size that is stated for one of them is doubted."""
_UNITS = {
    10.0: "10, a shifted decimal place",
    25.4: "25.4, as between inch and mm",
    1000.0: "1000, as between mm and µm",
}
_STANDS = "a sensor stands, see the warning: what is missing is not told of this log before the sensor is left out, or the log ended there"
_NEAR = 0.06
"""Share by which a factor may miss that of a unit."""


def _slipped(series: Series) -> list[Finding]:
    """Return the sensors that stepped alone between two readings and stayed: what heats a machine steps no sensor so, or several."""
    findings = []
    for channel, steps in slips(series).items():
        for step in steps:
            said = (
                f"{Term('steady', channel).name} steps by {step.size:z.1f} °C between two readings after {step.at_s / 60.0:z.0f} min and stays, "
                "and no other sensor does: it slipped or was touched, or what it sits on was flooded; fits are made without the step, and what "
                "follows from it is suspect"
            )
            findings.append(Finding("drift.sensor_steps", "warning", said, {"step_k": step.size}))
    return findings


def judge_drift(run: Run) -> list[Finding]:
    """Return what is wrong with one log."""
    series = series_of(run, as_read=True)
    if len(series.t_s) < _FEWEST:
        said = f"{len(series.t_s)} readings: a fit to temperatures needs at least {_FEWEST}"
        return [Finding("drift.few", "error", said, {"readings_1": float(len(series.t_s))})]
    if not np.ptp(series.moved_um) > 0.0:
        said = "the displacement never changes: is the probe stuck, or out of its range?"
        return [Finding("drift.stuck", "error", said)]
    findings = []
    if len(series.temperatures_c) > _MOST_SENSORS:
        said = (
            f"{len(series.temperatures_c)} temperatures: what the displacement follows is looked for among up to {_MOST_SENSORS}; leave out those that are far from "
            'the structure, or read the same ("HEAD" = "" in [campaign.instrument.columns])'
        )
        findings.append(Finding("drift.many", "error", said, {"sensors_1": float(len(series.temperatures_c))}))
    steps = np.abs(np.diff(series.moved_um))
    usual = max(float(np.median(steps)), 1.0)
    span = float(np.subtract(*np.percentile(series.moved_um, [98.0, 2.0])))
    if span > _LARGE_UM:
        said = f"the displacement moves by {span / 1000.0:z.1f} mm, more than heat moves a machine: micrometres under a head of millimetres, or a position?"
        findings.append(Finding("drift.size", "warning", said, {"span_um": span}))
    jumps = np.flatnonzero(steps > max(_JUMP_UM, _JUMPS * usual, _OF_SPAN * span))
    if jumps.size:
        said = (
            f"{jumps.size} jump{'s' if jumps.size > 1 else ''} between neighbouring readings, the largest {steps.max():z.0f} µm after {series.t_s[jumps[0]] / 60:z.0f} min: "
            "lost reference, or a probing that went wrong; nothing is to be fitted to this run"
        )
        findings.append(Finding("drift.jump", "error", said, {"largest_um": float(steps.max())}))
    elif touched := shifts(series):
        listed = ", ".join(f"{one.size:z.1f} µm after {one.at_s / 60.0:z.0f} min" for one in touched[:_LISTED])
        said = (
            f"the displacement stepped between two readings and stayed: {listed}; heat does not do that, a touched probe or a spindle that starts does: "
            "fits are made without these steps, the test sheet is of the readings as they are"
        )
        findings.append(Finding("drift.touched", "warning", said, {"steps_1": float(len(touched))}))
    pauses = np.diff(series.t_s)
    # Most pauses may be those within samples that are read several times.
    usual_s = float(np.percentile(pauses[pauses > 0.0], _USUAL_PCT)) if pauses.any() else 0.0
    long = np.flatnonzero(pauses > max(_PAUSE_S, _TIMES_PAUSE * usual_s))
    if long.size:
        first = series.t_s[long[0]] / 60.0
        said = (
            f"no readings for up to {pauses.max() / 60.0:z.0f} min, {long.size} time{'s' if long.size > 1 else ''}, first after {first:z.0f} min: "
            "temperatures are taken to have moved evenly meanwhile, and what is late is less sure"
        )
        others_s = np.delete(pauses, long).max(initial=0.0)
        if long.size == 1 and 0.0 < float(pauses[long[0]]) - _HOUR_S <= 1.5 * others_s:
            said += (
                "; it is an hour and a usual pause: a clock that was set forward, by summer time or by hand, looks so"
            )
        findings.append(Finding("drift.gap", "warning", said, {"longest_s": float(pauses.max())}))
    findings += _slipped(series)
    # What a correction leaves may be little more than noise.
    if not run.meta.correction and _still(series):
        said = f"what moved is no more than readings of one sample scatter, {series.floor_um:z.1f} µm: there is nothing to tell"
        findings.append(Finding("drift.still", "info", said, {"scatter_um": series.floor_um}))
    elif not run.meta.correction and series.floor_um > _NOISY * float(np.ptp(series.moved_um)):
        said = f"readings of one sample scatter by {series.floor_um:z.1f} µm, a tenth of all that moved or more: the probing does not repeat"
        findings.append(Finding("drift.noise", "error", said, {"scatter_um": series.floor_um}))
    read = [values for name, values in run.samples.items() if name.startswith("temperature_")]
    findings += probe_standing(run.samples["displacement_um"], read)
    if not np.isfinite(series.floor_um):
        findings.append(Finding("drift.no_repeat", "warning", "no sample was read twice: no noise floor is known"))
    return findings


def _still(series: Series) -> bool:
    """Return whether stretches of time differ by no more than their readings scatter, at 99.9 %."""
    if not np.isfinite(series.floor_um) or not series.floor_um > 0.0:
        return False
    count = np.bincount(series.block)
    means = np.bincount(series.block, series.moved_um) / count
    between = float((count * (means - series.moved_um.mean()) ** 2).sum()) / (len(count) - 1)
    return f_tail(between / series.floor_um**2, (len(count) - 1.0, len(series.t_s) / 2.0)) > _CHANCE


def judge_campaign_drift(runs: Sequence[Run]) -> list[Finding]:
    """Return what logs of one machine say together: whether one is in another unit, or of another step, than is told."""
    runs = [run for run in runs if run.samples]
    stepped = {run.meta.run_id for run in runs if "step_mm" in run.meta.condition}
    findings = []
    for name, (ratio, others) in contradicting(runs).items() if len(runs) > 1 else ():
        which = f"that of {others[0]}" if len(others) == 1 else f"those of {', '.join(others)}"
        unit = _unit(ratio)
        why = f"a factor of {_UNITS[unit]}" if unit else "one of the logs was measured in other steps than are stated"
        if unit and stepped & {name, *others}:
            why += ", or one of the logs was measured in other steps than are stated"
        said = (
            f"{name} moves {shown_number(ratio)} times as far as models of the same machine predict from its temperatures "
            f"({which}): {why}; it is left out of fits with the others"
        )
        findings.append(Finding("drift.scale", "warning", said, {"ratio_1": ratio}))
    return findings


def contradicting(runs: Sequence[Run]) -> dict[str, tuple[float, list[str]]]:
    """Return runs that move as in another unit than models of others of the same axis predict, by how many times, and of which.

    Probes at two places differ by any factor where a spindle tilts, and have other signs: no more than a unit, or a step
    that is stated for the run, is doubted.
    """
    sound = [r for r in runs if not r.meta.correction and not any(f.severity == "error" for f in judge_drift(r))]
    known = {r.meta.run_id: series_of(r) for r in sound}
    models = {name: steady(series) for name, series in known.items()}
    told = [name for name in known if models[name].terms]
    axis = {r.meta.run_id: r.meta.condition.get("axis") for r in sound}
    stepped = {r.meta.run_id for r in sound if "step_mm" in r.meta.condition}
    contradictions = {}
    for n, name in enumerate(told):
        alike = [other for other in told if axis[other] == axis[name]]
        others = [other for other in alike if other != name and (len(alike) > 2 or told.index(other) < n)]
        times = [_times(models[other], known[name]) for other in others]
        times = [t for t in times if np.isfinite(t)]
        if not times or not (ratio := float(np.median(times))) > 0.0:
            continue
        other_step = bool(stepped & {name, *others}) and not 1.0 / _MOST_APART < ratio < _MOST_APART
        if other_step or _unit(ratio):
            contradictions[name] = (ratio, others)
    return contradictions


def _unit(ratio: float) -> float:
    """Return the factor between units that a ratio is, either way, or 0."""
    off = abs(float(np.log(ratio)))
    return next((unit for unit in _UNITS if abs(off - np.log(unit)) < np.log1p(_NEAR)), 0.0)


def drift_figures(runs: Sequence[Run], progress: Progress = silent) -> dict[str, Any]:
    """Return what each log follows, JSON-ready: steady temperatures first, then what that lacks."""
    return {run.meta.run_id: _figures(run, progress) for run in runs}


def drift_lines(result: Mapping[str, Any]) -> list[str]:
    """Return what :func:`drift_figures` gave as lines."""
    lines: list[str] = []
    for run, figures in result.items():
        if figures is None:
            lines.append(f"{run}: not fitted, see the findings")
            continue
        floor = "not known" if figures["floor_um"] is None else f"{figures['floor_um']:z.2f} µm"
        lines += ["", f"{run}: {figures['readings']} readings over {figures['hours']:z.1f} h, noise floor {floor}"]
        rows = [_row("temperatures at once", figures["steady"])]
        rows += [_row(f"and {step['said']}", step["model"]) for step in figures["missing"]]
        lines += table(("model", "left, µm", "held out, µm", "R²", "µm/K, ± 95 %"), rows).splitlines()
        lines.append(figures["verdict"])
    return lines


def _row(name: str, model: Mapping[str, Any]) -> list[str]:
    told = "; ".join(f"{term['written']} {term['shown']}" for term in model["terms"])
    return [name, f"{model['left_um']:z.2f}", f"{model['held_out_um']:z.2f}", f"{model['r2']:z.4f}", told]


def _figures(run: Run, progress: Progress) -> dict[str, Any] | None:
    if any(f.severity == "error" for f in [*run.findings, *judge_drift(run)]):
        return None
    series = series_of(run)
    if not series.temperatures_c:
        return None
    base = steady(series)
    stands = any(f.code == "drift.sensor_stands" for f in run.findings)
    steps = [] if stands else missing(series, base, progress)
    last = steps[-1].fitted if steps else base
    return {
        "readings": len(series.t_s),
        "hours": float(series.t_s[-1]) / 3600.0,
        "floor_um": finite(series.floor_um),
        "steady": _model(base),
        "missing": [_step(step) for step in steps],
        "verdict": _STANDS if stands else _verdict(series, last, steps),
    }


def _verdict(series: Series, last: Fitted, steps: Sequence[Step]) -> str:
    named = f"missing: {'; '.join(step.said for step in steps)}. " if steps else ""
    verdict, said = beside_noise(series, last.held_out_um)
    return f"{named}{verdict}: {said}"


def _model(model: Fitted) -> dict[str, Any]:
    return {
        "terms": [
            {
                "label": term.label,
                "um_per_k": float(value),
                "expanded": float(half),
                "late_expanded_s": float(late_k2_s) or None,
                "written": _late(term, float(late_k2_s)),
                "shown": f"{value:z.{decimals(float(half))}f} ± {half:z.{decimals(float(half))}f}",
            }
            for term, value, half, late_k2_s in zip(
                model.terms, model.value[1:], model.k2[1:], model.late_k2_s, strict=True
            )
        ],
        "intercept_um": float(model.value[0]),
        "left_um": model.left_um,
        "held_out_um": model.held_out_um,
        "r2": model.r2,
    }


def _late(term: Term, k2_s: float) -> str:
    """Return a term with the uncertainty of its time constant."""
    half = k2_s / 60.0
    if not term.tau_s or not half > 0.0:
        return term.label
    digits = decimals(half)
    label = term.label.removesuffix(f"{shown_number(term.tau_s / 60.0)} min")
    return f"{label}{term.tau_s / 60.0:z.{digits}f} ± {half:z.{digits}f} min"


def _step(step: Step) -> dict[str, Any]:
    return {"said": step.said, "gain": step.gain, "p_value": step.p_value, "model": _model(step.fitted)}


def _times(model: Fitted, series: Series) -> float:
    """Return how many times what another run's model predicts a log has moved; NaN when it lacks a sensor."""
    if any(term.channel not in series.temperatures_c for term in model.terms):
        return float("nan")
    told = sum(value * series.column(term) for term, value in zip(model.terms, model.value[1:], strict=True))
    off = np.asarray(told) - float(np.mean(told))
    return float(off @ (series.moved_um - series.moved_um.mean()) / (off @ off))
