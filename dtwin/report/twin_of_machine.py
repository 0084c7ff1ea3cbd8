"""Twins that are told in words and tables, and of campaigns of several kinds, as text and as sections of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from dtwin.report.faults import with_k2
from dtwin.report.html import Part, Section, Table, told_section
from dtwin.report.text import gain_words, micrometres, table
from dtwin.report.twin_of_campaigns import contradiction_lines
from dtwin.report.twin_of_kind import report_of
from dtwin.report.twin_plots import ranked_figure, waterfall_figure
from dtwin.report.twins import history_table, number
from dtwin.units import shown_parameter


def twin_text(twin: Any) -> str:
    """Return a twin for the terminal: what is shared, and the twin of each fit."""
    document = twin.as_dict()
    head = (
        f"twin {twin.name} version {twin.version} ({twin.action}) of machine {twin.machine}, campaigns {twin.campaign}"
    )
    lines = [head, _as_text(campaign_table(document))]
    if document["shared"]:
        lines.append(_as_text(_shared_table(document)))
    lines += contradiction_lines(document)
    return "\n\n".join(["\n".join(lines), *(report_of(one.as_dict()).twin_text(one) for one in twin.members)])


def comparison_text(result: Mapping[str, Any]) -> str:
    """Return a comparison for the terminal, fit by fit."""
    parts = [report_of(one).comparison_text(one) for one in result["members"]]
    return "\n\n".join([*parts, *contradiction_lines(result)])


def diagnosis_text(name: str, result: Mapping[str, Any]) -> str:
    """Return a diagnosis for the terminal: what each fit lacks."""
    parts = [f"{', '.join(one['of'])}\n{report_of(one).diagnosis_text(name, one)}" for one in result["members"]]
    return "\n\n".join([*parts, *contradiction_lines(result)])


def diagnosis_section(name: str, result: Mapping[str, Any]) -> Section:
    """Return what is missing."""
    made = [report_of(one).diagnosis_section(name, one) for one in result["members"]]
    told = [("warning", line) for line in contradiction_lines(result)]
    return Section(
        "What is missing",
        [],
        [*(finding for one in made for finding in one.findings), *told],
        [t for one in made for t in one.tables],
        [figure for one in made for figure in one.figures],
        details=[said for one in made for said in one.details],
    )


def twin_section(twin: Any) -> Section:
    """Return the twin: what is shared, and the parameters of each fit."""
    document = twin.as_dict()
    made = [report_of(one.as_dict()).twin_section(one) for one in twin.members]
    told = [("warning", line) for line in contradiction_lines(document)]
    return Section(
        "The twin",
        [f"Version {twin.version} ({twin.action}) of {twin.campaign}."],
        [*told, *(finding for one in made for finding in one.findings)],
        [shown for _, shown in captioned(twin)],
    )


def captioned(twin: Any) -> list[tuple[str, Table]]:
    """Return the tables of a twin, each with what it is of."""
    document = twin.as_dict()
    out = [("What the twin leaves of each campaign", campaign_table(document))]
    if document["shared"]:
        out.append(("Sizes that several campaigns tell", _shared_table(document)))
    for one in twin.members:
        caption = f"Effects in {', '.join(one.campaigns)}, and their sizes"
        out += [(caption, shown) for shown in report_of(one.as_dict()).twin_section(one).tables[:1]]
    return out


def comparison_sections(comparison: Any, result: Mapping[str, Any]) -> list[Section]:
    """Return measured against predicted, fit by fit; without ``comparison`` as text."""
    if comparison is None:
        return [Section("Measured against predicted", code=[comparison_text(result)])]
    return [
        made
        if any(name in made.title for name in one["campaign"].split(", "))
        else replace(made, title=f"{made.title}: {one['campaign']}")
        for part, one in zip(comparison.parts, result["members"], strict=True)
        for made in report_of(one).comparison_sections(part, one)
    ]


def campaign_table(document: Mapping[str, Any]) -> Table:
    """Return what the twin leaves of each campaign."""
    rows = [
        (
            one["campaign"],
            one["kind"],
            one["started"][:10] or "-",
            micrometres(one["rms_before_um"]),
            micrometres(one["residual_rms_um"]),
            "-" if one["noise_floor_um"] is None else number(one["noise_floor_um"]),
        )
        for one in document["campaigns"]
    ]
    return Table(("campaign", "kind", "begun", "before, µm RMS", "left, µm RMS", "noise floor, µm"), rows)


def _shared_table(document: Mapping[str, Any]) -> Table:
    """Return the sizes that several fits tell, with what each says alone."""
    rows = [
        (
            f"{one['effect']} {one['axis']}".rstrip(),
            shown_parameter(one["parameter"]),
            _size(one),
            "; ".join(
                f"{', '.join(own['campaigns'])} {_size({**own, 'unit': one['unit']})}{' (contradicts)' if own['contradicts'] else ''}"
                for own in one["alone"]
            ),
        )
        for one in document["shared"]
    ]
    return Table(("one cause in several campaigns", "parameter", "size (k = 2)", "alone"), rows)


def _size(one: Mapping[str, Any]) -> str:
    return "not told" if one["value"] is None else with_k2(one["value"], one["uncertainty"], one["unit"])


def _as_text(shown: Table) -> str:
    return table(shown.head, shown.rows)


def candidate_table(candidates: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Return the table of what may be missing; nothing for none."""
    rows = [
        (c["label"], gain_words(c["cv_gain"]), f"{c['p_value']:.1g}", "yes" if c["in_group"] else "")
        for c in candidates
    ]
    return [Table(("effect", "gain held out", "p", "in group"), rows)] if rows else []


def missing_section(
    result: Mapping[str, Any], told: Sequence[Part], severity: str = "warning", said: str = ""
) -> Section:
    """Return a diagnosis for a report; ``told``: what the terminal is told."""
    figures = [ranked_figure(result)] if result["candidates"] else []
    headline = f"{result['verdict']}: {result['headline']}"
    return told_section(
        "What is missing",
        [part for part in told if part != headline],
        [(severity, said or result["headline"])],
        figures,
    )


def history_section(rungs: Sequence[Mapping[str, Any]]) -> Section:
    """Return the versions of a twin for a report."""
    figure = waterfall_figure(rungs, begun="no effects")
    return told_section("From version to version", [history_table(rungs)], figures=[figure])
