"""Self-contained HTML pages: readable offline, nothing fetched."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache

import plotly.graph_objects as go
import plotly.io as pio
from jinja2 import Environment
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from dtwin.report.language import Language
from dtwin.report.plots import give_look
from dtwin.report.text import WIDE, table

# Plotly's own button would upload the chart to its cloud.
_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "modeBarButtonsToRemove": ["sendChartToCloud"],
    "plotlyServerURL": "",
}
_PAGE = """<!doctype html>
<html lang="{{ words.code }}"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:">
<title>{{ title }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; margin: 0 auto; max-width: 1100px; padding: 1.5rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; } h2 { margin-top: 2.2rem; border-top: 1px solid #ccc; padding-top: 1rem; }
table { border-collapse: collapse; font-size: .92rem; margin: .8rem 0; display: block; overflow-x: auto; }
th, td { padding: .25rem .5rem; text-align: right; border-bottom: 1px solid #e3e3e3; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { background: #f3f5f7; }
pre { background: #f6f7f8; padding: .8rem; overflow: auto; font-size: .82rem; max-height: 26rem; }
.note { color: #555; } .error { color: #a30000; } .warning { color: #8a5a00; }
.pair { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1rem; }
@media (max-width: 960px) { .pair { grid-template-columns: minmax(0, 1fr); } }
button { font: inherit; padding: 8px 14px; }
{{ sheet }}
@media print { button { display: none; } body { padding: 0; max-width: none; font-size: 12px; } .pair { display: block; } .pair > div { zoom: .85; } section > div > div { break-inside: avoid; } .slider-container { display: none; }
 table { display: table; font-size: 9px; } th, td { white-space: normal; padding: 2px 3px; } tr { break-inside: avoid; } h2, h2 + p { break-after: avoid; } pre { max-height: none; white-space: pre-wrap; font-size: 8px; } }
</style></head><body>
<button type="button" onclick="window.print()">{{ words.say("Print, or save as PDF") }}</button>
<h1>{{ title }}</h1><p class="note">{{ subtitle }}</p>
{% for section in sections %}<section><h2>{{ section.title }}</h2>
{% for text, spoken in section.paragraphs %}<p lang="{{ spoken }}">{{ text }}</p>{% endfor %}
{% for kind, (text, spoken) in section.findings %}<p class="{{ kind }}"><strong>{{ words.say(kind ~ ":") }}</strong> <span lang="{{ spoken }}">{{ text }}</span></p>{% endfor %}
{% for table in section.tables %}<table><thead><tr>{% for cell in table.head %}<th scope="col">{{ words.cell(cell) }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in table.rows %}<tr>{% for cell in row %}<td>{{ words.cell(cell|string) }}</td>{% endfor %}</tr>{% endfor %}</tbody></table>{% endfor %}
{% if section.figures %}<div{% if section.figures|length > 1 %} class="pair"{% endif %}>{% for figure in section.figures %}<div>{{ figure|safe }}</div>{% endfor %}</div>{% endif %}
{% for text, spoken in section.details %}<p lang="{{ spoken }}">{{ text }}</p>{% endfor %}
{% for text in section.code %}<pre lang="en">{{ text }}</pre>{% endfor %}
</section>{% endfor %}
{% if english %}<p class="note">{{ words.say("Notes are in English.") }}</p>{% endif %}
{{ drawing|safe }}</body></html>
"""
_DRAWING = """<script type="application/gzip" id="drawing">%s</script><script>
const packed = Uint8Array.from(atob(document.getElementById("drawing").textContent), (sign) => sign.charCodeAt(0));
const pictures = document.querySelectorAll("script[type='application/vnd.plotly.v1+json']");
async function draw() {
  const unpacked = new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip")));
  document.head.append(Object.assign(document.createElement("script"), { textContent: await unpacked.text() }));
  for (const { parentElement, textContent } of pictures) await Plotly.newPlot(parentElement, JSON.parse(textContent));
}
draw().catch((error) => pictures.forEach(({ parentElement }) => parentElement.append(`This browser does not draw the picture: ${error}`)));
</script>
"""


@dataclass(frozen=True)
class Table:
    """A table of a page; cells are texts or whole numbers."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | int]]


Part = str | Table
"""A line of what is told, or a table in its place."""


def parts_text(parts: Iterable[Part]) -> str:
    """Return what is told for the terminal."""
    return "\n".join(part if isinstance(part, str) else table(part.head, part.rows, WIDE) for part in parts)


@dataclass(frozen=True)
class Section:
    """A part of a page.

    ``findings``, of (severity, text): shown in the colour of their severity.
    ``code``: shown as they are.
    ``details``: paragraphs below all else.
    """

    title: str
    paragraphs: Sequence[str] = ()
    findings: Sequence[tuple[str, str]] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[go.Figure] = ()
    code: Sequence[str] = field(default_factory=tuple)
    details: Sequence[str] = ()


def told_section(
    title: str, parts: Iterable[Part], findings: Sequence[tuple[str, str]] = (), figures: Sequence[go.Figure] = ()
) -> Section:
    """Return a part of a page of what a terminal is told; what a finding says is not said again."""
    parts, said = list(parts), {text for _, text in findings}
    lines = [line.strip() for part in parts if isinstance(part, str) for line in part.split("\n")]
    tables = [part for part in parts if isinstance(part, Table)]
    return Section(title, [], findings, tables, figures, details=[line for line in lines if line not in said])


def page(title: str, subtitle: str, sections: Sequence[Section], words: Language | None = None) -> str:
    """Return one HTML page that holds everything it shows; text is escaped: names from files cannot become markup.

    ``words``: the language, English without; what its catalogue does not know, and ``code``, stay English.
    """
    words = words or Language()

    def spoken(section: Section) -> set[str]:
        texts = (*section.paragraphs, *section.details, *(said for _, said in section.findings))
        return {words.read(text)[1] for text in texts}

    rendered = [
        {
            "title": words.cell(s.title),
            "paragraphs": [words.read(text) for text in s.paragraphs],
            "findings": [(severity, words.read(text)) for severity, text in s.findings],
            "tables": s.tables,
            "figures": [figure_html(told_figure(figure, words.drawn, words.point)) for figure in s.figures],
            "code": s.code,
            "details": [words.read(text) for text in s.details],
        }
        for s in sections
    ]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            title=words.cell(title),
            sheet=sheet_style(words.cell(title)),
            subtitle=words.cell(subtitle),
            sections=rendered,
            words=words,
            english=words.code != "en" and any(s.code or "en" in spoken(s) for s in sections),
            drawing=drawing(),
        )
    )


def sheet_style(told: str) -> Markup:
    """Return the style of printed sheets: what they are of, and which of how many, at the foot of each."""
    # As codes, a name from a file cannot end the text.
    text = "".join(sign if sign.isalnum() else f"\\{ord(sign):x} " for sign in told)
    of = 'counter(page) " / " counter(pages)'
    look = "font: 9px system-ui, sans-serif; color: #555;"
    return Markup(
        f'@page {{ size: A4; margin: 14mm 14mm 16mm; @bottom-left {{ content: "{text}"; {look} }} '
        f"@bottom-right {{ content: {of}; {look} }} }}"
    )


def told_figure(figure: go.Figure, tell: Callable[[str], str], point: str = ".") -> go.Figure:
    """Return a figure whose title, axes, names and notes are translated by ``tell``, and with that decimal point."""
    layout = figure.layout.to_plotly_json()
    layout.pop("template", None)
    told = go.Figure(figure.data, layout).update_layout(separators=",." if point == "," else ".,")
    give_look(told)
    told.update_layout(title_text=tell(told.layout.title.text or ""))
    told.for_each_trace(lambda trace: trace.update(name=trace.name and tell(trace.name)))
    told.for_each_annotation(lambda note: note.update(text=tell(note.text or "")))
    for axes in (told.for_each_xaxis, told.for_each_yaxis):
        axes(lambda axis: axis.update(title_text=tell(axis.title.text or "")))
    for slider in told.layout.sliders:
        slider.currentvalue.prefix = tell(slider.currentvalue.prefix or "")
    for bars in told.select_traces({"type": "bar"}):
        across = "y" if bars.orientation == "h" else "x"
        bars[across] = [tell(name) if isinstance(name, str) else name for name in bars[across]]
        bars.text = [tell(one) for one in bars.text or ()] or None
    return told


def figure_html(figure: go.Figure) -> str:
    """Return a figure for a page that ends with :func:`drawing`."""
    told = f'{pio.to_json(figure, validate=False)[:-1]},"config":{json.dumps(_CONFIG)}}}'.replace("<", "\\u003c")
    return f'<div><script type="application/vnd.plotly.v1+json">{told}</script></div>'


@cache
def drawing() -> str:
    """Return the end of a page with figures: Plotly's script, packed to a third of its size, and what draws with it."""
    return _DRAWING % base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()
