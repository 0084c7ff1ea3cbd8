"""What is wrong with the data, said before anyone models it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from dtwin.kinds.registry import kind_named
from dtwin.schema import Finding, Run, of_one_way

# No ball bar, laser or probe resolves less: such readings are in another unit.
_MIN_SPREAD_UM = 0.02


def judge_run(run: Run) -> list[Finding]:
    """Return the findings of one run, which has its samples."""
    return [*_too_small(run), *kind_named(run.meta.kind).judge_run(run)]


def judge_campaign(runs: Sequence[Run]) -> list[Finding]:
    """Return what the runs of one campaign lack as a whole; they may be as ``without_samples`` leaves them."""
    if not runs:
        return []
    told = of_one_way(runs)
    found = kind_named(runs[0].meta.kind).judge_campaign(told)
    if len(told) < len(runs):
        said = (
            f"{len(runs) - len(told)} of {len(runs)} runs were measured with a correction that the rest did not have: "
            "figures, repeats and twins are of the rest; dtwin evidence compares the two"
        )
        found.append(Finding("campaign.ways", "info", said, {"runs_1": float(len(runs) - len(told))}))
    return found


def said_together(runs: Sequence[Run]) -> list[Finding]:
    """Return what samples of all runs together say against figures and models: spoilt readings, cycles that slip."""
    return [f for f in judge_campaign(runs) if f.severity != "info" and not f.code.startswith("campaign.")]


def _too_small(run: Run) -> list[Finding]:
    """Return a finding for errors that hardly spread: millimetres in a column of micrometres.

    Where what was read stands beside them (``read_mm``), errors are of no other unit.
    """
    findings: list[Finding] = []
    if "read_mm" in run.samples:
        return findings
    for name in ("deviation_um", "error_um"):
        spread = float(np.std(run.samples[name])) if name in run.samples else np.inf
        if 0.0 < spread < _MIN_SPREAD_UM:
            findings.append(
                Finding(
                    "reading.too_small",
                    "error",
                    f"{name} spreads by {spread:.2g} µm RMS, less than any instrument resolves: are these millimetres?",
                    {"spread_um": spread},
                )
            )
    return findings


def judge_copies(samples_sha256: Mapping[str, str]) -> dict[str, Finding]:
    """Return a finding for every run that holds the samples of an earlier one; hashes are in the order of the runs."""
    first: dict[str, str] = {}
    findings = {}
    for name, digest in samples_sha256.items():
        other = first.setdefault(digest, name)
        if other != name:
            findings[name] = Finding(
                "run.copy",
                "error",
                f"the samples are those of run {other} to the last digit: a copy is no repeat, and "
                "would say that there is no noise",
            )
    return findings


def judge_flagged(run: Run) -> list[Finding]:
    """Say how many placements a rule has flagged; the rows stay, figures leave them out."""
    flags = run.samples.get("flag_1")
    count = int(np.count_nonzero(flags)) if flags is not None else 0
    if not count:
        return []
    return [
        Finding(
            "placement.flagged",
            "info",
            f"{count} of {run.n_samples} placements were flagged by a rule: they are left out of "
            "every figure, not replaced",
            {"placements_1": float(count)},
        )
    ]


def without_samples(run: Run, columns: Sequence[str] = ()) -> Run:
    """Return what ``judge_campaign`` needs of a run, and further columns."""
    needed = {*kind_named(run.meta.kind).campaign_columns, *columns}
    kept = {k: v for k, v in run.samples.items() if any(fnmatchcase(k, pattern) for pattern in needed)}
    return replace(run, samples=kept, signals=())


def judge_clock(run: Run) -> list[Finding]:
    """Return what is wrong with the times of the samples."""
    t_s = run.samples.get("t_s", np.empty(0))
    gaps = np.diff(t_s)
    if not gaps.size:
        return []
    typical = float(np.median(gaps))
    back = np.flatnonzero(gaps <= 0)
    if back.size:
        return [
            Finding(
                "clock.backwards",
                "error",
                f"the clock runs backwards or stands still at sample {back[0] + 1}",
                {"sample_1": float(back[0] + 1)},
            )
        ]
    holes = np.flatnonzero(gaps > 1.5 * typical)
    if holes.size:
        lost = float(np.sum(gaps[holes] / typical - 1.0))
        return [
            Finding(
                "clock.dropout",
                "warning",
                f"{holes.size} gap(s) in the clock, about {lost:z.0f} samples lost, "
                f"the first at {t_s[holes[0]]:z.3f} s",
                {"gaps_1": float(holes.size), "lost_1": lost},
            )
        ]
    return []
