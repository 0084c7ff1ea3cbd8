"""Warm-ups with and without a correction, by turns, and what logs say of it; logs of the virtual column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import timedelta
from pathlib import Path

import numpy as np

from dtwin.acquire.campaign_folder import write_campaign_file
from dtwin.acquire.virtual import EPOCH
from dtwin.atomic import write_text
from dtwin.errors import InputError
from dtwin.kinds.drift._series import moved_um
from dtwin.kinds.machine import require_no_campaign
from dtwin.machines.warm_column import STEP_S, ColumnParameters, Day, WarmColumn
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.statistics import rms
from dtwin.train.champion_error import Condition, RunError
from dtwin.train.oracle import MeasuredWays, guard_shares, numbered
from dtwin.train.results import condition_name

_DAYS = 3
_STRETCHES = 60
# The warm-up of ISO 230-3: the spindle runs, then it stands.
_WARM_H, _COOL_H, _WARM_W = 2.5, 1.5, 330.0
_CLOCK = f"machine clock, a state every {STEP_S:g} s, one state late"


def drift_errors(runs: Sequence[Run]) -> list[RunError]:
    """Return the drift of every log since it began, as evidence compares them.

    Logs of one axis, one test and the same whole hours are repeats.
    """
    out = []
    for number, run in enumerate(runs):
        t_s, moved = run.samples["t_s"], moved_um(run)
        since = moved - float(moved[t_s <= t_s[0] + _PROBED_S / 2.0].mean())
        middle = t_s[0] + float(np.ptp(t_s)) * (np.arange(_STRETCHES) + 0.5) / _STRETCHES
        order = np.argsort(t_s, kind="stable")
        stated = run.meta.condition
        condition: Condition = {
            "axis": str(stated.get("axis", "")),
            "test": str(stated.get("test", "")),
            "hours": float(round(float(np.ptp(t_s)) / 3600.0)),
        }
        rest = np.interp(middle, t_s[order], since[order])
        out.append(RunError(number, condition, "", rms(since), rest))
    return out


def measured_warm_ups(bundle: Bundle, truth: str, seed: int, progress: Progress = silent) -> MeasuredWays:
    """Warm the virtual column up on several days with a bundle, and on as many between without.

    Every day has its own hall, its own start and its own noise; no log of training was such a warm-up. The oracle knows how far
    the nose moves, and is left with the noise of the probe.

    ``truth``: as for :func:`dtwin.kinds.drift._simulate.column_of`.
    """
    column = _column_of(truth)
    heat = np.full(round((_WARM_H + _COOL_H) * 3600.0 / STEP_S), _WARM_W)
    heat[round(_WARM_H * 3600.0 / STEP_S) :] = 0.0
    runs: list[Run] = []
    oracle: list[Run] = []
    guards: list[Mapping[str, int]] = []
    for number in range(2 * _DAYS):
        drawn = 100_000 + 1000 * seed + number
        day = column.day(heat, drawn)
        corrected = number % 2 == 1
        sent, guard = _served(bundle, day) if corrected else (np.zeros(day.t_s.size), None)
        runs.append(_run(column, day, day.moved_um + sent, number, drawn, bundle.model_sha256 if corrected else ""))
        if guard is not None:
            guards.append(guard)
        else:
            oracle.append(_run(column, day, np.zeros(day.t_s.size), number, drawn, ""))
        progress(number + 1, 2 * _DAYS, "warm-ups")
    (name,) = {condition_name(error.condition) for error in drift_errors(runs)}
    return MeasuredWays(
        numbered(runs), _CLOCK, {"one state": STEP_S}, tuple(oracle), {name: guard_shares(guards)}, lambda _: False
    )


def _served(bundle: Bundle, day: Day) -> tuple[Floats, Mapping[str, int]]:
    """Return the offset of the axis that is in force at each step, and how often each reason of the guard acted."""
    told = {f"temperature_{name}_c": values for name, values in day.read_c.items()}
    told["timestamp_s"] = EPOCH.timestamp() + day.t_s
    wanted = np.zeros((day.t_s.size, 3))
    moved = "xyz".index(bundle.outputs[0].frame[-1])
    asked = CompiledBundle(bundle).run(np.column_stack([told[name] for name in bundle.tick_inputs]))
    wanted[:, moved] = -asked[:, 0]
    guard = Guard(bundle.safety, *bundle.box)
    box = np.column_stack([told[i.name] for i in bundle.inputs])
    sent = guard.run(wanted, box, elapsed_s=STEP_S)[:, moved]
    return np.concatenate([[0.0], sent[:-1]]), guard.counted()


def _run(column: WarmColumn, day: Day, moved_um: Floats, number: int, seed: int, correction: str) -> Run:
    """Return what the probe reads once the correction has engaged, zero where the log begins."""
    at = _probed(day)[_AGAIN:]
    read = column.probed_um(moved_um[at], seed)
    samples = {
        "t_s": day.t_s[at] - day.t_s[at[0]] + np.tile(np.arange(float(_AGAIN)), at.size // _AGAIN),
        "displacement_um": read - float(read[:_AGAIN].mean()),
        "sample_1": np.repeat(np.arange(at.size // _AGAIN, dtype=float), _AGAIN),
        **{f"temperature_{name}_c": values[at] for name, values in day.read_c.items()},
    }
    meta = RunMeta(
        "e",
        kind="drift",
        condition={"axis": _AXIS, "test": "warm-up"},
        correction=correction,
        started=(EPOCH + timedelta(days=number)).isoformat(),
    )
    return Run(meta, samples, source="virtual column")


_MACHINE = "virtual-warm-column"
_TYPE = "warm_column"
_AXIS = "Z"
_TRUTHS = {
    "surface": ColumnParameters(),
    "pockets": ColumnParameters(sunk=True),
    "thermistor": ColumnParameters(sunk=True, curve_per_k=0.02),
}
_PROBED_S = 60.0
_AGAIN = 2
_LOGS, _HOURS, _QUICK_HOURS = 3, 10.0, 8.0


def _column_of(truth: str) -> WarmColumn:
    """Return the virtual column by where its sensors sit; raises ``InputError`` when there is none such."""
    if truth not in _TRUTHS:
        raise InputError("no such column", code="simulate.truth", got=truth[:40], allowed=", ".join(_TRUTHS))
    return WarmColumn(_TRUTHS[truth])


def _probed(day: Day) -> Floats:
    """Return the numbers of the steps at which the probe reads, each as often as it reads there."""
    every = np.arange(0, day.t_s.size, round(_PROBED_S / STEP_S))
    return np.repeat(every, _AGAIN)


def simulate_drift(
    folder: Path, progress: Progress, *, truth: str = "surface", seed: int = 0, quick: bool = False
) -> int:
    """Log the virtual column on days of many jobs and write a campaign folder; return how many logs.

    ``quick``: one log of one shift. Raises ``InputError`` when the folder holds a campaign, or there is no such column.
    """
    require_no_campaign(folder)
    column = _column_of(truth)
    folder.mkdir(parents=True, exist_ok=True)
    logs, hours = (1, _QUICK_HOURS) if quick else (_LOGS, _HOURS)
    runs = []
    for number in range(logs):
        drawn = 1000 * seed + number
        day = column.day(column.drawn_program_w(hours, drawn), drawn)
        write_text(folder / f"day-{number + 1}.csv", _log(column, day, drawn), "the log")
        started = (EPOCH + timedelta(days=number)).isoformat()
        runs.append(
            {
                "id": f"day-{number + 1}",
                "file": f"day-{number + 1}.csv",
                "condition": {"axis": _AXIS},
                "started": started,
            }
        )
        progress(number + 1, logs, f"day {number + 1}")
    head = {
        "name": f"warm-column-{truth}",
        "machine": _MACHINE,
        "kind": "drift",
        "machine_geometry": {"type": _TYPE, "virtual": True, "truth": truth},
        "instrument": {"model": "virtual probe and thermometers"},
    }
    write_campaign_file(folder, head, runs)
    return logs


def _log(column: WarmColumn, day: Day, seed: int) -> str:
    at = _probed(day)
    sample = np.repeat(np.arange(at.size // _AGAIN), _AGAIN)
    read = column.probed_um(day.moved_um[at], seed)
    lines = [",".join(["t_s", "sample", "displacement_um", *(f"temperature_{name}_c" for name in day.read_c)])]
    for n, (i, of, um) in enumerate(zip(at.tolist(), sample.tolist(), read.tolist(), strict=True)):
        cells = [
            f"{day.t_s[i] + n % _AGAIN:z.0f}",
            str(of),
            f"{um:z.3f}",
            *(f"{c[i]:z.2f}" for c in day.read_c.values()),
        ]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"
