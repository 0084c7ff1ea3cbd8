"""The best correction that is found when the truth is known, under a bundle's own limits, and runs of a virtual machine with it, with a correction and without."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from dtwin.machines import mechanism as m_
from dtwin.machines.controller import CobotController
from dtwin.machines.parameters import ControllerParameters
from dtwin.schema import Floats, Run
from dtwin.serve.interface import SafetyLimits
from dtwin.serve.safety import Guard
from dtwin.statistics import rms
from dtwin.train.champion_error import run_errors
from dtwin.train.closed_loop import WITH, WITHOUT, Evidence, EvidenceRun, evidence_of_runs
from dtwin.train.results import condition_name
from dtwin.units import UM_PER_MM

TICK_S = 0.002
_Controller = TypeVar("_Controller", bound=CobotController)
_ROUNDS = 6
# What is learned from a run is taken below these: higher up the structure answers out of phase.
_LEARNED_HZ = (30.0, 6.0)
# A tick that is this near the commonest distance from the centre is on the circle, not in the in-feed.
_ON_CIRCLE_MM = 0.1


def best_offsets(
    begun: Sequence[Callable[[], CobotController]],
    centre_mm: Floats,
    motion: ControllerParameters,
    safety: SafetyLimits,
) -> list[Floats]:
    """Return the offsets that leave least of the true radial error, found by running again and again.

    Begun with nothing; then what is left of the best runs so far is led ahead by delay and lag and
    taken off, and by less after a round that was worse. The best round is returned, so it is
    never worse than no correction; nobody proves that there is no better one.

    ``begun``: new controllers at the start of their programs, which repeat exactly; what is left is judged about one
    centre and one radius for all of them, as the ball bar is.
    ``centre_mm``, shape (3,): about which they turn.
    ``motion``: for delay and lag.
    ``safety``: limits of the bundle, to which these offsets are subject, too.
    Returns, shape (ticks, 3): um, before the guard.
    """
    from scipy.signal import butter, sosfiltfilt

    ahead = round((motion.actuator_delay_s + motion.actuator_lag_s) / TICK_S)
    still = [np.zeros((1, 3)) for _ in begun]
    best, (left, least) = still, _left_um(begun, still, centre_mm, safety)
    gain, hz = 1.0, iter(_LEARNED_HZ)
    low = butter(2, next(hz), fs=1.0 / TICK_S, output="sos")
    for _ in range(_ROUNDS):
        tried = [
            was[np.minimum(np.arange(len(rest)), len(was) - 1)] - gain * sosfiltfilt(low, _led(rest, ahead), axis=0)
            for was, rest in zip(best, left, strict=True)
        ]
        after, size = _left_um(begun, tried, centre_mm, safety)
        if size < least:
            best, left, least = tried, after, size
        else:
            gain *= 0.5
            low = butter(2, next(hz, _LEARNED_HZ[-1]), fs=1.0 / TICK_S, output="sos")
    return best


def follow(controller: _Controller, offsets_um: Floats, safety: SafetyLimits) -> tuple[_Controller, dict[str, int]]:
    """Run a program with offsets through the guard; return it and how often each guard acted.

    ``controller``: at the start of the program.
    ``offsets_um``, shape (n, 3): by tick; the last one is held.
    """
    guard, ticks = Guard(safety, np.empty(0), np.empty(0)), controller.ticks_left
    wanted = offsets_um[np.minimum(np.arange(ticks), len(offsets_um) - 1)]
    safe = guard.run(wanted, np.empty((ticks, 0)), elapsed_s=TICK_S)
    controller.run(np.column_stack([np.arange(1.0, ticks + 1.0), safe]))
    return controller, guard.counted()


def _left_um(
    begun: Sequence[Callable[[], CobotController]], offsets: Sequence[Floats], centre_mm: Floats, safety: SafetyLimits
) -> tuple[list[Floats], float]:
    """Return what is left along the radius, each of shape (ticks, 3), and its RMS on the circles."""
    outward, error, counted = [], [], []
    for make, offset in zip(begun, offsets, strict=True):
        truths = follow(make(), offset, safety)[0].ticks().truths
        away = truths[:, :3] - centre_mm
        far = np.linalg.norm(away, axis=1)
        outward.append(away / far[:, None])
        vector_um = UM_PER_MM * (truths[:, m_.TCP : m_.TCP + 3] - truths[:, :3])
        error.append(np.sum(vector_um * outward[-1], axis=1))
        counted.append(np.abs(far - np.median(far)) < _ON_CIRCLE_MM)
    on, unit, radial = np.concatenate(counted), np.concatenate(outward), np.concatenate(error)
    basis = np.column_stack([np.ones(len(unit)), unit])
    rest = radial - basis @ np.linalg.lstsq(basis[on], radial[on], rcond=None)[0]
    rest[~on] = 0.0
    parts = np.split(rest[:, None] * unit, np.cumsum([len(part) for part in error])[:-1])
    return parts, rms(rest[on])


def _led(error_um: Floats, ahead: int) -> Floats:
    return error_um[np.minimum(np.arange(len(error_um)) + ahead, len(error_um) - 1)]


@dataclass(frozen=True)
class MeasuredWays:
    """What a virtual machine was measured to do.

    ``runs``: in order of time; those whose ``meta.correction`` is set were corrected.
    ``clock``: clock that they ran on.
    ``oracle``: runs of a correction that knows the machine's repeatable error, under the same guard.
    ``acted``: by the name of a condition: share of the ticks in which each guard acted.
    ``trained``: whether a condition is of a kind that was trained.
    """

    runs: tuple[Run, ...]
    clock: str
    delays: Mapping[str, float] = field(default_factory=dict)
    oracle: tuple[Run, ...] = ()
    acted: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    trained: Callable[[Mapping[str, Any]], bool] = lambda condition: True

    def notes(self) -> dict[str, Any]:
        """Return what the runs alone do not tell, as :class:`Evidence` keeps it."""
        known: dict[str, dict[str, Any]] = defaultdict(dict)
        for error in run_errors(self.runs):
            known[condition_name(error.condition)]["trained"] = self.trained(error.condition)
        sizes: dict[str, list[float]] = defaultdict(list)
        for error in run_errors(self.oracle):
            sizes[condition_name(error.condition)].append(error.size_um)
        for name, size in sizes.items():
            known[name]["oracle_um"] = float(np.mean(size))
        for name, shares in self.acted.items():
            known[name]["acted"] = dict(shares)
        return {"clock": self.clock, "delays": dict(self.delays), "conditions": dict(known)}

    def evidence(self, machine: str, model_sha256: str) -> Evidence:
        """Return what the runs say, without a lake; nothing is promoted by it."""
        runs = [EvidenceRun(WITH if run.meta.correction else WITHOUT, "", "", run) for run in self.runs]
        return evidence_of_runs(
            runs,
            kind="virtual",
            machine=machine,
            model_sha256=model_sha256,
            campaigns={WITHOUT: (), WITH: ()},
            notes=self.notes(),
        )


def numbered(runs: Iterable[Run]) -> tuple[Run, ...]:
    """Return runs, given in the order of time, with names of their own, repeats of each condition and way counted."""
    repeats: dict[object, int] = defaultdict(int)
    out = []
    for number, run in enumerate(runs, start=1):
        m = run.meta
        stated = tuple(sorted(m.condition.items()))
        key = m.plane, m.radius_mm, m.feed_mm_min, m.direction, stated, m.correction
        repeats[key] += 1
        meta = replace(m, run_id=f"e{number:03d}", repeat=repeats[key])
        out.append(replace(run, meta=meta))
    return tuple(out)


def guard_shares(counts: Sequence[Mapping[str, int]]) -> dict[str, float]:
    """Return the share of all ticks in which each guard acted, from the counts of every run."""
    total = sum(sum(c.values()) for c in counts)
    names = sorted({name for c in counts for name in c})
    return {n: sum(c.get(n, 0) for c in counts) / total for n in names} if total else {}
