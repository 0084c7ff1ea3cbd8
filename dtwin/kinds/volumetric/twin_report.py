"""Twins of ball-array campaigns as text, and as sections of a report; pictures of a cycle."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dtwin.features.time_alone import TIME_ALONE
from dtwin.kinds.kind import Drawing
from dtwin.kinds.volumetric._chain import COEFFICIENTS
from dtwin.kinds.volumetric._heat_series import body_of
from dtwin.kinds.volumetric._movers import MATERIAL
from dtwin.kinds.volumetric.heat_twin import HeatTwin
from dtwin.kinds.volumetric.motions import FAMILIES, Family, family_of, motion_words
from dtwin.report.html import Part, Section, Table
from dtwin.report.plots import COLOURS, draw_line, lacks_columns, places_figure, styled
from dtwin.report.text import micrometres, table
from dtwin.report.twin_of_machine import missing_section
from dtwin.report.twin_of_terms import TermTwinReport
from dtwin.schema import Run

_SEVERITY = {"nothing_missing": "info", "unknown_effect": "error"}
_SHOWN = 6
_UNIT = "unit of replication: the cycle, fewer where heat lasts"


def family_dict(family: Family) -> dict[str, Any]:
    """Return a family of error motions as a JSON-ready mapping."""
    members = [m for m in COEFFICIENTS if family_of(m).name == family.name]
    return {**vars(family), "kinds": ["volumetric"], "motions": members}


def family_text(family: Family) -> str:
    """Return what a family of error motions is, for the terminal."""
    members = family_dict(family)["motions"]
    return "\n".join(
        [
            f"{family.name}: {family.title}",
            family.meaning,
            f"looks like: {family.looks_like}",
            "error motions: " + ", ".join(f"{m} ({motion_words(m)})" for m in members),
            f"group: {family.group}",
            f"told apart by: {family.separate_by}",
            f"remedy: {family.remedy}",
            "reference: ISO 230-1 (names), ISO 230-3 (thermal effects)",
        ]
    )


def family_named(name: str) -> Family | None:
    """Return a family by its own name or by that of an error motion; None when it is neither."""
    if name in FAMILIES or name not in COEFFICIENTS:
        return FAMILIES.get(name)
    return family_of(name)


def _told_by(candidate: Mapping[str, Any], one_body: object) -> str:
    if candidate["explained_by"]:
        return str(candidate["explained_by"])
    if not candidate["add"]:
        return "nothing logged"
    if not candidate["temperatures"]:
        return f"{_bodies(candidate['as_time_alone'])} or {TIME_ALONE}"
    if one_body:
        return ", ".join(candidate["temperatures"])
    alone = [label.partition("@")[2] for label in candidate["confounded_with"]]
    return " or ".join(alone) if alone else _bodies(candidate["temperatures"])


def _not_told_apart(candidate: Mapping[str, Any]) -> str:
    """Return which causes of a motion these hours do not tell apart; empty when they do."""
    pairs = [f"{body} or {' or '.join(others)}" for body, others in candidate["alike"].items()]
    if candidate["as_time_alone"]:
        pairs.append(f"{_bodies(candidate['as_time_alone'])} or {TIME_ALONE}")
    return f"{candidate['effect']}: {'; '.join(pairs)}" if pairs else ""


def _bodies(sensors: Sequence[str]) -> str:
    """Return the bodies of thermocouples, each once; any other temperature as it is called."""
    return ", ".join(dict.fromkeys(map(body_of, sensors)))


def _place(place: Mapping[str, Any]) -> str:
    where = f"pose {place['pose']}" if place["pose"] else "balls on the table"
    first, last = place["hours"]
    return f"{where}, in {place['axis']}, {first:g} to {last:g} h: {micrometres(place['residual_rms_um'])} µm"


def _day_table(result: Mapping[str, Any]) -> Table:
    rows = [
        (
            f"{c['hours'][0]:g} to {c['hours'][1]:g} h",
            str(c["cycles"]),
            micrometres(c["rms_before_um"]),
            micrometres(c["rms_after_um"]),
        )
        for c in result["conditions"]
    ]
    return Table(("hours", "cycles", "before, µm", "after, µm"), rows)


def _motion_table(result: Mapping[str, Any]) -> Table:
    worst = sorted(result["motions"], key=lambda m: -m["rms_after_um"])[:_SHOWN]
    rows = [
        (
            m["effect"],
            m["in_twin"] or "no",
            micrometres(m["rms_before_um"]),
            micrometres(m["rms_after_um"]),
            micrometres(m["noise_um"]),
        )
        for m in worst
    ]
    return Table(("motion", "in the twin", "before, µm", "after, µm", "of it noise"), rows)


def _motion_figure(result: Mapping[str, Any]) -> go.Figure:
    """Return every error motion at the balls, of a comparison as a mapping: measured, left, and its noise."""
    rows = sorted(result["motions"], key=lambda m: -m["rms_before_um"])
    figure = go.Figure()
    for label, key, colour in (
        ("measured", "rms_before_um", "measured"),
        ("left by the twin", "rms_after_um", "second"),
        ("noise of the motion", "noise_um", "floor"),
    ):
        figure.add_trace(
            go.Bar(x=[m["effect"] for m in rows], y=[m[key] for m in rows], name=label, marker_color=COLOURS[colour])
        )
    figure.update_layout(
        title="Every error motion at the balls",
        yaxis={"title": "RMS, µm", "type": "log", "dtick": 1},
        xaxis_tickangle=-60,
        barmode="group",
    )
    return styled(figure)


def _day_figure(result: Mapping[str, Any]) -> go.Figure:
    """Return the error at the balls day by day, of a comparison as a mapping: measured and left."""
    days = result["conditions"]
    named = [f"{d['hours'][0]:g} to {d['hours'][1]:g}" for d in days]
    figure = go.Figure()
    for label, key, colour in (
        ("measured", "rms_before_um", "measured"),
        ("left by the twin", "rms_after_um", "second"),
    ):
        figure.add_trace(go.Bar(x=named, y=[d[key] for d in days], name=label, marker_color=COLOURS[colour]))
    floor = [result["noise_floor_um"]] * len(days)
    draw_line(figure, named, floor, "noise floor", color=COLOURS["floor"], dash="dash")
    figure.update_layout(
        title="Error at the balls, day by day", yaxis_title="RMS, µm", xaxis_title="hours", barmode="group"
    )
    return styled(figure)


def _advice(name: str, result: Mapping[str, Any]) -> list[str]:
    group = [c for c in result["candidates"] if c["in_group"]]
    best = next((c for c in group if c["add"]), None)
    if best is None:
        return ["nothing to add"] if not group else ["nothing that was logged would help"]
    if best["confounded_with"] == [TIME_ALONE]:
        return [f"only if that is known to be the cause: dtwin twin add {name} {best['add']}"]
    lines = [f"try: dtwin twin add {name} {best['add']}"]
    if result["verdict"] == "ambiguous":
        alone = best["confounded_with"][0]
        lines.append(
            f"that takes the temperatures that fit best here; {alone} takes those of one body. Which is "
            "right shows when they part, and only then can the twin be trusted in another season"
        )
    return [*lines, f"remedy: {best['remedy']}"]


_DRAWN = {f"{axis}_mm" for axis in "xyz"} | {f"error_{axis}_um" for axis in "xyz"}


def _seen(run: Run, floor_um: Callable[[], float], axes: tuple[str, str]) -> go.Figure:
    """Draw how far the machine was off at each ball of a cycle."""
    if not set(run.samples) >= _DRAWN:
        raise lacks_columns(run, "error at places", ", ".join(sorted(_DRAWN)))
    off = np.sqrt(sum(run.samples[f"error_{axis}_um"] ** 2 for axis in "xyz"))
    across, up = (run.samples[f"{axis.lower()}_mm"] for axis in axes)
    return places_figure(across, up, off, title=f"Error at the balls, {axes[0]} and {axes[1]}", axes=axes)


DRAWINGS = (
    Drawing("above", "Error at the balls, seen from above", 460, partial(_seen, axes=("X", "Y")), half=True),
    Drawing("front", "Error at the balls, seen from the front", 460, partial(_seen, axes=("X", "Z")), half=True),
)


class _HeatReport(TermTwinReport):
    """How twins of heat are told."""

    without_effects = "no effects yet"

    def parameter_table(self, twin: HeatTwin, *, in_words: bool = True) -> Table:
        """Return the error motions of a twin, and what drives them."""
        rows = [
            (
                term.label,
                motion_words(term.motion),
                family_of(term.motion).name,
                str(len(model.sensors)),
                _bodies(model.sensors) or f"nothing surely: {term.motion}@BODY names it",
            )
            for term, model in zip(twin.terms, twin.models, strict=True)
        ]
        return Table(("effect", "what", "family", "inputs", "driven by"), rows)

    def fell(self, figures: Mapping[str, Any]) -> str:
        return (
            f"error at the balls {micrometres(figures['rms_before_um'])} -> {micrometres(figures['rms_after_um'])} µm RMS, "
            f"{micrometres(figures['held_out_rms_um'])} µm on hours left out; noise floor "
            f"{micrometres(figures['noise_floor_um'])} µm ({_UNIT})"
        )

    def compared(self, result: Mapping[str, Any]) -> list[str]:
        days, motions = _day_table(result), _motion_table(result)
        return [
            f"twin {result['twin']} version {result['version']} against campaign "
            f"{result['campaign']} ({result['runs']} cycles)",
            table(days.head, days.rows),
            f"error at the balls {micrometres(result['rms_before_um'])} -> "
            f"{micrometres(result['residual_rms_um'])} µm RMS, of which error "
            f"motions are {micrometres(result['systematic_rms_um'])} µm; noise floor "
            f"{micrometres(result['noise_floor_um'])} µm ({_UNIT})",
            "most left, RMS at the balls:",
            table(motions.head, motions.rows),
            "largest, noise left aside:",
            *(f"  {_place(place)}" for place in result["where"]),
            *(f"warning: {warning}" for warning in result["warnings"]),
        ]

    def told(self, name: str, result: Mapping[str, Any]) -> list[Part]:
        lines: list[Part] = [
            f"{result['verdict']}: {result['headline']}",
            f"residual at the balls {micrometres(result['residual_rms_um'])} µm RMS, of which error "
            f"motions are {micrometres(result['systematic_rms_um'])} µm; noise floor "
            f"{micrometres(result['noise_floor_um'])} µm ({_UNIT})",
        ]
        if result["candidates"]:
            head = ("motion", "seen, µm", "after, µm", "told on hours left out", "p", "by", "in group")
            rows = [
                (
                    c["effect"],
                    micrometres(c["seen_um"]),
                    micrometres(c["rms_after_um"]),
                    f"{100 * c['cv_gain']:z.0f} %" if c["cv_gain"] > 0.0 else "nothing",
                    f"{c['p_value']:.1g}",
                    _told_by(c, result.get("one_body")),
                    "yes" if c["in_group"] else "",
                )
                for c in result["candidates"]
            ]
            lines.append(Table(head, rows))
            now = result["residual_rms_um"]
            if any(c["add"] and c["rms_after_um"] > now for c in result["candidates"]):
                lines.append("more after than now: it offsets another at these balls until both are in")
        apart = [said for c in result["candidates"] if c["add"] and (said := _not_told_apart(c))]
        if apart:
            lines += ["these hours do not tell apart:", *(f"  {said}" for said in apart)]
        if one_body := result.get("one_body"):
            lines.append(
                f"{one_body[0]} to {one_body[-1]} are of one body by their names, and nothing in it is told apart: "
                "name each by what it sits on (bed_1_c, ram_1_c)"
            )
        if result["quiet"]:
            lines.append(f"move, but by less than {100 * MATERIAL:z.0f} % of the floor: {', '.join(result['quiet'])}")
        if result["next_experiment"]:
            lines.append(f"next: {result['next_experiment']['text']}")
        return [*lines, *_advice(name, result)]

    def figures(self, comparison: object, result: Mapping[str, Any]) -> list[go.Figure]:
        return [_motion_figure(result), _day_figure(result)]

    def comparison_sections(self, comparison: object, result: Mapping[str, Any]) -> list[Section]:
        """Return measured against predicted: motion by motion and day by day."""
        said = (
            f"Version {result['version']} against {result['campaign']}: {result['runs']} cycles, "
            f"{micrometres(result['rms_before_um'])} -> {micrometres(result['residual_rms_um'])} µm RMS at the "
            f"balls, noise floor {micrometres(result['noise_floor_um'])} µm ({_UNIT})."
        )
        return [
            Section(
                "Measured against predicted",
                [said],
                [("warning", warning) for warning in result["warnings"]],
                figures=self.figures(comparison, result),
            ),
            Section("Where it fails", [_place(place) for place in result["where"]]),
        ]

    def diagnosis_section(self, name: str, result: Mapping[str, Any]) -> Section:
        severity = _SEVERITY.get(result["verdict"], "warning")
        return missing_section(result, self.told(name, result), severity, f"{result['verdict']}: {result['headline']}")


REPORT = _HeatReport()
