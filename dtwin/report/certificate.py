"""A test sheet as a document to sign: what was tested with what, the decision, figures, pictures, and a place for the name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment

from dtwin.report.html import drawing, figure_html, sheet_style, told_figure
from dtwin.report.language import Language
from dtwin.report.sheet import headline_budget, number_of, overview
from dtwin.units import shown_unit

_FIGURE_PX, _ROUND_PX, _BESIDE_PX = 360, 420, 280
"""So that a picture and its table fit below the head of the first page; and beside each other."""
_PAGE = """<!doctype html>
<html lang="{{ language }}"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:">
<title>{{ say("Test certificate") }} {{ facts.campaign }}</title>
<style>
{{ sheet_style }}
body { font: 14px/1.4 system-ui, "DejaVu Sans", sans-serif; color: #14212b; margin: 0 auto; max-width: 182mm; padding: 1rem 0; }
h1 { font-size: 22px; margin: 0; } h2 { font-size: 16px; margin: 18px 0 6px; }
table { border-collapse: collapse; width: 100%; } td, th { padding: 3px 6px; border-bottom: 1px solid #d9e0e5; text-align: right; }
td:first-child, th:first-child { text-align: left; } td + td { white-space: nowrap; } td.from, th.from { white-space: normal; text-align: left; } .figures td:first-child { width: 100%; } th { color: #44525d; font-weight: 600; }
.overview { font-size: 9px; } .overview td, .overview th { padding: 3px 2px; white-space: normal; }
.beside { display: grid; grid-template-columns: 250px 1fr; align-items: start; } .beside h2 { grid-column: span 2; margin-bottom: 0; }
.beside table { font-size: 9.5px; } .beside td, .beside th { padding: 2.5px 3px; }
dl { display: grid; grid-template-columns: repeat(2, max-content 1fr); gap: 2px 12px; margin: 10px 0; } dt { color: #44525d; } dd { margin: 0; }
.decision { border: 2px solid #14212b; padding: 8px 12px; font-size: 17px; margin: 10px 0; } .note { color: #44525d; font-size: 12px; }
section { break-inside: avoid; } .sign { display: grid; grid-template-columns: 1fr 1fr; gap: 30px; margin-top: 46px; break-inside: avoid; }
.sign p { border-top: 1px solid #14212b; margin: 0; padding-top: 3px; } button { font: inherit; padding: 8px 14px; }
@media print { button { display: none; } body { padding: 0; max-width: none; font-size: 12px; } }
</style></head><body>
<button type="button" onclick="window.print()">{{ say("Print, or save as PDF") }}</button>
<h1>{{ say("Test certificate") }}: {{ facts.machine }}</h1>
<p class="decision">{{ say("Decision") }}{% if sheet.verdict %} {{ say("after ISO 14253-1") }}{% endif %}: <strong>{{ say(sheet.verdict or "no tolerance is stated") }}</strong><br>
<small>{{ tell(sheet.standard) }}</small></p>
<dl>{% for name, value in head %}<dt>{{ say(name) }}</dt><dd>{{ value or say("not stated") }}{% if name == "test" and runs %}, {{ runs }} {{ say("run" if runs == "1" else "runs") }}{% endif %}</dd>{% endfor %}</dl>
{% if parts|length > 1 %}<table class="overview"><thead><tr>{% for name in overview[0] %}<th>{{ say(name) }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in overview[1] %}<tr>{% for cell in row %}<td>{{ tell(cell) | replace("± ", "±&nbsp;"|safe) }}</td>{% endfor %}</tr>{% endfor %}</tbody></table>{% endif %}
{% for part in parts %}<section{% if beside %} class="beside"{% endif %}><h2>{{ tell(part.title) }}</h2>{{ part.figure|safe }}
<table class="figures"><thead><tr><th>{{ say("figure") }}</th><th>{{ say("value") }}, {{ unit }}</th><th>U&nbsp;(95&nbsp;%), {{ unit }}</th><th>{{ say("limit") }}, {{ unit }}</th><th>{{ say("decision") }}</th>{% if before %}<th>{{ say("before") }}, {{ unit }}</th><th>{{ say("change") }}, {{ unit }}</th>{% endif %}</tr></thead>
<tbody>{% for c in part.rows %}<tr><td>{{ c.symbol }} {{ say(c.name) }}</td><td>{{ tell(c.shown.value) }}</td><td>{{ tell(c.shown.expanded) }}</td><td>{{ tell(c.shown.limit) }}</td><td>{{ say(c.decision) or "-" }}</td>{% if before %}<td>{{ tell(c.before) }}</td><td>{{ tell(c.change) }}</td>{% endif %}</tr>{% endfor %}</tbody></table></section>
{% endfor %}
{% if budget %}<section><h2>{{ say("Uncertainty budget") }}: {{ tell(budget[0]) }}</h2>
<table><thead><tr><th>{{ say("contribution") }}</th><th>u (k = 1), {{ unit }}</th><th class="from">{{ say("from") }}</th></tr></thead>
<tbody>{% for row in budget[1] %}<tr><td>{{ tell(row[0]) }}</td><td>{{ tell(row[1]) }}</td><td class="from">{{ tell(row[2]) }}</td></tr>{% endfor %}</tbody></table></section>{% endif %}
<h2>{{ say("Quality of the data") }}</h2>
{% for severity, text, spoken in findings %}<p>{{ say(severity ~ ":") }} <span lang="{{ spoken }}">{{ text }}</span></p>{% else %}<p>{{ say("Nothing is wrong with the data.") }}</p>{% endfor %}
<p class="note">{{ tell(sheet.basis) }}{% for text, spoken in notes %} <span lang="{{ spoken }}">{{ text }}</span>{% endfor %}{% if before %} {{ say("Compared with") }} {{ before }}.{% endif %}{% if english %} {{ say("Notes are in English.") }}{% endif %}</p>
<div class="sign"><p>{{ say("operator") }}</p><p>{{ say("date and signature") }}</p></div>
{{ drawing|safe }}</body></html>
"""


def certificate_page(
    facts: Mapping[str, Any],
    sheet: Mapping[str, Any],
    figures: Sequence[go.Figure],
    findings: Sequence[tuple[str, str]],
    *,
    earlier: Mapping[str, Any] | None = None,
    language: str = "en",
) -> str:
    """Return the certificate as one HTML page that holds everything it shows, laid out for A4.

    ``facts``: ``campaign``, ``machine``, and what ``head_of`` shows.
    ``sheet``: as ``Sheet.as_dict`` gives it.
    ``figures``: of each part of the sheet.
    ``findings``, of (severity, text): about the runs.
    ``earlier``: ``campaign`` and ``sheet`` of the test before.
    ``language``: one of ``LANGUAGES``.
    """
    words = Language(language, (name for part in sheet["parts"] for name in part["runs"]))
    say, tell, spoken = words.say, words.tell, words.spoken
    findings_told = [(severity, *spoken(text)) for severity, text in findings]
    notes = [spoken(note) for note in sheet["notes"]]
    old = {} if earlier is None else _values(earlier["sheet"])
    # A round picture leaves room beside it: three conditions fit on a page.
    beside = len(figures) > 1 and not old and all(trace.type == "scatterpolar" for f in figures for trace in f.data)
    parts = [
        {
            "title": part["title"],
            # Parts of the same runs, as the speeds of a table, have one picture.
            "figure": ""
            if before is not None and before["runs"] == part["runs"]
            else figure_html(_told(figure, words, _BESIDE_PX if beside else _FIGURE_PX)),
            "rows": [_row(part, c, old) for c in part["characteristics"]],
        }
        for before, part, figure in zip([None, *sheet["parts"]], sheet["parts"], figures, strict=False)
    ]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            say=say,
            tell=tell,
            overview=overview(sheet),
            unit=shown_unit(sheet["unit"]),
            beside=beside,
            language=language,
            facts=facts,
            head=[(n, tell(facts.get(n, "")) if n == "temperature" else facts.get(n, "")) for n in _HEAD],
            runs=facts.get("runs", ""),
            sheet=sheet,
            budget=headline_budget(sheet),
            parts=parts,
            sheet_style=sheet_style(f"{say('Test certificate')}: {facts['machine']}, {facts['campaign']}"),
            findings=findings_told,
            notes=notes,
            english=language != "en" and any(told[-1] == "en" for told in [*findings_told, *notes]),
            before=earlier["campaign"] if earlier is not None and old else "",
            drawing=drawing(),
        )
    )


def _told(figure: go.Figure, words: Language, height_px: int) -> go.Figure:
    """Return a picture of that height in a language."""
    told = told_figure(figure, words.tell, words.point).update_layout(height=height_px)
    if height_px >= _FIGURE_PX:
        # The names of the rings of a small circle lie on each other.
        return told.update_layout(height=_ROUND_PX, margin={"t": 60}) if told.layout.polar.radialaxis.ticktext else told
    return told.update_layout(
        title_text=told.layout.title.text.replace(", ", ",<br>"),
        title_font_size=10,
        legend={"font_size": 9, "y": -0.2},
        margin={"t": 60, "b": 40, "l": 30, "r": 30},
        polar={"radialaxis_tickfont_size": 7, "angularaxis_tickfont_size": 9},
    )


_HEAD = (
    "machine",
    "instrument",
    "type",
    "certificate",
    "serial",
    "calibrated",
    "controller",
    "operator",
    "measured",
    "temperature",
    "test",
    "evaluated by",
)
"""Facts at the head of a certificate, two a line."""


def _values(sheet: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    return {(p["title"], c["symbol"]): number_of(c, "value") for p in sheet["parts"] for c in p["characteristics"]}


def _row(part: Mapping[str, Any], c: Mapping[str, Any], old: Mapping[tuple[str, str], float]) -> dict[str, Any]:
    digits = len(c["shown"]["value"].partition(".")[2])
    value = old.get((part["title"], c["symbol"]))
    change = ("-", "-") if value is None else (f"{value:z.{digits}f}", f"{number_of(c, 'value') - value:+z.{digits}f}")
    return {**c, "before": change[0], "change": change[1]}
