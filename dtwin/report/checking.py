"""``dtwin check``: what a recording says, and what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from dtwin.acquire.amending import amendment_findings
from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_campaign, judge_copies, judge_pasted, judge_run, said_together, without_samples
from dtwin.errors import InputError
from dtwin.kinds.kind import Kind
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import columns_sha256
from dtwin.lake.store import Lake, RejectedRows
from dtwin.physics.circular import bidirectional_figures
from dtwin.progress import Progress, silent
from dtwin.report.sheet import judged, sheet_lines
from dtwin.report.text import circle_figure, counted, micrometres, table
from dtwin.report.uncertainty import Circumstances, Variation
from dtwin.schema import Campaign, Finding, Run, of_one_way
from dtwin.tolerances import Limits, limits_from

_MAX_DETAILED = 2
"""A file of both directions is told run by run; more runs as a table."""
_MANY_ROWS = 0.1
"""Share of a table that is not used, from which on it is a warning."""
_LISTED_ROWS = 8
_Tolerances = Callable[[str], Mapping[str, Limits]]
_Surroundings = Callable[[str], Variation | None]


def _no_tolerances(machine: str) -> Mapping[str, Limits]:
    """Return no limits."""
    return {}


def _no_surroundings(machine: str) -> Variation | None:
    """Return no variation."""
    return None


def _sheet_of(
    kind: Kind,
    campaign: Campaign,
    runs: Sequence[Run],
    limits: Mapping[str, Limits],
    variation: Variation | None = None,
) -> dict[str, Any]:
    """Return the test sheet of runs with their findings, and what these say together, JSON-ready.

    ``limits``: of the machine; they go before those of the file.
    ``variation``: that of the machine's place.
    """
    written = [t for run in runs if (t := run.meta.covariates.get("temperature_c")) is not None]
    warm = sum(written) / len(written) if written else math.nan
    under = Circumstances(campaign.instrument, warm, variation, f"{campaign.name}: instrument")
    stated = campaign.instrument.get("tolerances", {})
    # Something that is no table of limits is refused as a limit that is none.
    table_of = stated if isinstance(stated, Mapping) else {"FIGURE": str(stated)}
    own = limits_from(table_of, f"{under.where}.tolerances")
    made = kind.sheet(of_one_way(runs), under)
    strange = [symbol for symbol in own if ":" in symbol or (kind.figures and symbol not in kind.figures)]
    if strange:
        raise InputError(
            "a tolerance in a campaign is of a figure of that campaign's own tests",
            code="sheet.tolerance",
            where=f"{under.where}.tolerances",
            got=", ".join(strange)[:60],
            allowed=", ".join(kind.figures) or "SYMBOL",
            hint="KIND:SYMBOL stands in the machine's record",
        )
    limited = {**own, **kind.limits(limits)}
    sheet = judged(made, limited, asked=[symbol for symbol in kind.figures if symbol in limited]).as_dict()
    return sheet | {"findings": [finding.as_dict() for finding in said_together(runs)]}


def check_source(
    path: Path,
    progress: Progress = silent,
    told: Mapping[str, Any] | None = None,
    tolerances: _Tolerances = _no_tolerances,
    surroundings: _Surroundings = _no_surroundings,
) -> dict[str, Any]:
    """Evaluate every run of a file or campaign without storing anything.

    ``path``, ``told``: as for :func:`open_source`.
    ``tolerances``: returns the limits of a machine by symbol.
    ``surroundings``: returns how far readings of a machine move while it stands still, where a test of it tells.
    Returns ``campaign``, ``runs`` (figures by the file's indices and aligned by the stops, vendor's figures, spectrum,
    findings), ``bidirectional`` and ``findings`` of the whole.
    """
    campaign, sources, total = open_source(path, told)
    return _checked(str(path), campaign, sources, total, progress, tolerances, surroundings)


def check_campaign(
    lake: Lake,
    name: str,
    progress: Progress = silent,
    tolerances: _Tolerances = _no_tolerances,
    surroundings: _Surroundings = _no_surroundings,
) -> dict[str, Any]:
    """Evaluate the runs of a campaign in the lake as :func:`check_source` does those of a file."""
    campaign = lake.campaign(name)
    rows = lake.runs(name)
    sources = (([lake.load(row, signals=False)], list[RejectedRows]()) for row in rows)
    result = _checked(f"campaign {name}", campaign, sources, len(rows), progress, tolerances, surroundings)
    told = amendment_findings(lake.runs(name, left_out=True))
    result["findings"] += [finding.as_dict() for finding in told]
    return result


def campaign_sheet(
    lake: Lake, name: str, limits: Mapping[str, Limits], variation: Variation | None = None
) -> dict[str, Any]:
    """Return the test sheet of a campaign in the lake, JSON-ready; its kind must have one."""
    campaign = lake.campaign(name)
    kind = kind_named(campaign.kind)
    kind.require("sheet")
    runs = (lake.load(row, signals=False) for row in lake.runs(name))
    kept = [without_samples(replace(run, findings=tuple(_findings_of(run))), kind.sheet_columns) for run in runs]
    return _sheet_of(kind, campaign, kept, limits, variation)


def _checked(
    source: str,
    campaign: Campaign,
    sources: Iterable[tuple[list[Run], list[RejectedRows]]],
    total: int,
    progress: Progress,
    tolerances: _Tolerances,
    surroundings: _Surroundings,
) -> dict[str, Any]:
    results: list[dict[str, Any]] = []
    pairs: list[dict[str, Any]] = []
    kind = kind_named(campaign.kind)
    light: list[Run] = []
    samples: dict[str, str] = {}
    pasted: dict[str, Finding] = {}
    for done, (runs, rejected) in enumerate(sources, start=1):
        samples |= {run.meta.run_id: columns_sha256(run.samples) for run in runs}
        pasted |= judge_pasted(runs)
        checked = [replace(run, findings=tuple(_findings_of(run))) for run in runs]
        results += map(_run_result, checked)
        pairs += _bidirectional(runs)
        light += [without_samples(run, kind.sheet_columns) for run in checked]
        if rejected:
            rows = [row for part in rejected for row in part.rows]
            results[-1]["rejected_rows"] = len(rows)
            used = max((run.n_samples for run in runs), default=0)
            results[-1]["findings"].append(_rejected(rows, used).as_dict())
        progress(done, total, runs[0].meta.run_id if runs else "")
    copies = pasted | judge_copies(samples)
    for result in results:
        if result["run"] in copies:
            result["findings"].append(copies[result["run"]].as_dict())
    # A copy is no repeat: the sheet has to know before it says what repeats differ by.
    light = [
        replace(run, findings=(*run.findings, copies[run.meta.run_id])) if run.meta.run_id in copies else run
        for run in light
    ]
    sheet = {}
    if kind.offers("sheet"):
        machine = campaign.machine
        sheet = {"sheet": _sheet_of(kind, campaign, light, tolerances(machine), surroundings(machine))}
    return {
        **kind.campaign_figures(of_one_way(light), progress),
        **sheet,
        "source": source,
        "campaign": campaign.name,
        "machine": campaign.machine,
        "kind": campaign.kind,
        "runs": results,
        "bidirectional": pairs,
        "findings": [finding.as_dict() for finding in judge_campaign(light)],
    }


def _rejected(rows: Sequence[Mapping[str, Any]], used: int) -> Finding:
    """Return what is said of rows that are no samples: how many of each reason, and which; a warning where they are many beside the ``used`` ones."""
    numbers: dict[str, list[str]] = {}
    for row in rows:
        numbers.setdefault(row["reason"], []).append(str(row["row"] + 1))
    listed = {
        why: ", ".join(of[:_LISTED_ROWS]) + f" and {len(of) - _LISTED_ROWS} more" * (len(of) > _LISTED_ROWS)
        for why, of in numbers.items()
    }
    shown = [f"{why}: {of}" for why, of in list(listed.items())[:_LISTED_ROWS]]
    more = f"; and {len(listed) - _LISTED_ROWS} more reasons" * (len(listed) > _LISTED_ROWS)
    said = f"rows that are not used: {len(rows)}; {'; '.join(shown)}{more}"
    if len(rows) <= _MANY_ROWS * (len(rows) + used):
        return Finding("rows.rejected", "info", said, {"rows_1": float(len(rows))})
    said += f"; {used} are used"
    if any(why.startswith("no usable number") for why in numbers):
        said += ": a column that was read more seldom than the others belongs into a file of signals of its own, or out of the table"
    return Finding("rows.rejected", "warning", said, {"rows_1": float(len(rows))})


def run_result(run: Run) -> dict[str, Any]:
    """Return figures, spectrum and findings of one run as a JSON-ready mapping."""
    return _run_result(replace(run, findings=tuple(_findings_of(run))))


def _findings_of(run: Run) -> list[Finding]:
    """Return what is wrong with a run; runs of the lake were judged when they came in, too."""
    return list({(f.code, f.message): f for f in [*run.findings, *judge_run(run)]}.values())


def _run_result(run: Run) -> dict[str, Any]:
    findings = run.findings
    result: dict[str, Any] = {
        "run": run.meta.run_id,
        "condition": {
            "plane": run.meta.plane,
            "radius_mm": run.meta.radius_mm,
            "feed_mm_min": run.meta.feed_mm_min,
            "direction": run.meta.direction,
            "setup": run.meta.setup,
            "repeat": run.meta.repeat,
        },
        "samples": run.n_samples,
        "sample_rate_hz": run.meta.sample_rate_hz,
        "vendor": dict(run.meta.vendor),
        "findings": [finding.as_dict() for finding in findings],
    }
    broken = any(f.severity == "error" and f.code.startswith("clock") for f in findings)
    return result if broken else {**result, **kind_named(run.meta.kind).run_figures(run)}


def _bidirectional(runs: Sequence[Run]) -> list[dict[str, Any]]:
    by_direction = {run.meta.direction: run for run in runs if run.window is not None}
    if set(by_direction) != {"CCW", "CW"} or not runs[0].meta.radius_mm:
        return []
    ccw, cw = by_direction["CCW"], by_direction["CW"]
    figures = bidirectional_figures(ccw.arc, cw.arc, runs[0].meta.radius_mm)
    return [{"runs": [ccw.meta.run_id, cw.meta.run_id], **asdict(figures)}]


def render_check(result: dict[str, Any]) -> str:
    """Return the result of :func:`check_source` as text for a terminal."""
    runs = result["runs"]
    lines = [f"{result['source']}: machine {result['machine']}, {counted(len(runs), 'run')}"]
    lines += ["", *sheet_lines(result["sheet"])] if "sheet" in result else []
    kind = kind_named(result["kind"])
    if len(runs) <= _MAX_DETAILED and not kind.in_one_table:
        lines += [line for run in runs for line in ("", *_render_run(run))]
    elif not kind.in_one_table:
        lines += ["", *_render_table(runs, result["findings"])]
    for pair in result["bidirectional"][:_MAX_DETAILED]:
        lines.append(
            f"\n{' and '.join(pair['runs'])}: circular deviation G(b) of both directions "
            f"{pair['circular_deviation_common_centre_um']:z.1f} µm about a common centre, "
            f"{pair['circular_deviation_own_centres_um']:z.1f} µm about their own; hysteresis H "
            f"{pair['hysteresis_um']:z.1f} µm at {pair['hysteresis_angle_deg']:z.0f} deg, between samples; "
            "as the file's indices say"
        )
    figures = kind.figure_lines(result)
    lines += ["", *figures, ""] if figures else []
    lines += [f"{f['severity']}: {f['message']}" for f in result["findings"]]
    return "\n".join(lines)


_ROWS = (
    ("centre along first axis, µm", "centre_a_um", "centre_a_um"),
    ("centre along second axis, µm", "centre_b_um", "centre_b_um"),
    ("least-squares radius, mm", "radius_mm", "best_radius_mm"),
    ("circular deviation, µm", "circular_deviation_um", "circularity_um"),
    ("the same, minimum zone, µm", "circular_deviation_mz_um", ""),
    ("RMS about the circle, µm", "rms_um", ""),
    ("mean feed, mm/min", "feed_mm_min", "feed_mm_min"),
)


def _render_run(run: dict[str, Any]) -> list[str]:
    if not run["condition"]["plane"]:
        told = [f"  {f['severity']}: {f['message']}" for f in run["findings"]]
        return [f"{run['run']}: {run['samples']} readings", *told]
    condition = run["condition"]
    lines = [
        f"{run['run']}: {condition['plane']} R{_told(condition['radius_mm'])} F{_told(condition['feed_mm_min'])} "
        f"{condition['direction']}, {run['samples']} samples at {run['sample_rate_hz']:g} Hz"
    ]
    by_file, aligned = run.get("by_file_indices"), run.get("aligned_by_stops")
    if by_file is not None:
        rows = [
            [
                title,
                circle_figure(title, by_file.get(key)),
                circle_figure(title, run["vendor"].get(vendor)),
                circle_figure(title, None if aligned is None else aligned.get(key)),
            ]
            for title, key, vendor in _ROWS
        ]
        head = ("", "by the file's indices", "vendor's file says", "aligned by the stops")
        # What a vendor's file and stops tell is a ball bar's alone.
        there = [i for i in range(len(head)) if i == 0 or any(row[i] != "-" for row in rows)]
        lines += [
            "  " + line
            for line in table([head[i] for i in there], [[row[i] for i in there] for row in rows]).splitlines()
        ]
        strongest = ", ".join(
            f"{line['frequency_hz']:z.2f} Hz {line['amplitude_um']:z.1f} µm" for line in run["spectrum"]["lines"]
        )
        bands = ", ".join(f"{b['from_hz']:g}-{b['to_hz']:g} Hz {b['rms_um']:z.1f}" for b in run["spectrum"]["bands_um"])
        lines += [f"  strongest lines: {strongest}", f"  bands, µm RMS: {bands}"]
    return lines + [f"  {f['severity']}: {f['message']}" for f in run["findings"]]


def _render_table(runs: Sequence[dict[str, Any]], together: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each run that has figures or findings of its own, and one for each kind of error and warning.

    ``together``: findings of all runs together, which are told elsewhere.
    """
    figures = {"circular_deviation_um": "circular deviation, µm", "rms_um": "RMS, µm"}
    known = [name for name in figures if any(name in run.get("by_file_indices", {}) for run in runs)]
    rows = [
        [
            run["run"],
            *(micrometres(run.get("by_file_indices", {}).get(name)) for name in known),
            ", ".join(f["code"] for f in run["findings"] if f["severity"] != "info") or "-",
        ]
        for run in runs
    ]
    shown = [row for row in rows if known or row[-1] != "-"]
    lines = table(("run", *(figures[name] for name in known), "findings"), shown).splitlines() if shown else []
    if len(shown) < len(rows):
        alone = f"{len(rows) - len(shown)} of {len(rows)} runs: no error and no warning"
        counts = {s: sum(f["severity"] == s for f in together) for s in ("error", "warning")}
        of_all = " and ".join(counted(count, s) for s, count in counts.items() if count)
        lines.append(f"{alone} in a run alone; of all runs together: {of_all}" if of_all else alone)
    rejected = [run["rejected_rows"] for run in runs if "rejected_rows" in run]
    if rejected:
        lines.append(f"rows that are not used: {sum(rejected)} in {counted(len(rejected), 'run')}; --json tells which")
    told: dict[str, list[str]] = {}
    for severity in ("error", "warning"):
        for run in runs:
            for f in run["findings"]:
                if f["severity"] == severity:
                    told.setdefault(f"{severity} {f['code']}", []).append(f"{severity}, {run['run']}: {f['message']}")
    return [*lines, *(said[0] + (f" (and {len(said) - 1} more)" if len(said) > 1 else "") for said in told.values())]


def _told(value: float | None) -> str:
    return "?" if value is None else f"{value:g}"
