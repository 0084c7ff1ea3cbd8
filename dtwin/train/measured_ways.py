"""Runs of a virtual machine with a correction, without it, and with one that knows everything."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dtwin.schema import Run
from dtwin.train.evidence import WITH, WITHOUT, Evidence, EvidenceRun, evidence_of_runs
from dtwin.train.results import condition_name
from dtwin.train.run_errors import run_errors


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
