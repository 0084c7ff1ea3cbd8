"""Sections of a report: recording, campaign, candidates, evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.motion_quality import aligned_angle_deg, motion_of
from dtwin.physics.circular import fit_circle, residual_um
from dtwin.report.html import Section, Table
from dtwin.report.model_plots import comparison_figure, evidence_figure, front_figure
from dtwin.report.plots import error_figure, magnification_for, polar_figure
from dtwin.report.sheet import overview
from dtwin.report.text import circle_figure, decimals
from dtwin.schema import Floats, Run
from dtwin.train.results import Candidate, TrainingReport, condition_name, r2_text, without_correction

_NOT_COMPARABLE = (
    "Reductions of the mean error with the mounting in it are not comparable: they keep the "
    "eccentricity of the set-up, which a constant offset on X and Y removes without touching any "
    "error of the machine; here centre and radius of every set-up are taken out of both sides."
)


def recording_section(path: Path, result: Mapping[str, Any]) -> Section:
    """Return the section about a ball-bar file, of what ``check_source`` returned for it."""
    runs = read_b5r(path).runs
    head = ["", "by the file's indices", "vendor's file says", "aligned by the stops"]
    tables, findings = [], []
    for run in result["runs"]:
        rows = []
        for title, key, vendor in _FIGURES:
            aligned = run.get("aligned_by_stops") or {}
            rows.append(
                [
                    f"{run['run']}: {title}",
                    circle_figure(title, run["by_file_indices"].get(key)),
                    circle_figure(title, run["vendor"].get(vendor)),
                    circle_figure(title, aligned.get(key)),
                ]
            )
        tables.append(Table(head, rows))
        findings += [(f["severity"], f"{run['run']}: {f['message']}") for f in run["findings"]]
        lines = ", ".join(
            f"{line['frequency_hz']:z.2f} Hz ({line['amplitude_um']:z.1f} µm)" for line in run["spectrum"]["lines"]
        )
        findings.append(("info", f"{run['run']}: strongest lines {lines}"))
    by_file = {r.meta.run_id: _centred(r, r.samples["angle_deg"], r.marked) for r in runs}
    aligned_curves = {}
    for run_ in runs:
        motion = motion_of(run_)
        angle = aligned_angle_deg(run_, motion)
        if angle is not None and len(motion.stops) >= 3:
            aligned_curves[run_.meta.run_id] = _centred(run_, angle, slice(motion.stops[0], motion.stops[2]))
    radius = float(runs[0].meta.radius_mm or 100.0)
    drawn = [*by_file.values(), *aligned_curves.values()]
    # One magnification, so that the two pictures can be compared.
    scale = magnification_for(max(float(np.max(np.abs(d))) for _, d in drawn), radius)
    return Section(
        f"The recording {path.name}",
        [f"Machine as stated: {result['machine']}."],
        findings,
        tables,
        [
            polar_figure(by_file, radius, title="As the file's indices say", magnification=scale),
            polar_figure(aligned_curves, radius, title="Aligned by the stops", magnification=scale),
        ],
    )


def sheet_section(sheet: Mapping[str, Any], of: str = "") -> Section:
    """Return a test sheet, as its ``as_dict`` gives it: a line for each condition. ``of``: the campaign, where there are several."""
    title = f"{sheet['standard']}: {sheet['verdict'] or 'no tolerance is stated'}"
    return Section(f"{of}: {title}" if of else title, [sheet["basis"], *sheet["notes"]], [], [Table(*overview(sheet))])


def training_section(report: TrainingReport) -> Section:
    """Return the section about candidates: comparison, front, equation."""
    proposed = report.candidate(report.proposed)
    points = [
        {
            "name": c.name,
            "rms_um": c.held_out.rms_um,
            "p50_us": c.latency.p50_us if c.latency else None,
            "promotable": c.promotable,
        }
        for c in report.candidates
    ]
    floor = report.noise_floor_um, report.noise_floor_dof
    figures = [comparison_figure(points, *floor)]
    if proposed.front and "terms" in proposed.front[0]:
        figures.append(front_figure(proposed.front, *floor))
    return Section(
        "Candidates",
        [
            f"Campaign {report.campaign} on {report.machine}: {report.n_runs} runs, "
            f"{report.n_rows} rows. Error without a model {report.rms_before_um:z.1f} µm RMS"
            + (" after centre and radius of each set-up" if "feed_mm_min" in proposed.scores else "")
            + f"; noise floor {report.noise_floor_text}: {report.floor_is}.",
            *report.told,
            "Every error is on what was left out as a whole: one "
            + ", or one ".join(_LEFT_OUT[group] for group in proposed.scores)
            + " at a time.",
        ],
        [("info", f"{proposed.name}: {finding}") for finding in proposed.findings],
        [Table(*comparison_table(report.candidates))],
        figures,
        [proposed.equation],
    )


def comparison_table(candidates: Sequence[Candidate]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of the comparison of candidates, in their order."""
    groups = [_LEFT_OUT[group] for group in candidates[0].scores]
    head = [
        "candidate",
        *(f"{what}, {group} out" for group in groups for what in ("R²", "µm")),
        "p50 µs",
        "p99 µs",
        "complexity",
        "promotable",
    ]
    zero = without_correction(candidates)
    rows = []
    for c in candidates:
        scores = []
        for group, s in c.scores.items():
            zero_um = zero.scores[group].rms_um if zero else None
            scores += [r2_text(s.r2, s.rms_um, zero_um), _um(s.rms_um)]
        rows.append(
            [
                c.name,
                *scores,
                f"{c.latency.p50_us:z.2f}" if c.latency else "-",
                f"{c.latency.p99_us:z.2f}" if c.latency else "-",
                str(c.complexity),
                "yes" if c.promotable else "no",
            ]
        )
    return head, rows


def evidence_section(evidence: Mapping[str, Any], profiles: Mapping[str, Any]) -> Section:
    """Return the section about runs with a correction and runs without it.

    ``evidence``: as ``Evidence.as_dict`` gives it.
    ``profiles``: mean error along the path by condition, way and direction; drawn for circles.
    """
    figures = [evidence_figure(evidence)]
    circles = [c for c in evidence["conditions"] if "radius_mm" in c]
    for condition in circles[:4]:
        name, ways = condition_name(condition), profiles[condition_name(condition)]
        direction = "CCW" if "CCW" in ways["without"] else "CW"
        arc = 360.0 if condition["plane"] == "XY" else 180.0
        curves: dict[str, tuple[Floats, Floats]] = {}
        for way, title in (("without", "uncompensated"), ("with", "compensated")):
            values = np.asarray(ways[way][direction])
            curves[title] = ((np.arange(values.size) + 0.5) / values.size * arc, values)
        figures.append(
            polar_figure(curves, condition["radius_mm"], title=f"{name} {direction}")
            if condition["plane"] == "XY"
            else error_figure(curves, title=f"{name} {direction}")
        )
    told = [*evidence["told"]]
    if circles:
        told.append(_NOT_COMPARABLE)
    return Section(
        "Compensated against uncompensated",
        [f"{evidence['kind'].capitalize()} evidence on the {evidence['clock']}.", *_of_the_oracle(evidence), *told],
        [],
        [Table(*evidence_table(evidence))],
        figures,
    )


def _of_the_oracle(evidence: Mapping[str, Any]) -> list[str]:
    if all(c["oracle_um"] is None for c in evidence["conditions"]):
        return []
    delays = ", ".join(f"{k} {1000 * v:z.0f} ms" for k, v in evidence["delays"].items())
    told = [
        f"Modelled delays: {delays}. The oracle is made with the truth known, under the same "
        "clamp, slew limit and delay."
    ]
    shares = {
        "feeds that were never trained": evidence["share_of_oracle_unseen_feeds"],
        "trained feeds": evidence["share_of_oracle_trained_feeds"],
    }
    known = [f"{100 * share:z.0f} % on {what}" for what, share in shares.items() if share == share]
    return [*told, f"Share of the oracle's reduction: {', '.join(known)}."] if known else told


def evidence_advice(evidence: Mapping[str, Any], version: str, machine: str) -> str:
    """Return what to do after evidence: to promote, or not where it did harm."""
    if worse := [condition_name(c) for c in evidence["conditions"] if c["worse"]]:
        return f"evidence against version {version}, which dtwin promote will refuse: worse at {', '.join(worse)}"
    return f"next: dtwin promote {version} --machine {machine}"


def evidence_table(evidence: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of before, after, oracle and floor per condition."""
    head = [
        "condition",
        "trained",
        "before µm",
        "after µm",
        "reduction",
        "oracle µm",
        "floor µm",
        "runs",
        "outside box",
        "worse",
    ]
    rows = []
    for c in evidence["conditions"]:
        rows.append(
            [
                condition_name(c),
                {True: "yes", False: "no"}.get(c["trained"], "-"),
                _with_ci(c["before_um"], c["before_ci_um"]),
                _with_ci(c["after_um"], c["after_ci_um"]),
                f"{100 * c['reduction']:z.0f} %",
                "-" if c["oracle_um"] is None else _um(c["oracle_um"]),
                _um(c["floor_um"]),
                f"{c['n_without']} + {c['n_with']}",
                f"{100 * c['acted'].get('outside_box', 0.0):z.1f} %" if c["acted"] else "-",
                "yes" if c["worse"] else "no",
            ]
        )
    return head, rows


def _with_ci(value: float, half: float) -> str:
    """Return an error with its interval, to two digits of that."""
    digits = decimals(half)
    return f"{value:z.{digits}f} ± {half:z.{digits}f}"


def _um(value: float) -> str:
    """Return an error in um; of tones, thousandths count."""
    return f"{value:z.1f}" if abs(value) >= 1.0 or value == 0.0 else f"{value:z.3f}"


_LEFT_OUT = {
    "feed_mm_min": "feed",
    "radius_mm": "radius",
    "frequency_hz": "frequency",
    "amplitude_um": "amplitude",
    "run": "run",
    "hours": "span of hours",
    "stretches": "stretch of time",
}
_FIGURES = (
    ("centre along first axis, µm", "centre_a_um", "centre_a_um"),
    ("centre along second axis, µm", "centre_b_um", "centre_b_um"),
    ("least-squares radius, mm", "radius_mm", "best_radius_mm"),
    ("circular deviation, µm", "circular_deviation_um", "circularity_um"),
    ("RMS about the circle, µm", "rms_um", ""),
    ("mean feed, mm/min", "feed_mm_min", "feed_mm_min"),
)


def _centred(run: Run, angle: Floats, part: slice) -> tuple[Floats, Floats]:
    radius = float(run.meta.radius_mm or 100.0)
    deviation = run.samples["deviation_um"][part]
    circle = fit_circle(angle[part], deviation, radius)
    return angle[part], residual_um(angle[part], deviation, radius, circle)
