"""Sections of a twin's report, and the same as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import plotly.graph_objects as go

from dtwin.physics import localise
from dtwin.physics.gridding import CIRCLE
from dtwin.physics.observations import Observations
from dtwin.physics.twin import Twin, data_lines
from dtwin.report.encoder_share import encoder_section, encoder_text, tells
from dtwin.report.faults import faults, not_told, title_of, told_of, undecided_lines, with_k2
from dtwin.report.html import Part, Section, Table, parts_text, told_section
from dtwin.report.text import gain_words, listed, micrometres, table
from dtwin.report.twin_plots import along_figure, overlay_figure, ranked_figure, residual_map, waterfall_figure
from dtwin.schema import Floats
from dtwin.statistics import deviation_interval
from dtwin.units import shown_number, shown_parameter, shown_unit

if TYPE_CHECKING:
    from dtwin.physics.effect import Effect
    from dtwin.twins.measured import Comparison

_OVERLAYS = 4
_COORDINATES = ("angle_deg", "position_mm", "phase_deg")
_SEVERITY = {
    "nothing_missing": "info",
    "missing_effect": "warning",
    "ambiguous": "warning",
    "unknown_effect": "error",
    "need_repeats": "error",
    "variance_effect": "warning",
}


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for people; absent ones as a dash."""
    if value is None or not math.isfinite(value):
        return "-"
    return shown_number(value, digits)


def _closest_words(result: Mapping[str, Any]) -> str:
    """Return how much of a residual the closest effect would take, and why it is not named; empty where it was not tested."""
    told = (c for c in result["candidates"] if f"{c['effect']} {c['axis']}".rstrip() == result["closest"])
    return next(
        (f", which alone would leave {number(c['rms_after_um'])} µm (p = {number(c['p_value'], 2)})" for c in told), ""
    )


def condition_words(condition: Mapping[str, Any]) -> str:
    """Return a condition, as its ``as_dict`` gives it, as people write it."""
    if "plane" in condition:
        place = f"{condition['plane']} R{condition['radius_mm']:g}"
        return f"{place} F{condition['feed_mm_min']:g} {condition['direction']}"
    if "frequency_hz" in condition:
        tone = f"{condition['frequency_hz']:g} Hz {condition['amplitude_um']:g} µm"
        return f"{condition['axis']} {tone}"
    return f"{condition['axis']} {condition['direction']}"


def parameter_table(twin: Twin, *, in_words: bool = True) -> Table:
    """Return the parameters of a twin with their uncertainty; effects by their names ``in_words``, or as commands take them."""
    titles = {t.instance.effect.name: t.instance.effect.title for t in twin.terms} if in_words else {}
    rows = [
        (
            f"{titles.get(e.effect, e.effect)} {e.axis}".strip(),
            shown_parameter(e.name),
            _rounded(e.value, e.uncertainty) if e.identifiable else "not told",
            shown_unit(e.unit),
        )
        for term in twin.terms
        for e in told_of(twin, term)
        if not e.is_unseen
    ]
    for term in twin.terms:
        rows += [
            (
                f"{titles.get(term.instance.effect.name, term.instance.effect.name)} {term.instance.axis}".strip(),
                shape.name.removesuffix(f"_{shape.unit.lower().replace('/', '_')}").replace("_", " "),
                f"{'about ' * shape.refined}{number(term.shape[shape.name], 2)}",
                shown_unit(shape.unit),
            )
            for shape in term.instance.effect.shapes
            if term.shape[shape.name] or shape.start
        ]
    return Table(("effect", "parameter", "value (k = 2)", "unit"), rows)


def _rounded(value: float, uncertainty: float) -> str:
    """Return a value to two digits of its uncertainty."""
    if not math.isfinite(uncertainty) or not 1e-8 < uncertainty < 1e8:
        return f"{number(value, 4)} ± {number(uncertainty, 2)}"
    digits = max(1 - math.floor(math.log10(uncertainty)), 0)
    return f"{value:z.{digits}f} ± {uncertainty:z.{digits}f}"


def twin_text(twin: Twin) -> str:
    """Return a twin for the terminal."""
    figures = twin.figures
    head = (
        f"twin {twin.name} version {twin.version} ({twin.action}) of machine {twin.machine}, "
        f"campaign {twin.campaign}\n"
        f"error {micrometres(figures['rms_before_um'])} -> {micrometres(figures['rms_after_um'])} µm RMS, of which "
        f"repeats agree on {number(figures['systematic_rms_um'])} µm; noise floor "
        f"{_floor_words(figures)} (unit of replication: the run)\n"
    )
    shown = parameter_table(twin, in_words=False)
    lines = [head, table(shown.head, shown.rows) if shown.rows else "no effects yet"]
    lines += ["", *(fault.sentence for fault in faults(twin)), ""] if twin.terms else []
    lines += [f"warning: {doubt}" for doubt in twin.doubts]
    lines += [f"cannot be told apart: {_alias(alias)}" for alias in twin.aliases]
    lines += [f"warning: {line}" for line in data_lines(twin.data)]
    return "\n".join(lines)


def _floor_words(figures: Mapping[str, Any]) -> str:
    """Return the noise floor with its 95 % interval, each run counted once.

    ``figures``: with ``noise_floor_um``, and ``noise_floor_dof`` where it is known.
    """
    floor_um, dof = figures["noise_floor_um"], figures.get("noise_floor_dof", 0)
    if not dof:
        return f"{number(floor_um)} µm"
    low, high = deviation_interval(floor_um, dof)
    return f"{number(floor_um)} µm, {number(low)} to {number(high)} at 95 %"


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison for the terminal."""
    head = ("condition", "runs", "before, µm", "after, µm")
    rows = [
        (condition_words(c), c["runs"], micrometres(c["rms_before_um"]), micrometres(c["rms_after_um"]))
        for c in result["conditions"]
    ]
    lines = [
        f"twin {result['twin']} version {result['version']} against campaign "
        f"{result['campaign']} ({result['runs']} runs)",
        table(head, rows),
        f"residual {micrometres(result['residual_rms_um'])} µm RMS, of which repeats agree on "
        f"{number(result['systematic_rms_um'])} µm; noise floor {_floor_words(result)}",
        f"in words: {result['headline']}",
        "largest:",
        *(f"  {place_words(place)}" for place in result["where"]),
        *([encoder_text(result["encoder_split"])] if tells(result["encoder_split"]) else []),
        *(f"warning: {warning}" for warning in result["warnings"]),
    ]
    return "\n".join(lines)


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis for the terminal."""
    return parts_text(_diagnosis_parts(name, result))


def _diagnosis_parts(name: str, result: Mapping[str, Any]) -> list[Part]:
    """Return what a diagnosis tells, line by line."""
    lines: list[Part] = [
        f"{result['verdict']}: {result['headline']}",
        f"residual {micrometres(result['residual_rms_um'])} µm RMS, repeats agree on "
        f"{number(result['systematic_rms_um'])} µm of it; noise floor "
        f"{number(result['noise_floor_um'])} µm; lack of fit p = {number(result['lack_of_fit_p'], 2)}",
    ]
    if result["candidates"]:
        # Of several campaigns each stands beside what is left of the one where it was found.
        left = left_of(result)
        head = (
            "effect",
            *(("campaign", "now, µm") if left else ()),
            "after, µm",
            "left-out gain",
            "p",
            "grade",
            "in group",
        )
        rows = [
            (
                f"{c['effect']} {c['axis']}".strip(),
                *((c["campaign"], micrometres(left.get(c["campaign"]))) if left else ()),
                micrometres(c["rms_after_um"]),
                gain_words(c["cv_gain"]),
                number(c["p_value"], 2),
                c["grade"] or "",
                "yes" if c["in_group"] else "",
            )
            for c in result["candidates"]
        ]
        lines.append(Table(head, rows))
    shown = found_table(result)
    if shown.rows:
        lines.append(shown)
    lines += _unresolved_lines(result)
    lines += [f"law: {law['equation']}" for law in result["laws"][:3]]
    lines += [
        f"channel: {c['name']} explains {100 * c['share']:z.0f} % of the spread between repeats "
        f"(p = {c['p_value']:.2g})"
        for c in result["channels"]
    ]
    if result["verdict"] == "unknown_effect" and result["closest"]:
        lines.append(f"closest of what is known: {result['closest']}{_closest_words(result)}")
    if result["outlier_runs"]:
        odd = ", ".join(result["outlier_runs"])
        lines.append(f"left out, not like their repeats: {odd} (a fit has them until `dtwin leave-out` takes them out)")
    lines += [f"warning: {line}" for line in result.get("told", [])]
    if result["invisible"]:
        lines.append(f"invisible in these runs: {', '.join(result['invisible'])}")
    lines += [f"not told: {line}" for line in not_told(result)]
    lines += undecided_lines(result)
    if result["next_experiment"]:
        lines.append(f"next: {result['next_experiment']['text']}")
    lines.append(_advice(name, result))
    return lines


def left_of(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Return the residual of each campaign, um, where a diagnosis is of several."""
    return {one["campaign"]: one["residual_rms_um"] for one in diagnosis.get("campaigns", ())}


def _size_words(estimate: Mapping[str, Any]) -> str:
    """Return a parameter with its uncertainty and unit."""
    if not estimate["identifiable"]:
        return "not told"
    uncertainty = math.nan if estimate["uncertainty"] is None else estimate["uncertainty"]
    return f"{shown_parameter(estimate['name'])} {with_k2(estimate['value'], uncertainty, estimate['unit'])}"


def _sizes_of_first(group: Sequence[Mapping[str, Any]]) -> str:
    """Return the sizes of the first effect of a group, as they are when no other of the group is there."""
    words = "; ".join(_size_words(size) for size in group[0]["sizes"])
    return f"{words}, if it is the first alone" if words and len(group) > 1 else words or "-"


def found_table(result: Mapping[str, Any], library: Mapping[str, Effect] | None = None) -> Table:
    """Return every effect that was found, with what cannot be told from it and what was tested.

    Effects are named as commands take them, with a library by their titles.
    """
    rows = [
        (
            listed([title_of(f"{c['effect']} {c['axis']}".strip(), library or {}) for c in group], " or "),
            micrometres(group[0]["size_um"]),
            _sizes_of_first(group),
            gain_words(group[0]["cv_gain"]),
            group[0]["grade"] or "",
            ", ".join(group[0]["tested"]) or "-",
            ", ".join(group[0]["untested"]) or "-",
        )
        for group in result.get("found", [])
    ]
    head = ("found", "explains, µm", "size (k = 2)", "left-out gain", "grade", "law tested over", "not over")
    return Table(head, rows)


def _unresolved_lines(result: Mapping[str, Any]) -> list[str]:
    """Return what is left beside what was found, and where."""
    rest = result.get("unresolved")
    if not rest:
        return []
    share = f"{100 * rest['share']:z.0f} % of what repeats agree on"
    return [
        f"not resolved: {micrometres(rest['systematic_rms_um'])} µm RMS, {share} "
        f"(p = {number(rest['p_value'], 2)}): {rest['words']}",
        *(f"  {place_words(place)}" for place in rest["where"][:3]),
    ]


def history_text(rungs: Sequence[Mapping[str, Any]]) -> str:
    """Return the rungs of a twin for the terminal."""
    return parts_text([history_table(rungs)])


def history_table(rungs: Sequence[Mapping[str, Any]]) -> Table:
    """Return the rungs of a twin."""
    head = ("version", "action", "before, µm", "after, µm", "floor, µm", "verdict", "found")
    rows = [
        (
            r["version"],
            r["action"],
            micrometres(r["rms_before_um"]),
            micrometres(r["rms_after_um"]),
            number(r["noise_floor_um"]),
            r["verdict"] or "",
            _first_of(r["found"]),
        )
        for r in rungs
    ]
    return Table(head, rows)


def _first_of(groups: Sequence[Sequence[str]]) -> str:
    return listed([listed(group, " or ") for group in groups], "; ")


def comparison_sections(comparison: Comparison, result: Mapping[str, Any]) -> list[Section]:
    """Return measured against predicted: by condition, as a map, and overlaid."""
    obs, before_um, residual_um = comparison.obs, comparison.before_um, comparison.residual_um
    means = localise.condition_means(obs, residual_um)
    measured = localise.condition_means(obs, before_um)
    floor = float(result["noise_floor_um"])
    worst = np.argsort(-np.sqrt((means**2).mean(axis=1)))[:_OVERLAYS]
    figures = [_overlay(obs, int(c), measured[c], means[c], floor) for c in worst]
    names = [str(c) for c in obs.conditions]
    overview = residual_map(means, names, floor_um=floor, title="Mean residual", grid=obs.grid)
    hint = ["Choose the magnification below each plot."] if obs.grid is CIRCLE else []
    seen = result["encoder_split"]
    return [
        Section(
            "Measured against predicted",
            [comparison_text(result).split("\n")[0], f"In words: {result['headline']}"],
            [("warning", warning) for warning in result["warnings"]],
            [_condition_table(result)],
        ),
        Section("Where it fails", [place_words(p) for p in result["where"]], [], [], [overview]),
        Section("The worst conditions", hint, [], [], figures),
        *([encoder_section(seen)] if tells(seen) else []),
    ]


def _overlay(obs: Observations, number: int, measured_um: Floats, left_um: Floats, floor_um: float) -> go.Figure:
    condition = obs.conditions[number]
    curves = {"measured": measured_um, "predicted": measured_um - left_um, "residual": left_um}
    if obs.grid is CIRCLE:
        return overlay_figure(
            curves, condition.radius_mm, title=f"{condition}, µm", floor_um=floor_um, plane=condition.plane
        )
    return along_figure(curves, title=str(condition), floor_um=floor_um, grid=obs.grid)


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return what is missing."""
    findings = [(_SEVERITY[result["verdict"]], f"{result['verdict']}: {result['headline']}")]
    findings += [("warning", line) for line in undecided_lines(result)]
    figures = [ranked_figure(result)] if result["candidates"] else []
    return told_section("What is missing", _diagnosis_parts(name, result), findings, figures)


def history_section(rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return how the error fell."""
    return told_section("From version to version", [history_table(rungs)], figures=[waterfall_figure(rungs)])


def twin_section(twin: Twin) -> Section:
    """Return the twin and its parameters."""
    figures = twin.figures
    said = (
        f"Version {twin.version} ({twin.action}): {micrometres(figures['rms_before_um'])} -> "
        f"{micrometres(figures['rms_after_um'])} µm RMS, noise floor {number(figures['noise_floor_um'])} µm. "
        "Uncertainties are expanded (k = 2); the unit of replication is the run."
    )
    warnings = [("warning", doubt) for doubt in twin.doubts]
    warnings += [("warning", f"cannot be told apart: {_alias(alias)}") for alias in twin.aliases]
    return Section("The twin", [said], warnings, [parameter_table(twin)])


def _condition_table(result: Mapping[str, Any]) -> Table:
    rows = [
        (condition_words(c), str(c["runs"]), micrometres(c["rms_before_um"]), micrometres(c["rms_after_um"]))
        for c in result["conditions"]
    ]
    return Table(("condition", "runs", "before, µm", "after, µm"), rows)


def _alias(alias: Mapping[str, Any]) -> str:
    return f"{alias['first']} and {alias['second']} (correlation {alias['correlation']:z.3f}). {alias['separate_by']}"


def place_words(place: Mapping[str, Any]) -> str:
    """Return where the residual is large, as ``localise.worst_places`` gives it, in words."""
    name = next(n for n in _COORDINATES if n in place)
    low, high = place[name]
    unit = name.rpartition("_")[2]
    of = f"{place['campaign']}, " if "campaign" in place else ""
    return f"{of}{condition_words(place)}, {low:g} to {high:g} {unit}: {micrometres(place['residual_rms_um'])} µm"


def _advice(name: str, result: Mapping[str, Any]) -> str:
    group = [c for c in result["candidates"] if c["in_group"]]
    if result["verdict"] == "missing_effect":
        best = group[0]
        axis = f" --axis {best['axis']}" if best["axis"] else ""
        every = f"\nall of them: dtwin twin discover {name}" if len(result.get("found", [])) > 1 else ""
        return f"try: dtwin twin add {name} {best['effect']}{axis}\nremedy: {best['remedy']}{every}"
    if result["verdict"] == "ambiguous":
        return "these runs cannot tell them apart; adding one would only be a guess"
    if result["verdict"] == "unknown_effect" and result["closest"] in result["untestable"]:
        return f"measure more repeats: they tell whether it is {result['closest']}"
    if result.get("places"):
        return f"a description of it, without a cause: dtwin twin discover {name}"
    if result["verdict"] == "unknown_effect":
        return "write your own effect: dtwin effects template NAME"
    if result["verdict"] == "need_repeats":
        return "measure conditions at least twice, better three times"
    return "nothing to add"
