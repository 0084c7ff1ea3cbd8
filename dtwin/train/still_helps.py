"""Whether a champion still helps: runs with and without it, later, interleaved and randomised."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats
from dtwin.statistics import t_quantile
from dtwin.train.champion_error import um_text
from dtwin.train.closed_loop import Evidence
from dtwin.train.results import condition_name

_Verdict = Literal["helps", "unclear", "worse"]
_LEVEL = 0.05
_FEWEST_PAIRS = 3


@dataclass(frozen=True)
class CheckedRun:
    """One circle, with or without the correction.

    ``block``: pass over all conditions; the two ways of one block make a pair.
    ``compensated``: whether the champion was served.
    """

    plane: str
    radius_mm: float
    feed_mm_min: float
    direction: str
    block: int
    compensated: bool
    rms_um: float

    @property
    def condition(self) -> tuple[str, float, float]:
        """Plane, radius and feed."""
        return self.plane, self.radius_mm, self.feed_mm_min


@dataclass(frozen=True)
class _ConditionCheck:
    """What pairs of one condition say.

    ``name``: such as ``YZ R150 F5000``; ``all`` over every condition.
    ``before_um``, ``after_um``: mean error without and with the correction.
    ``growth_um``, ``half_width_um``: mean difference of the pairs, and half its confidence interval; all intervals of a
    check hold together with 95 % (Bonferroni).
    """

    name: str
    before_um: float
    after_um: float
    growth_um: float
    half_width_um: float
    pairs: int

    @property
    def worse(self) -> bool:
        """Whether the error is larger with the correction, beyond the interval."""
        return self.growth_um > self.half_width_um

    @property
    def better(self) -> bool:
        """Whether it is smaller, beyond the interval."""
        return self.growth_um < -self.half_width_um


@dataclass(frozen=True)
class Recheck:
    """The verdict on a champion.

    ``verdict``: ``worse`` when any condition, or all together, are worse beyond their interval.
    ``conditions``: every condition, and ``all`` last.
    """

    verdict: _Verdict
    reason: str
    conditions: tuple[_ConditionCheck, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        rows = [asdict(c) | {"worse": c.worse, "better": c.better} for c in self.conditions]
        return {"verdict": self.verdict, "reason": self.reason, "conditions": rows}


def judge(runs: Sequence[CheckedRun]) -> Recheck:
    """Say whether a correction still helps, the pair of runs as unit.

    ``runs``: pairs: with and without, of the same condition, direction and block.
    Raises ``InputError`` when runs have no partner, or a condition has fewer than three pairs.
    """
    pairs = _pairs(runs)
    level = _LEVEL / (len(pairs) + 1)
    checks = [_check(_named(c), np.array(pairs_of), level) for c, pairs_of in pairs.items()]
    checks.append(_together([np.array(pairs_of) for pairs_of in pairs.values()], level))
    return _verdict(checks)


def _verdict(checks: Sequence[_ConditionCheck]) -> Recheck:
    worse = [c for c in checks if c.worse]
    if worse:
        told = "; ".join(_told(c) for c in worse)
        return Recheck("worse", f"the error is larger with the correction: {told}", tuple(checks))
    if checks[-1].better:
        return Recheck("helps", f"the correction still helps: {_told(checks[-1])}", tuple(checks))
    return Recheck("unclear", f"neither helps nor harms: {_told(checks[-1])}", tuple(checks))


def judge_evidence(evidence: Evidence) -> Recheck:
    """Say whether a correction still helps, from evidence of runs of the lake with and without it."""
    rows = [
        _ConditionCheck(
            condition_name(c),
            c["before_um"],
            c["after_um"],
            c["after_um"] - c["before_um"],
            # Both ways of one cycle, where nothing was served, are a pair.
            c.get("growth_ci_um", math.hypot(c["before_ci_um"], c["after_ci_um"])),
            c["n_with"],
        )
        for c in evidence.conditions
    ]
    means = [float(np.mean([getattr(r, f) for r in rows])) for f in ("before_um", "after_um")]
    # What is of the same runs is no second sample of them: half widths add, and the pairs are those of one.
    of_runs: dict[Any, list[_ConditionCheck]] = defaultdict(list)
    for number, (row, told) in enumerate(zip(rows, evidence.conditions, strict=True)):
        of_runs[tuple(told["runs_with"]) if "runs_with" in told else number].append(row)
    halves = [sum(row.half_width_um for row in group) for group in of_runs.values()]
    half, pairs = math.hypot(*halves) / len(rows), sum(group[0].pairs for group in of_runs.values())
    every = _ConditionCheck("all", means[0], means[1], means[1] - means[0], half, pairs)
    return _verdict([*rows, every])


def _pairs(runs: Sequence[CheckedRun]) -> dict[tuple[str, float, float], list[tuple[float, float]]]:
    ways: dict[Any, dict[bool, list[float]]] = defaultdict(lambda: {False: [], True: []})
    for run in runs:
        ways[run.condition, run.direction, run.block][run.compensated].append(run.rms_um)
    pairs: dict[tuple[str, float, float], list[tuple[float, float]]] = defaultdict(list)
    for (condition, direction, block), by_way in ways.items():
        if len(by_way[False]) != 1 or len(by_way[True]) != 1:
            raise InputError(
                "every block needs each circle once with and once without the correction",
                code="recheck.pairs",
                got=f"{_named(condition)} {direction}, block {block}: {len(by_way[True])} with, "
                f"{len(by_way[False])} without",
            )
        pairs[condition].append((by_way[False][0], by_way[True][0]))
    for condition, found_pairs in pairs.items():
        if len(found_pairs) < _FEWEST_PAIRS:
            raise InputError(
                "too few pairs to know an interval",
                code="recheck.few",
                got=f"{_named(condition)}: {len(found_pairs)}",
                allowed=f"{_FEWEST_PAIRS} or more",
            )
    return pairs


def _check(name: str, pairs: Floats, level: float) -> _ConditionCheck:
    growth = pairs[:, 1] - pairs[:, 0]
    n = len(growth)
    wide = t_quantile(1.0 - level / 2.0, n - 1) * float(np.std(growth, ddof=1))
    before, after = pairs.mean(axis=0).tolist()
    return _ConditionCheck(name, before, after, float(growth.mean()), wide / math.sqrt(n), n)


def _together(groups: Sequence[Floats], level: float) -> _ConditionCheck:
    """Return the mean over all pairs, its interval from the spread inside the conditions."""
    every = np.concatenate(groups)
    growths = [g[:, 1] - g[:, 0] for g in groups]
    n, freedom = len(every), len(every) - len(groups)
    spread = math.sqrt(sum(float(np.sum((g - g.mean()) ** 2)) for g in growths) / freedom)
    wide = t_quantile(1.0 - level / 2.0, freedom) * spread / math.sqrt(n)
    before, after = every.mean(axis=0).tolist()
    return _ConditionCheck("all", before, after, after - before, wide, n)


def _named(condition: tuple[str, float, float]) -> str:
    plane, radius_mm, feed_mm_min = condition
    return f"{plane} R{radius_mm:g} F{feed_mm_min:g}"


def _told(check: _ConditionCheck) -> str:
    digits = 1 if check.before_um >= 1.0 else 3
    return (
        f"{check.name} {um_text(check.before_um)} -> {um_text(check.after_um)} µm, by {check.growth_um:+z.{digits}f} "
        f"± {um_text(check.half_width_um)} µm over {check.pairs} pairs"
    )
