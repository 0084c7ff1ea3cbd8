"""A test sheet as a document to sign: what was tested with what, the decision, figures, pictures, and a place for the name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment
from plotly.offline import get_plotlyjs

from dtwin.report.html import figure_html
from dtwin.report.sheet import headline_budget

_GERMAN = {
    "Test certificate": "Prüfprotokoll",
    "Decision": "Entscheidung",
    "after ISO 14253-1": "nach ISO 14253-1",
    "inside": "innerhalb",
    "outside": "außerhalb",
    "cannot say": "nicht entscheidbar",
    "no tolerance is stated": "keine Toleranz angegeben",
    "machine": "Maschine",
    "type": "Typ",
    "serial": "Seriennummer",
    "controller": "Steuerung",
    "instrument": "Messgerät",
    "certificate": "Kalibrierschein",
    "calibrated": "kalibriert am",
    "operator": "Bediener",
    "temperature": "Temperatur",
    "measured": "gemessen",
    "test": "Messung",
    "runs": "Läufe",
    "evaluated by": "ausgewertet mit",
    "figure": "Kenngröße",
    "value": "Wert",
    "limit": "Grenze",
    "decision": "Entscheidung",
    "before": "zuvor",
    "change": "Änderung",
    "Quality of the data": "Güte der Daten",
    "Nothing is wrong with the data.": "An den Daten ist nichts auszusetzen.",
    "compared with": "verglichen mit",
    "not stated": "nicht angegeben",
    "date and signature": "Datum und Unterschrift",
    "Print, or save as PDF": "Drucken oder als PDF sichern",
    "Uncertainty budget": "Messunsicherheitsbilanz",
    "contribution": "Beitrag",
    "from": "Herkunft",
    "repeatability": "Wiederholbarkeit",
    "expansion": "Ausdehnungskoeffizient",
    "environment": "Umgebung (EVE)",
    "set-up": "Ausrichtung",
    "instrument's scale": "Maßstab des Messgeräts",
    "calibrated length": "kalibrierte Länge",
    "combined": "zusammen",
    "range of the drift": "Spanne der Verlagerung",
    "range in one hour": "Spanne in einer Stunde",
    "pose accuracy, largest": "Pose-Genauigkeit, größte",
    "pose accuracy, mean": "Pose-Genauigkeit, Mittel",
    "pose repeatability, largest": "Pose-Wiederholgenauigkeit, größte",
    "Notes are in English.": "Anmerkungen sind englisch.",
    "circular deviation, counter-clockwise": "Kreisformabweichung, gegen den Uhrzeigersinn",
    "circular deviation, clockwise": "Kreisformabweichung, im Uhrzeigersinn",
    "largest radial deviation": "größte Radialabweichung",
    "smallest radial deviation": "kleinste Radialabweichung",
    "bi-directional circular deviation": "Kreisformabweichung, beide Richtungen",
    "radial hysteresis": "radiale Hysterese",
    "mean bi-directional radial deviation": "mittlere Radialabweichung, beide Richtungen",
    "bi-directional accuracy": "Genauigkeit, beide Richtungen",
    "bi-directional repeatability": "Wiederholbarkeit, beide Richtungen",
    "accuracy, forward": "Genauigkeit, vorwärts",
    "accuracy, reverse": "Genauigkeit, rückwärts",
    "repeatability, forward": "Wiederholbarkeit, vorwärts",
    "repeatability, reverse": "Wiederholbarkeit, rückwärts",
    "systematic deviation, forward": "systematische Abweichung, vorwärts",
    "systematic deviation, reverse": "systematische Abweichung, rückwärts",
    "reversal error": "Umkehrspanne",
    "mean reversal error": "mittlere Umkehrspanne",
    "bi-directional systematic deviation": "systematische Abweichung, beide Richtungen",
    "mean bi-directional deviation": "Spanne der mittleren Abweichung",
}
_FIGURE_PX = 500
LANGUAGES: Mapping[str, Mapping[str, str]] = {"en": {}, "de": _GERMAN}
"""Words of a certificate by language; what is not there is English."""
_PAGE = """<!doctype html>
<html lang="{{ language }}"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:">
<title>{{ say("Test certificate") }} {{ facts.campaign }}</title>
<style>
@page { size: A4; margin: 14mm; }
body { font: 14px/1.4 system-ui, "DejaVu Sans", sans-serif; color: #14212b; margin: 0 auto; max-width: 182mm; padding: 1rem 0; }
h1 { font-size: 22px; margin: 0; } h2 { font-size: 16px; margin: 18px 0 6px; }
table { border-collapse: collapse; width: 100%; } td, th { padding: 3px 6px; border-bottom: 1px solid #d9e0e5; text-align: right; }
td:first-child, th:first-child { text-align: left; } td + td { white-space: nowrap; } td.from { white-space: normal; } th { color: #44525d; font-weight: 600; }
dl { display: grid; grid-template-columns: repeat(2, max-content 1fr); gap: 2px 12px; margin: 10px 0; } dt { color: #44525d; } dd { margin: 0; }
.decision { border: 2px solid #14212b; padding: 8px 12px; font-size: 17px; margin: 10px 0; } .note { color: #44525d; font-size: 12px; }
section { break-inside: avoid; } .sign { display: grid; grid-template-columns: 1fr 1fr; gap: 30px; margin-top: 46px; break-inside: avoid; }
.sign p { border-top: 1px solid #14212b; margin: 0; padding-top: 3px; } button { font: inherit; padding: 8px 14px; }
@media print { button { display: none; } body { padding: 0; max-width: none; } }
</style><script>{{ plotly|safe }}</script></head><body>
<button type="button" onclick="window.print()">{{ say("Print, or save as PDF") }}</button>
<h1>{{ say("Test certificate") }}: {{ facts.machine }}</h1>
<p class="decision">{{ say("Decision") }}{% if sheet.verdict %} {{ say("after ISO 14253-1") }}{% endif %}: <strong>{{ say(sheet.verdict or "no tolerance is stated") }}</strong><br>
<small>{{ sheet.standard }}</small></p>
<dl>{% for name, value in head %}<dt>{{ say(name) }}</dt><dd>{{ value or say("not stated") }}</dd>{% endfor %}</dl>
{% for part in parts %}<section><h2>{{ part.title }}</h2>{{ part.figure|safe }}
<table><thead><tr><th>{{ say("figure") }}</th><th>{{ say("value") }}, µm</th><th>U (95 %), µm</th><th>{{ say("limit") }}, µm</th><th>{{ say("decision") }}</th>{% if before %}<th>{{ say("before") }}, µm</th><th>{{ say("change") }}, µm</th>{% endif %}</tr></thead>
<tbody>{% for c in part.rows %}<tr><td>{{ c.symbol }} {{ say(c.name) }}</td><td>{{ c.shown.value }}</td><td>{{ c.shown.expanded }}</td><td>{{ c.shown.limit }}</td><td>{{ say(c.decision) or "-" }}</td>{% if before %}<td>{{ c.before }}</td><td>{{ c.change }}</td>{% endif %}</tr>{% endfor %}</tbody></table></section>
{% endfor %}
{% if budget %}<section><h2>{{ say("Uncertainty budget") }}: {{ budget[0] }}</h2>
<table><thead><tr><th>{{ say("contribution") }}</th><th>u (k = 1), µm</th><th>{{ say("from") }}</th></tr></thead>
<tbody>{% for row in budget[1] %}<tr><td>{{ say(row[0]) }}</td><td>{{ row[1] }}</td><td class="from">{{ row[2] }}</td></tr>{% endfor %}</tbody></table></section>{% endif %}
<h2>{{ say("Quality of the data") }}</h2>
{% for severity, text in findings %}<p>{{ severity }}: {{ text }}</p>{% else %}<p>{{ say("Nothing is wrong with the data.") }}</p>{% endfor %}
<p class="note">{{ sheet.basis }}{% for note in sheet.notes %} {{ note }}{% endfor %}{% if before %} {{ say("compared with") }} {{ before }}.{% endif %}{% if language != "en" %} {{ say("Notes are in English.") }}{% endif %}</p>
<div class="sign"><p>{{ say("operator") }}</p><p>{{ say("date and signature") }}</p></div>
</body></html>
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

    Parameters
    ----------
    facts : mapping
        ``campaign``, ``machine``, and what ``head_of`` shows.
    sheet : mapping
        As ``Sheet.as_dict`` gives it.
    figures : sequence of Figure
        Of each part of the sheet.
    findings : sequence of (severity, text)
        About the runs.
    earlier : mapping, optional
        ``campaign`` and ``sheet`` of the test before.
    language : str
        One of ``LANGUAGES``.
    """
    words = LANGUAGES[language]
    old = {} if earlier is None else _values(earlier["sheet"])
    parts = [
        {
            "title": part["title"],
            "figure": figure_html(figure),
            "rows": [_row(part, c, old) for c in part["characteristics"]],
        }
        for part, figure in zip(sheet["parts"], figures, strict=True)
    ]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            say=lambda word: words.get(word, word),
            language=language,
            facts=facts,
            head=[(name, facts.get(name, "")) for name in HEAD],
            sheet=sheet,
            budget=headline_budget(sheet),
            parts=parts,
            findings=findings,
            before=earlier["campaign"] if earlier is not None and old else "",
            plotly=get_plotlyjs(),
        )
    )


HEAD = (
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
    return {(p["title"], c["symbol"]): c["value_um"] for p in sheet["parts"] for c in p["characteristics"]}


def _row(part: Mapping[str, Any], c: Mapping[str, Any], old: Mapping[tuple[str, str], float]) -> dict[str, Any]:
    digits = len(c["shown"]["value"].partition(".")[2])
    value = old.get((part["title"], c["symbol"]))
    told = ("-", "-") if value is None else (f"{value:z.{digits}f}", f"{c['value_um'] - value:+z.{digits}f}")
    return {**c, "before": told[0], "change": told[1]}
