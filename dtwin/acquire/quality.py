"""What is wrong with the data, said before anyone models it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from dtwin.kinds.registry import kind_named
from dtwin.local_time import is_to_come
from dtwin.schema import Finding, Floats, Run, of_one_way
from dtwin.units import shown_number

# No ball bar, laser or probe resolves less: such readings are in another unit.
_MIN_SPREAD_UM = 0.02
# A machine is no warmer while it is measured; as °F it is what shops have.
_HOTTEST_C = 50.0
# Of the span of places, by which errors that are places may differ from them.
_SAME_PLACES = 0.01
_READINGS = ("deviation_um", "error_um", "error_arcsec", "displacement_um")
# Of a run beside one other, how many readings tell what a display shows twice; and how likely equal ones may be.
_MANY, _CHANCE = 100, 1e-6


def judge_run(run: Run) -> list[Finding]:
    """Return the findings of one run, which has its samples."""
    return [*_too_small(run), *_hot(run), *kind_named(run.meta.kind).judge_run(run)]


def judge_campaign(runs: Sequence[Run]) -> list[Finding]:
    """Return what the runs of one campaign lack as a whole; they may be as ``without_samples`` leaves them."""
    if not runs:
        return []
    told = of_one_way(runs)
    findings = kind_named(runs[0].meta.kind).judge_campaign(told)
    if len(told) < len(runs):
        said = (
            f"{len(runs) - len(told)} of {len(runs)} runs were measured with a correction that the rest did not have: "
            "figures, repeats and twins are of the rest; dtwin evidence compares the two"
        )
        findings.append(Finding("campaign.ways", "info", said, {"runs_1": float(len(runs) - len(told))}))
    to_come = [run.meta.started for run in runs if is_to_come(run.meta.started)]
    if to_come:
        said = (
            f"{len(to_come)} of {len(runs)} runs were measured on days that are to come, as {to_come[0][:10]}: a wrong year, "
            "or a clock that is wrong; as long as it stands, this test is the newest of its machine"
        )
        findings.append(Finding("campaign.to_come", "warning", said, {"runs_1": float(len(to_come))}))
    return findings


def said_together(runs: Sequence[Run]) -> list[Finding]:
    """Return what samples of all runs together say against figures and models: spoilt readings, cycles that slip."""
    return [f for f in judge_campaign(runs) if f.severity != "info" and not f.code.startswith("campaign.")]


def _too_small(run: Run) -> Iterator[Finding]:
    """Yield a finding for errors that hardly spread: millimetres in a column of micrometres.

    Where what was read stands beside them (``read_mm``), errors are of no other unit.
    """
    if "read_mm" in run.samples:
        return
    for name in ("deviation_um", "error_um"):
        spread = float(np.std(run.samples[name])) if name in run.samples else np.inf
        if 0.0 < spread < _MIN_SPREAD_UM:
            yield Finding(
                "reading.too_small",
                "error",
                f"{name} spreads by {shown_number(spread, 2)} µm RMS, less than any instrument resolves: are these millimetres?",
                {"spread_um": spread},
            )


def _hot(run: Run) -> Iterator[Finding]:
    """Yield a finding for a temperature that is one of a shop in another unit."""
    stated = run.meta.covariates.get("temperature_c", 0.0)
    if stated > _HOTTEST_C:
        text = f"a machine at {stated:z.1f} °C: as °F that is {(stated - 32.0) / 1.8:z.1f} °C; U and effects of heat count with what is stated"
        yield Finding("run.temperature", "warning", text, {"temperature_c": stated})


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


def judge_pasted(runs: Sequence[Run]) -> dict[str, Finding]:
    """Return a finding for every run whose readings are those of an earlier one of its file, though cycle, direction or clock differ.

    A coarse display shows a sound machine some readings twice: how many, other runs of the file tell, or neighbouring readings.
    """
    files: dict[str, list[tuple[str, Floats]]] = {}
    for run in runs:
        read = [(run.meta.run_id, run.samples[name]) for name in _READINGS if name in run.samples]
        files.setdefault(run.source, []).extend(read)
    findings = {}
    for of_file in files.values():
        first: dict[bytes, str] = {}
        for name, read_um in of_file:
            other = first.setdefault(min(read_um.tobytes(), read_um[::-1].tobytes()), name)
            if other != name and _by_chance(read_um, [of_other for _, of_other in of_file]) < _CHANCE:
                said = (
                    f"the readings are those of run {other} to the last digit, in another cycle, direction or column: "
                    "one was copied over the other, and what they differ by is not known"
                )
                findings[name] = Finding("run.copy", "error", said)
    return findings


def _by_chance(read_um: Floats, others_um: Sequence[Floats]) -> float:
    """Return how likely it is that all readings (n,) of a run are equal to those of another one."""
    alike = [other for other in others_um if other.size == read_um.size]
    shares = [float(max(np.mean(read_um == other), np.mean(read_um == other[::-1]))) for other in alike]
    beside = float(np.mean(read_um[1:] == read_um[:-1])) if read_um.size >= _MANY else 1.0
    share = max((share for share in shares if share < 1.0), default=beside)
    return max(share, 1.0 / max(read_um.size, 1)) ** read_um.size


def judge_places(error: Floats, place: Floats, name: str, code: str) -> list[Finding]:
    """Return that the errors of a column are the places themselves, as where actual positions stand under a head of errors.

    ``error``, ``place``: in the units of their columns, which are not the same.
    """
    span = float(np.ptp(place))
    if span == 0.0 or float(np.ptp(error - place)) > _SAME_PLACES * span:
        return []
    text = f"{name} rises by {np.ptp(error):z.6g} as the position does: actual positions in place of errors"
    return [Finding(code, "error", text)]


def judge_flagged(run: Run) -> Iterator[Finding]:
    """Say how many placements a rule has flagged; the rows stay, figures leave them out."""
    flags = run.samples.get("flag_1")
    count = int(np.count_nonzero(flags)) if flags is not None else 0
    if not count:
        return
    yield Finding(
        "placement.flagged",
        "info",
        f"{count} of {run.n_samples} placements were flagged by a rule: they are left out of "
        "every figure, not replaced",
        {"placements_1": float(count)},
    )


def without_samples(run: Run, columns: Sequence[str] = ()) -> Run:
    """Return what ``judge_campaign`` needs of a run, and further columns."""
    needed = {*kind_named(run.meta.kind).campaign_columns, *columns}
    kept = {k: v for k, v in run.samples.items() if any(fnmatchcase(k, pattern) for pattern in needed)}
    return replace(run, samples=kept, signals=())


def judge_clock(run: Run, pauses: NDArray[np.bool_] | None = None) -> Iterator[Finding]:
    """Yield what is wrong with the times of the samples.

    ``pauses``, (samples - 1,): between which samples the machine did something else, as turn round: a gap there is no lost sample.
    """
    t_s = run.samples.get("t_s", np.empty(0))
    gaps = np.diff(t_s)
    if not gaps.size:
        return
    typical = float(np.median(gaps))
    back = np.flatnonzero(gaps <= 0)
    if back.size:
        yield Finding(
            "clock.backwards",
            "error",
            f"the clock runs backwards or stands still at sample {back[0] + 1}",
            {"sample_1": float(back[0] + 1)},
        )
        return
    steady = np.ones(gaps.size, dtype=bool) if pauses is None else ~pauses
    holes = np.flatnonzero((gaps > 1.5 * typical) & steady)
    if holes.size:
        lost = float(np.sum(gaps[holes] / typical - 1.0))
        yield Finding(
            "clock.dropout",
            "warning",
            f"{holes.size} gap(s) in the clock, about {lost:z.0f} samples lost, the first at {t_s[holes[0]]:z.3f} s",
            {"gaps_1": float(holes.size), "lost_1": lost},
        )
