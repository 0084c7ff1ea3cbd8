"""Twins of several campaigns of a machine, as text and as sections of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from dtwin.physics.several_twin import SeveralTwin
from dtwin.report import twins
from dtwin.report._recorded import contradiction_words
from dtwin.report.faults import with_k2
from dtwin.report.html import Section, Table
from dtwin.report.text import VERDICTS, micrometres, table
from dtwin.report.twins import history_section as history_section
from dtwin.report.twins import number
from dtwin.units import shown_number, shown_parameter, shown_unit

if TYPE_CHECKING:
    from dtwin.twins.several_campaigns import SeveralComparison

_HEAD = ("campaign", "kind", "begun", "left, µm RMS", "of it repeats agree on, µm", "noise floor, µm")


def twin_text(twin: SeveralTwin) -> str:
    """Return a twin for the terminal."""
    shown = campaign_table(twin.as_dict())
    return "\n".join([twins.twin_text(twin), table(shown.head, shown.rows), *contradiction_lines(twin.as_dict())])


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison for the terminal, campaign by campaign."""
    return "\n\n".join([*(twins.comparison_text(one) for one in result["campaigns"]), *contradiction_lines(result)])


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis for the terminal: of all together, and what each campaign says by itself."""
    shown = _said_table(result)
    lines = [*contradiction_lines(result), *_explanation_lines(result), *_settled_lines(result)]
    return "\n".join([twins.diagnosis_text(name, result), table(shown.head, shown.rows), *lines])


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return what is missing."""
    made = twins.diagnosis_section(name, result)
    told = [("warning", line) for line in contradiction_lines(result)]
    told += [("info", line) for line in (*_explanation_lines(result), *_settled_lines(result))]
    return replace(made, findings=[*made.findings, *told], tables=[*made.tables, _said_table(result)])


def twin_section(twin: SeveralTwin) -> Section:
    """Return the twin and its parameters."""
    made = twins.twin_section(twin)
    told = [("warning", line) for line in contradiction_lines(twin.as_dict())]
    return Section(made.title, made.paragraphs, [*made.findings, *told], [*made.tables, campaign_table(twin.as_dict())])


def comparison_sections(comparison: SeveralComparison, result: Mapping[str, Any]) -> list[Section]:
    """Return measured against predicted, campaign by campaign."""
    return [
        replace(made, title=f"{made.title}: {one['campaign']}")
        for part, one in zip(comparison.parts, result["campaigns"], strict=True)
        for made in twins.comparison_sections(part, one)
    ]


def campaign_table(document: Mapping[str, Any]) -> Table:
    """Return what the twin leaves of each campaign."""
    rows = [
        (
            one["campaign"],
            one["kind"],
            one["started"][:10] or "-",
            micrometres(one["residual_rms_um"]),
            number(one["systematic_rms_um"]),
            number(one["noise_floor_um"]),
        )
        for one in document["campaigns"]
    ]
    return Table(_HEAD, rows)


def _said_table(result: Mapping[str, Any]) -> Table:
    rows = [
        (
            one["campaign"],
            one["kind"],
            one["started"][:10] or "-",
            VERDICTS.get(one["verdict"], one["verdict"]),
            "; ".join(" or ".join(group) for group in one["found"]) or "-",
            number(one["noise_floor_um"]),
        )
        for one in result["campaigns"]
    ]
    return Table(("campaign", "kind", "begun", "by itself", "found by itself", "noise floor, µm"), rows)


def contradiction_lines(document: Mapping[str, Any]) -> list[str]:
    """Return what campaigns do not agree on: by how much, since when, what was recorded then, and what that may be."""
    out = []
    for one in document.get("contradictions", ()):
        size = with_k2(abs(one["difference"]), one["k2"], one["unit"])
        side = "above that of" if one["difference"] > 0.0 else "below that of"
        what = f"contradiction since {one['since'][:10]}" if one["since"] else "contradiction"
        where = f"{one['effect']} {one['axis']}".rstrip()
        rivals = (
            f", or {' or '.join(one['rivals'])}, which these tests cannot tell from it" if one.get("rivals") else ""
        )
        out.append(
            f"{what}: {where} ({shown_parameter(one['parameter'])}) of {', '.join(one['campaigns'])} is "
            f"{size} {side} {', '.join(one['others'])} (p = {one['p_value']:.1g}){rivals}: "
            + contradiction_words(one["what"], one.get("between", ()), one.get("events", ()))
            + _missed_words(one.get("missed", 0.0), one["unit"])
        )
    return out


def _missed_words(missed: float, unit: str) -> str:
    """Return what of the uncertainty of a contradiction is no chance; without it, a difference hardly beyond it has a tiny p."""
    return (
        f"; ± holds {shown_number(missed, 2)} {shown_unit(unit)} that laws may miss, and p is of what lies beyond"
        if missed
        else ""
    )


def _explanation_lines(result: Mapping[str, Any]) -> list[str]:
    """Return which effects would make a contradiction vanish."""
    return [f"{name} would explain what campaigns say of {what}" for name, what in result["explained"].items()]


def _settled_lines(result: Mapping[str, Any]) -> list[str]:
    """Return which groups one campaign leaves open and another settles."""
    words = {"agrees": "agrees with", "is a part": "is a part of it by", "refuted": "is ruled out by"}
    started = {one["campaign"]: one["started"][:10] for one in result["campaigns"]}
    out = []
    for one in result["settled"]:
        # What another day tells of a size that differs holds for a machine that did not change.
        others = {j["there"]["started"][:10] for j in one["judged"] if j["said"] != "agrees"}
        days = sorted({started.get(one["campaign"], ""), *others})
        unless = f", unless the machine changed between {days[0]} and {days[-1]}" if len(days) > 1 and days[0] else ""
        judged = ", ".join(f"{j['label']} {words[j['said']]} {j['there']['campaign']}" for j in one["judged"])
        left = " or ".join(one["left"]) or "none of them"
        out.append(
            f"settled: {one['campaign']} could not tell {', '.join(one['group'])}; it is {left} ({judged}){unless}"
        )
    # Of a diagnosis that was kept by a version before.
    if other := result.get("ruled_out"):
        out.append(f"ruled out, for tests at other conditions would need other sizes: {', '.join(other)}")
    return out
