"""What ISO 230-2 asks of a test of a rotary axis, whether a turn closes, what comes once and twice a turn, and what makes its figures uncertain."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from dtwin.kinds.rotary._scale import ANGLES
from dtwin.physics.linear import linear_figures
from dtwin.positioning.check import judge_positioning_campaign, tests_by_axis
from dtwin.positioning.matrix import TARGET_MM, LinearTest
from dtwin.positioning.positioning_sheet import evaluated_tests
from dtwin.progress import Progress, silent
from dtwin.report.text import counted
from dtwin.report.uncertainty import Circumstances, Contribution
from dtwin.schema import Finding, Run
from dtwin.statistics import f_quantile, rms, t_quantile

_FEWEST = ((90.0, 3), (180.0, 5), (float("inf"), 8))
"""Targets that a travel up to so many degrees asks for."""
_RUNS = 5
_READING_ARCSEC = 1.0
_SHOWN = {"A": "accuracy", "R": "repeatability", "E": "systematic", "B": "reversal", "M": "mean_deviation"}


def _asked(test: LinearTest) -> list[str]:
    """Return what the standard asks for and the test has not."""
    targets, runs = test.forward_um.shape
    fewest = next(n for most, n in _FEWEST if float(np.ptp(test.position_mm)) <= most + TARGET_MM)
    said = []
    if targets < fewest:
        said.append(f"ISO 230-2 asks for {fewest} targets on this travel, these are {targets}")
    if runs < _RUNS:
        said.append(f"ISO 230-2 asks for five runs, {'this is one' if runs == 1 else f'these are {runs}'}")
    return said


def noted(test: LinearTest) -> list[str]:
    """Return what is to be noted of a test: what it lacks, and how turns close."""
    return [*_asked(test), *(finding.message for finding in _closures(test))]


def _closures(test: LinearTest) -> list[Finding]:
    """Return by how much the readings of one place differ that was a target at two angles, a turn apart: of several the place with the most; empty of none."""
    at = np.round(test.position_mm / TARGET_MM).astype(int)
    turn, runs = round(ANGLES.turn / TARGET_MM), test.forward_um.shape[1]
    low = np.flatnonzero(np.isin(at + turn, at))
    high = np.flatnonzero(np.isin(at - turn, at))
    if not low.size:
        return []
    apart = np.stack([readings[high] - readings[low] for readings in (test.forward_um, test.reverse_um)])
    off = apart.mean(axis=2)
    most = int(np.argmax(np.abs(off).max(axis=0)))
    half = np.full(2, np.inf)
    if runs > 1:
        half = t_quantile(0.975, runs - 1) * apart[:, most].std(axis=1, ddof=1) / np.sqrt(runs)
    # Two directions of few runs each: by chance alone one in a hundred turns would seem open.
    stays_open = bool((np.abs(off[:, most]) > np.maximum(2.0 * half, _READING_ARCSEC)).any())
    ways = dict(zip(test.ways, zip(off[:, most], half, strict=True), strict=True)).items()
    told = ", ".join(f"{way} {by:+z.2f}″" + (f" ± {u:z.2f}″ (95 %)" if runs > 1 else "") for way, (by, u) in ways)
    places = f"{test.position_mm[high[most]]:g}° is the place of {test.position_mm[low[most]]:g}°"
    why = "; the turn does not close: the instrument, its mounting or the axis moved in between" if stays_open else ""
    said = f"{places}, and its readings differ from those by {told}{why}"
    largest = float(max(off[:, most], key=abs))
    return [Finding("rotary.closure", "warning" if stays_open else "info", said, {"closure_arcsec": largest})]


def contributions(under: Circumstances, symbol: str, test: LinearTest) -> tuple[Contribution, ...]:
    """Return what makes a figure uncertain: the instrument; an angle does not grow with temperature."""
    return (under.reading(_READING_ARCSEC, ANGLES.figure),)


def judge_campaign(runs: Sequence[Run]) -> list[Finding]:
    """Return what the runs of a campaign say together, what the standard asks for besides, and how turns close."""
    findings = judge_positioning_campaign(runs, ANGLES)
    whole = [run for run in runs if run.samples]
    for test in tests_by_axis(whole, ANGLES) if whole else []:
        findings += [Finding("rotary.asked", "warning", said) for said in _asked(test)]
        findings += _closures(test)
    return findings


def positioning_result(runs: Sequence[Run], progress: Progress = silent) -> list[dict[str, Any]]:
    """Return the figures of each axis that was approached from both sides, JSON-ready, in seconds of arc."""
    out = []
    for test in evaluated_tests(runs, ANGLES):
        if not test.position_mm.size:
            continue
        ends = {"from_deg": float(test.position_mm[0]), "to_deg": float(test.position_mm[-1])}
        told = {"axis": test.axis, "runs": test.forward_um.shape[1], "targets": len(test.position_mm), **ends}
        if told["runs"] > 1:
            figures = asdict(linear_figures(test.forward_um, test.reverse_um))
            told["iso_230_2"] = {f"{name.removesuffix('_um')}_arcsec": value for name, value in figures.items()}
        out.append(told | _waves(test))
    return out


def positioning_lines(result: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines that a terminal shows of :func:`positioning_result`."""
    yield from [] if result else ["no target was read in every run from both sides: no figures of both directions"]
    for told in result:
        yield (
            f"axis {told['axis']}: {counted(told['runs'], 'run')}, {counted(told['targets'], 'target')} "
            f"from {told['from_deg']:g}° to {told['to_deg']:g}°"
        )
        figures = told.get("iso_230_2", {})
        if figures:
            yield "  " + ", ".join(f"{symbol} {figures[f'{name}_arcsec']:z.2f}″" for symbol, name in _SHOWN.items())
        for wave in told.get("waves", ()):
            often, size, half = wave["often"], wave["amplitude_arcsec"], wave["k95_arcsec"]
            if (chance := wave["chance_arcsec"]) is not None and size <= chance:
                yield f"  {often} a turn no more than what runs differ by, {chance:z.2f}″"
                continue
            more = "" if half is None else f" ± {half:z.2f}″"
            yield f"  {often} a turn {size:z.2f}″{more}, largest at {wave['largest_at_deg']:z.0f}°: {wave['may_be']}"
        if (drift := told.get("drift_arcsec")) is not None:
            yield f"  goes on by {drift:z.2f}″ over a turn, which is no part of these"
        elif "waves" in told:
            yield "  no place was read again a turn later: a drift over the turn would look like these"
        if "waves" in told:
            yield f"  without these {told['left_rms_arcsec']:z.2f}″ RMS of the mean of both directions are left"


_FEWEST_WAVES = 8
"""Places of a turn: five numbers are fitted to them."""
_UNEVEN = 1.5
"""Times the mean step that a gap may have: a turn that is measured in part has no waves of its own."""
_WAVES = (
    (1, "once", "graduation or encoder off centre, or the instrument"),
    (2, "twice", "graduation elliptic, or its two reading heads unlike"),
)
"""How many times a turn, in words, and what it may be."""
_CHANCE = 0.05
"""How often one of the waves is told where there is none."""


def _waves(test: LinearTest) -> dict[str, Any]:
    """Return the waves of a whole turn, JSON-ready, in seconds of arc; empty where the targets are no whole turn or too few.

    They are fitted by least squares to the mean of both directions, run by run; ``k95_arcsec`` is what covers 95 % of
    the amplitude's scatter by what runs differ by, None of one run; ``chance_arcsec`` what an amplitude must exceed to be no chance,
    which is more, for it has two parts. At n even steps a wave of n - 1 times a turn looks like one
    of once: what a worm or a gear does is told by targets within one of its teeth alone.
    ``drift_arcsec``: how far the error goes on over a turn, where a place is measured again a turn later; it is no part of the
    waves. Where none is, a drift looks like them.
    """
    angle = np.radians(test.position_mm)
    place = np.unique(np.round(np.mod(test.position_mm, 360.0), 3))
    gaps = np.diff(place, append=place[:1] + 360.0)
    if place.size < _FEWEST_WAVES or gaps.max() > _UNEVEN * 360.0 / place.size:
        return {}
    columns = [np.ones_like(angle), *(of(times * angle) for times, _, _ in _WAVES for of in (np.cos, np.sin))]
    again = place.size < np.unique(np.round(test.position_mm, 3)).size
    if again:
        columns.append(angle / (2.0 * np.pi))
    design = np.stack(columns, axis=1)
    middle = 0.5 * (test.forward_um + test.reverse_um)
    amplitudes, *_ = np.linalg.lstsq(design, middle, rcond=None)
    runs = middle.shape[1]
    told = []
    for number, (times, often, may_be) in enumerate(_WAVES):
        both = amplitudes[1 + 2 * number : 3 + 2 * number]
        cosine, sine = both.mean(axis=1)
        half = chance = None
        if runs > 1:
            deviation = np.sqrt(np.mean(both.var(axis=1, ddof=1)))
            dof = 2.0 * (runs - 1)
            half = float(t_quantile(0.975, dof) * deviation / np.sqrt(runs))
            chance = float(np.sqrt(2.0 * f_quantile(_CHANCE / len(_WAVES), (2.0, dof)) / runs) * deviation)
        at = float(np.degrees(np.arctan2(sine, cosine)) / times % (360.0 / times))
        told.append(
            {
                "times_a_turn": times,
                "often": often,
                "amplitude_arcsec": float(np.hypot(cosine, sine)),
                "k95_arcsec": half,
                "chance_arcsec": chance,
                "largest_at_deg": at,
                "may_be": may_be,
            }
        )
    left = middle.mean(axis=1) - design @ amplitudes.mean(axis=1)
    drift = {"drift_arcsec": float(amplitudes[-1].mean())} if again else {}
    return {"waves": told, **drift, "left_rms_arcsec": rms(left)}
