"""Closed-loop evidence: what runs with a correction say beside runs without it, interleaved."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from dtwin.errors import GateRefusal
from dtwin.schema import Floats, Run
from dtwin.statistics import t_quantile
from dtwin.train.champion_error import RunError, measured_sha256, run_errors
from dtwin.train.results import condition_name

Way = Literal["without", "with"]
WITHOUT: Way = "without"
WITH: Way = "with"
FEWEST_RUNS = 3
"""Runs of a condition each way, below which no interval is believed."""
FEWEST_REPEATS = 2
"""Runs of each direction each way: one alone does not tell what repeats disagree by."""
_Key = tuple[tuple[str, str | float], ...]


@dataclass(frozen=True)
class EvidenceRun:
    """A run of the lake that counts as evidence. ``way``: whether the correction was in force."""

    way: Way
    campaign: str
    content_sha256: str
    run: Run

    @property
    def name(self) -> str:
        """Campaign and run."""
        return f"{self.campaign}/{self.run.meta.run_id}"


@dataclass(frozen=True)
class Evidence:
    """What a correction does to a machine, computed from runs.

    ``machine``, ``model_sha256``: whose correction was in force: ``Bundle.model_sha256``.
    ``conditions``: before and after of every condition: ``before_um``, ``after_um`` (RMS of the error, mean over runs),
    ``before_ci_um``, ``after_ci_um`` (half widths of 95 % intervals over runs, from the spread inside each direction),
    ``floor_um`` (what repeats without correction disagree by), ``n_without``, ``n_with``, ``runs_with`` (numbers of
    the runs: of one run several conditions may be, such as both approaches of an axis), ``reduction``, ``better``, ``worse``.
    ``runs``: ``way``, ``campaign``, ``run_id``, ``started`` and ``content_sha256`` of what was counted.
    ``switches``: how often the way changed in the course of time.
    ``told``: what was left out, and what to know of it.
    ``notes``: what the runs do not tell, for reports: ``clock``, ``delays``, and by the name of a condition
    ``trained``, ``oracle_um`` and ``acted``. No gate reads it.
    ``profiles``: mean error along the path, for plots: condition -> way -> direction -> list.
    ``reached``: least and largest value of each column of the runs with the correction.
    """

    kind: str
    machine: str
    model_sha256: str
    campaigns: Mapping[Way, tuple[str, ...]]
    conditions: tuple[Mapping[str, Any], ...]
    runs: tuple[Mapping[str, str], ...]
    switches: int
    told: tuple[str, ...] = ()
    notes: Mapping[str, Any] = field(default_factory=dict)
    profiles: Mapping[str, Any] = field(default_factory=dict, repr=False)
    reached: Mapping[str, tuple[float, float]] = field(default_factory=dict, repr=False)

    def share_of_oracle(self, *, trained: bool) -> float:
        """Return the reduction as a share of the oracle's, over feeds that were trained or not."""
        shown = [c for c in self._shown() if c["oracle_um"] and c["trained"] is trained]
        before, after, oracle = (
            math.sqrt(sum(c[name] ** 2 for c in shown)) for name in ("before_um", "after_um", "oracle_um")
        )
        return (before - after) / (before - oracle) if before > oracle else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping without the profiles."""
        return {
            "kind": self.kind,
            "machine": self.machine,
            "model_sha256": self.model_sha256,
            "campaigns": {way: list(names) for way, names in self.campaigns.items()},
            "clock": self.notes.get("clock", "as the runs were recorded"),
            "delays": dict(self.notes.get("delays", {})),
            "share_of_oracle_unseen_feeds": self.share_of_oracle(trained=False),
            "share_of_oracle_trained_feeds": self.share_of_oracle(trained=True),
            "switches": self.switches,
            "told": list(self.told),
            "conditions": self._shown(),
            "runs": [dict(run) for run in self.runs],
        }

    def _shown(self) -> list[dict[str, Any]]:
        known = self.notes.get("conditions", {})
        empty: dict[str, Any] = {"trained": None, "oracle_um": None, "acted": {}}
        return [empty | dict(c) | known.get(condition_name(c), {}) for c in self.conditions]


def evidence_of_runs(
    runs: Sequence[EvidenceRun],
    *,
    kind: str,
    machine: str,
    model_sha256: str,
    campaigns: Mapping[Way, tuple[str, ...]],
    notes: Mapping[str, Any] | None = None,
    told: Sequence[str] = (),
) -> Evidence:
    """Return what runs say, the run as unit of replication.

    ``runs``: of one machine, and with one correction or none.
    Raises ``GateRefusal`` when a condition has too few runs, none was run both ways, or the ways follow each other
    instead of taking turns.
    """
    own, copies = _without_copies(runs)
    said = [*told, *copies]
    errors = {way: _by_condition([r for r in own if r.way == way]) for way in (WITHOUT, WITH)}
    paired = sorted(key for key in errors[WITHOUT] if key in errors[WITH])
    if not paired:
        raise GateRefusal(
            "no condition was run both with and without the correction",
            code="evidence.pairs",
            got=f"{len(errors[WITHOUT])} conditions without, {len(errors[WITH])} with",
        )
    alone = {way: [k for k in errors[way] if k not in paired] for way in errors}
    said += [
        f"not counted, because run only {way}: {', '.join(map(_named, keys))}" for way, keys in alone.items() if keys
    ]
    directions = {
        key: sorted({e.direction for e in errors[WITHOUT][key]} & {e.direction for e in errors[WITH][key]})
        for key in paired
    }
    counted = {way: {k: [e for e in errors[way][k] if e.direction in directions[k]] for k in paired} for way in errors}
    _require_enough(counted, directions)
    used = _used(own, counted)
    switches = _require_turns(used)
    said += _in_a_row(own, counted)
    conditions = [_condition(k, counted[WITHOUT][k], counted[WITH][k]) for k in paired]
    return Evidence(
        kind,
        machine,
        model_sha256,
        dict(campaigns),
        tuple(conditions),
        tuple(
            {
                "way": r.way,
                "campaign": r.campaign,
                "run_id": r.run.meta.run_id,
                "started": r.run.meta.started,
                "content_sha256": r.content_sha256,
            }
            for r in used
        ),
        switches,
        tuple(said),
        dict(notes or {}),
        {condition_name(dict(k)): _profile({w: counted[w][k] for w in counted}) for k in paired},
        _reached([r.run for r in used if r.way == WITH]),
    )


def started_at(run: Run) -> datetime | None:
    """Return when a run began, None when it does not say; without a zone it is this computer's."""
    try:
        stated = datetime.fromisoformat(run.meta.started)
    except ValueError:
        return None
    return stated.astimezone(UTC)


def _without_copies(runs: Sequence[EvidenceRun]) -> tuple[list[EvidenceRun], list[str]]:
    first: dict[str, EvidenceRun] = {}
    said = []
    for run in runs:
        digest = measured_sha256(run.run)
        if digest in first:
            said.append(f"not counted: {run.name} is a copy of {first[digest].name}")
        else:
            first[digest] = run
    return list(first.values()), said


def _by_condition(runs: Sequence[EvidenceRun]) -> dict[_Key, list[RunError]]:
    by_condition: dict[_Key, list[RunError]] = defaultdict(list)
    for error in run_errors([r.run for r in runs]):
        by_condition[tuple(sorted(error.condition.items()))].append(error)
    return dict(by_condition)


def _require_enough(
    counted: Mapping[Way, Mapping[_Key, Sequence[RunError]]], directions: Mapping[_Key, list[str]]
) -> None:
    few = []
    for way, runs in counted.items():
        for key, errors in runs.items():
            n = {d: sum(e.direction == d for e in errors) for d in directions[key]}
            if len(errors) < FEWEST_RUNS or min(n.values()) < FEWEST_REPEATS:
                told = ", ".join(f"{count} {d}".strip() for d, count in n.items()) or "none"
                few.append(f"{_named(key)} {way}: {told}")
    if few:
        raise GateRefusal(
            "too few runs to know what repeats disagree by",
            code="evidence.few",
            got="; ".join(few)[:400],
            allowed=f"of every condition {FEWEST_RUNS} runs each way, and {FEWEST_REPEATS} of each direction",
            hint="measure more of them, with and without by turns",
        )


def _used(own: Sequence[EvidenceRun], counted: Mapping[Way, Mapping[_Key, Sequence[RunError]]]) -> list[EvidenceRun]:
    """Return the runs that were counted, in order of time where it is known."""
    chosen = []
    for way, runs in counted.items():
        mine = [r for r in own if r.way == way]
        numbers = sorted({error.run for errors in runs.values() for error in errors})
        chosen += [mine[number] for number in numbers]
    return sorted(chosen, key=lambda r: started_at(r.run) or datetime.min.replace(tzinfo=UTC))


def _require_turns(used: Sequence[EvidenceRun]) -> int:
    """Refuse ways that follow each other: what else changed meanwhile would count as correction."""
    untold = [r.name for r in used if started_at(r.run) is None]
    if untold:
        raise GateRefusal(
            "runs do not say when they were measured, so that nobody knows whether the ways took turns",
            code="evidence.time",
            got=", ".join(untold[:8]),
            hint="state started for every run of campaign.toml",
        )
    if not _take_turns(used):
        spans = {way: [s for r in used if r.way == way and (s := started_at(r.run))] for way in (WITHOUT, WITH)}
        raise GateRefusal(
            "the runs without and with the correction follow each other",
            code="evidence.turns",
            got="; ".join(
                f"{way} {min(times).isoformat(timespec='seconds')} to {max(times).isoformat(timespec='seconds')}"
                for way, times in spans.items()
            ),
            allowed="with and without by turns: else warmth and drift look like a correction",
            hint="dtwin campaign --with VERSION measures them in turns",
        )
    return sum(one.way != other.way for one, other in pairwise(used))


def _take_turns(runs: Sequence[EvidenceRun]) -> bool:
    times = {way: [s for r in runs if r.way == way and (s := started_at(r.run))] for way in (WITHOUT, WITH)}
    return max(times[WITHOUT]) > min(times[WITH]) and max(times[WITH]) > min(times[WITHOUT])


def _in_a_row(own: Sequence[EvidenceRun], counted: Mapping[Way, Mapping[_Key, Sequence[RunError]]]) -> list[str]:
    """Name the conditions whose own runs happened to follow each other."""
    mine = {way: [r for r in own if r.way == way] for way in counted}
    rows = [
        _named(key)
        for key in counted[WITHOUT]
        if not _take_turns([mine[way][e.run] for way in counted for e in counted[way][key]])
    ]
    return [f"all of one way before the other within {', '.join(rows)}"] if rows else []


def _condition(key: _Key, without: Sequence[RunError], with_: Sequence[RunError]) -> dict[str, Any]:
    (before, before_ci), (after, after_ci) = _mean(without), _mean(with_)
    change, half = after - before, math.hypot(before_ci, after_ci)
    return {
        **dict(key),
        "before_um": before,
        "after_um": after,
        "before_ci_um": before_ci,
        "after_ci_um": after_ci,
        "floor_um": _floor(without),
        "n_without": len(without),
        "n_with": len(with_),
        "runs_with": sorted({e.run for e in with_}),
        "reduction": 1.0 - after / before,
        "better": change < -half,
        "worse": change > half,
    }


def _mean(errors: Sequence[RunError]) -> tuple[float, float]:
    """Return the mean size and half its 95 % interval.

    Both directions are always run; that their errors differ is not what repeats disagree by.
    """
    sizes = [np.array([e.size_um for e in group]) for group in _groups(errors)]
    n = len(errors)
    freedom = n - len(sizes)
    spread = sum(float(np.sum((s - s.mean()) ** 2)) for s in sizes)
    half = t_quantile(0.975, freedom) * math.sqrt(spread / freedom / n)
    return float(np.concatenate(sizes).mean()), half


def _floor(errors: Sequence[RunError]) -> float:
    """Return what repeats of one direction disagree by, from place to place."""
    squares, freedom = 0.0, 0
    for group in _groups(errors):
        rest = np.array([e.rest_um for e in group])
        squares += float(np.mean(np.sum((rest - rest.mean(axis=0)) ** 2, axis=0)))
        freedom += len(rest) - 1
    return math.sqrt(squares / freedom)


def _groups(errors: Sequence[RunError]) -> list[list[RunError]]:
    by_block: dict[str, list[RunError]] = defaultdict(list)
    for error in errors:
        by_block[error.direction].append(error)
    return list(by_block.values())


def _reached(runs: Sequence[Run]) -> dict[str, tuple[float, float]]:
    columns: dict[str, list[Floats]] = defaultdict(list)
    for run in runs:
        for name, values in run.samples.items():
            if values.dtype.kind == "f" and np.isfinite(values).any():
                columns[name].append(values)
    return {n: (float(min(map(np.nanmin, v))), float(max(map(np.nanmax, v)))) for n, v in columns.items()}


def _profile(ways: Mapping[Way, Sequence[RunError]]) -> dict[str, dict[str, list[float]]]:
    def mean(errors: Sequence[RunError]) -> list[float]:
        stacked: Floats = np.array([e.rest_um for e in errors])
        return [float(v) for v in stacked.mean(axis=0)]

    return {way: {g[0].direction: mean(g) for g in _groups(errors)} for way, errors in ways.items()}


def _named(key: _Key) -> str:
    return condition_name(dict(key))
