"""From runs in the lake to aligned ticks: what the controller knew, what the bar measured."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.features.infeed import align_infeed
from dtwin.features.path_inputs import STATE_FIELDS, PathInputs
from dtwin.lake.store import Lake
from dtwin.progress import Progress, silent
from dtwin.schema import PLANES, Campaign, Floats, Run, RunMeta, SignalGroup
from dtwin.train.side_by_side import side_by_side

TICK_HZ = 500.0
_ROW_EVERY = 10
# Runs that are read before the first of them is aligned: the memory that reading ahead takes.
_AHEAD = 4
_INDEX = {name: place for place, name in enumerate(STATE_FIELDS)}
_NEEDED = ("segment_time_s", *(f"target_tcp_{axis}_mm" for axis in "xyz"))
_TOGETHER = tuple(
    [name for name in STATE_FIELDS if name.startswith(begin)] for begin in ("target_q_", "target_qd_", "target_speed_")
)
"""Columns of a controller's log that training needs, and those that it has all of, or none."""


@dataclass(frozen=True)
class TickRun:
    """One run on the controller's clock.

    ``meta``: condition and set-up.
    ``inputs``, shape (ticks, 34): path inputs at 500 Hz in the order of ``PATH_INPUTS``.
    ``bar_um``, shape (n,): the bar's samples on its own clock.
    ``bar_rate_hz``, ``lag_s``: controller time = bar time + lag.
    ``arc``: rows used for fitting: ticks on the arc, at 50 Hz, that the bar covers.
    ``scored``, shape (len(arc),): whether a row lies in the marked window.
    ``accelerometers``: raw accelerations on their own clock.
    """

    meta: RunMeta
    inputs: np.ndarray[Any, np.dtype[np.float32]]
    bar_um: Floats
    bar_rate_hz: float
    lag_s: float
    arc: np.ndarray[Any, np.dtype[np.int64]]
    scored: np.ndarray[Any, np.dtype[np.bool_]]
    accelerometers: SignalGroup | None = None

    def target_um(self, lag_s: float | Floats | None = None) -> Floats:
        """Return the bar's deviation at the rows, shape (len(arc),), or (lags, len(arc)) of lags of shape (lags, 1)."""
        lag = self.lag_s if lag_s is None else lag_s
        t = self.arc / TICK_HZ - lag
        return np.interp(t, np.arange(self.bar_um.size) / self.bar_rate_hz, self.bar_um)

    @property
    def angle_rad(self) -> Floats:
        """Path angle at the rows."""
        return self.inputs[self.arc, 0].astype(float)


def load_ticks(
    lake: Lake, campaign: Campaign, rows: Sequence[Mapping[str, Any]], progress: Progress = silent
) -> list[TickRun]:
    """Read runs and bring them to the controller's clock, in the order of the rows; progress is told by run id."""
    runs: list[TickRun] = []
    begun: deque[Future[TickRun]] = deque()
    with side_by_side() as (pool, step):

        def aligned(run: Run) -> TickRun:
            step(0, 0, "")
            return _tick_run(run, campaign)

        # One is read while others are brought to the clock.
        for number, row in enumerate(rows, start=1):
            begun.append(pool.submit(aligned, lake.load(row)))
            while begun and (len(begun) > _AHEAD or number == len(rows)):
                runs.append(begun.popleft().result())
                progress(len(runs), len(rows), runs[-1].meta.run_id)
    return runs


def _tick_run(run: Run, campaign: Campaign) -> TickRun:
    """Bring one run to the controller's clock at 500 Hz.

    ``run``: a circular run with a ``controller`` signal group.
    ``campaign``: its campaign; ``machine_geometry`` gives centre and tool.
    """
    groups = {group.name: group for group in run.signals}
    if "controller" not in groups:
        raise InputError(
            "a run without controller signals cannot train a correction",
            code="train.signals",
            where=run.meta.run_id,
            got=", ".join(groups) or "no signals",
            allowed="a signal group named controller",
        )
    states = _controller_ticks(groups["controller"], run.meta, campaign.machine_geometry)
    tool = np.asarray(campaign.machine_geometry.get("tcp_mm", [0.0, 0.0, 0.0]), dtype=float)
    inputs = PathInputs(_INDEX, tool).batch(states)
    commanded_um = _commanded_deviation_um(states, run.meta)
    bar = np.asarray(run.samples["deviation_um"], dtype=float)
    aligned = align_infeed(bar, run.meta.sample_rate_hz, commanded_um[::4], inputs[::4, 0], TICK_HZ / 4)
    covered = _covered_ticks(groups["controller"], len(states))
    bare = TickRun(
        run.meta,
        inputs.astype(np.float32),
        bar,
        run.meta.sample_rate_hz,
        aligned.lag_s,
        np.empty(0, np.int64),
        np.empty(0, bool),
        groups.get("accelerometers"),
    )
    return _with_rows(bare, commanded_um, run.window, covered)


def _with_rows(
    run: TickRun, commanded_um: Floats, window: tuple[int, int] | None, covered: NDArray[np.bool_]
) -> TickRun:
    """Choose the rows of a run: on the arc, covered by bar and controller, at 50 Hz."""
    ticks = np.arange(0, commanded_um.size, _ROW_EVERY)
    t_bar = ticks / TICK_HZ - run.lag_s
    inside = (t_bar > 0.05) & (t_bar < (run.bar_um.size - 1) / run.bar_rate_hz - 0.05)
    arc = ticks[inside & covered[ticks] & (np.abs(commanded_um[ticks]) < 1.0)]
    if window is None:
        scored = np.ones(arc.size, dtype=bool)
    else:
        sample = (arc / TICK_HZ - run.lag_s) * run.bar_rate_hz
        scored = (sample >= window[0]) & (sample < window[1])
    return replace(run, arc=arc, scored=scored)


def _controller_ticks(group: SignalGroup, meta: RunMeta, geometry: Mapping[str, Any]) -> Floats:
    """Return the controller's states at 500 Hz in the order of ``STATE_FIELDS``.

    ``group``: the controller's record at any rate that divides its motion finely.
    ``meta``: gives plane, direction and radius.
    Returns (ticks, len(STATE_FIELDS)).
    """
    _require_columns(group, meta)
    t_log = np.arange(group.n_samples) / group.rate_hz
    t = np.arange(int(t_log[-1] * TICK_HZ) + 1) / TICK_HZ
    out = np.zeros((t.size, len(STATE_FIELDS)))
    known = _complete_rows(group)
    for name, place in _INDEX.items():
        if name in group.columns:
            out[:, place] = np.interp(t, t_log[known], group.columns[name][known])
    out[:, _INDEX["timestamp_s"]] = t
    out[:, _INDEX["segment_time_s"]] = _segment_time(t, t_log[known], group.columns["segment_time_s"][known])
    centre = _centre_mm(meta, geometry)
    for axis, value in zip("xyz", centre, strict=True):
        out[:, _INDEX[f"centre_{axis}_mm"]] = value
    plane = meta.plane or "XY"
    out[:, _INDEX["feed_mm_min"]] = float(meta.feed_mm_min or 0.0)
    out[:, _INDEX["plane_id"]] = PLANES.index(plane)
    out[:, _INDEX["direction_sign"]] = 1.0 if meta.direction == "CCW" else -1.0
    return out


def _require_columns(group: SignalGroup, meta: RunMeta) -> None:
    """Refuse a log without the commanded place, or with some joints or speeds only: what lacks would be taken for zero."""
    lacking = [name for name in _NEEDED if name not in group.columns]
    for names in _TOGETHER:
        there = [name for name in names if name in group.columns]
        lacking += [name for name in names if there and name not in there]
    if lacking:
        raise InputError(
            "the controller's log lacks columns",
            code="train.signals",
            where=meta.run_id,
            got=", ".join(lacking)[:160],
            allowed=f"{', '.join(_NEEDED)}; joints and speeds of all axes, or of none",
            hint="docs/how-to/ingest-your-own.md, write the signals",
        )


def _complete_rows(group: SignalGroup) -> NDArray[np.bool_]:
    """Return which rows of the controller's log hold numbers; lost ones are NaN."""
    floats = [v for v in group.columns.values() if v.dtype.kind == "f"]
    known = np.all([np.isfinite(v) for v in floats], axis=0)
    if np.count_nonzero(known) < 2:
        raise InputError("the controller's log holds no rows", code="train.signals")
    return np.asarray(known)


def _covered_ticks(group: SignalGroup, n_ticks: int) -> NDArray[np.bool_]:
    """Return which ticks lie between rows of the log that follow each other without a gap."""
    known = np.flatnonzero(_complete_rows(group))
    place = np.arange(n_ticks) / TICK_HZ * group.rate_hz
    after = np.clip(np.searchsorted(known, place, side="left"), 1, known.size - 1)
    return np.asarray(known[after] - known[after - 1] == 1)


def _centre_mm(meta: RunMeta, geometry: Mapping[str, Any]) -> Floats:
    """Return the ball bar's centre in the base frame, shape (3,)."""
    if "centre_mm" in geometry:
        return np.asarray(geometry["centre_mm"], dtype=float)
    if "centre_small_mm" in geometry and meta.radius_mm is not None:
        large = meta.radius_mm >= float(geometry["large_radius_from_mm"])
        return np.asarray(geometry["centre_large_mm" if large else "centre_small_mm"], dtype=float)
    raise InputError(
        "the campaign does not state where the ball-bar centre is",
        code="train.geometry",
        allowed="centre_mm in [campaign.machine_geometry]",
    )


def _segment_time(t: Floats, t_log: Floats, logged: Floats) -> Floats:
    """Hold the time since segment start between rows, restarting where a segment began."""
    row = np.clip(np.searchsorted(t_log, t, side="right") - 1, 0, t_log.size - 1)
    held = logged[row] + (t - t_log[row])
    after = np.clip(row + 1, 0, t_log.size - 1)
    begun = t_log[after] - logged[after]
    fresh = (logged[after] < logged[row]) & (t >= begun)
    return np.asarray(np.where(fresh, t - begun, held))


def _commanded_deviation_um(states: Floats, meta: RunMeta) -> Floats:
    plane = PLANES.index(meta.plane or "XY")
    first, second = "xyz"[plane % 3], "xyz"[(plane + 1) % 3]
    a = states[:, _INDEX[f"target_tcp_{first}_mm"]] - states[:, _INDEX[f"centre_{first}_mm"]]
    b = states[:, _INDEX[f"target_tcp_{second}_mm"]] - states[:, _INDEX[f"centre_{second}_mm"]]
    return np.asarray((np.hypot(a, b) - float(meta.radius_mm or 0.0)) * 1000.0)


def require_uncorrected(campaign: Campaign) -> None:
    """Refuse a campaign whose geometry says that it was measured under a correction: no equation is made of it."""
    if campaign.machine_geometry.get("corrected", False):
        raise InputError(
            "a correction was in force during this campaign: it shows what that left, not the machine",
            code="train.corrected",
            where=campaign.name,
            got="corrected = true",
            hint="use a campaign without; dtwin twin fit shows what is left of this one",
        )
