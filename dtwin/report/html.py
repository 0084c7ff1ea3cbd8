"""Self-contained HTML pages: readable offline, nothing fetched."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import plotly.graph_objects as go
import plotly.io as pio
from jinja2 import Environment
from plotly.offline import get_plotlyjs

# Plotly's own button would upload the chart to its cloud.
_CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "modeBarButtonsToRemove": ["sendChartToCloud"],
    "plotlyServerURL": "",
}
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
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
@media print { .pair { display: block; } h2 { break-before: auto; } }
</style></head><body>
<h1>{{ title }}</h1><p class="note">{{ subtitle }}</p>
{% for section in sections %}<section><h2>{{ section.title }}</h2>
{% for text in section.paragraphs %}<p>{{ text }}</p>{% endfor %}
{% for kind, text in section.findings %}<p class="{{ kind }}"><strong>{{ kind }}</strong>: {{ text }}</p>{% endfor %}
{% for table in section.tables %}<table><thead><tr>{% for cell in table.head %}<th scope="col">{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in table.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>{% endfor %}</tbody></table>{% endfor %}
{% if section.figures %}<div{% if section.figures|length > 1 %} class="pair"{% endif %}>{% for figure in section.figures %}<div>{{ figure|safe }}</div>{% endfor %}</div>{% endif %}
{% for text in section.code %}<pre>{{ text }}</pre>{% endfor %}
</section>{% endfor %}
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
    """A table of a page; cells are text already."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A part of a page.

    ``findings``, of (severity, text): shown in the colour of their severity.
    ``code``: shown as they are.
    """

    title: str
    paragraphs: Sequence[str] = ()
    findings: Sequence[tuple[str, str]] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[go.Figure] = ()
    code: Sequence[str] = field(default_factory=tuple)


def page(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """Return one HTML page that holds everything it shows; text is escaped: names from files cannot become markup."""
    rendered = [
        {
            "title": s.title,
            "paragraphs": s.paragraphs,
            "findings": s.findings,
            "tables": s.tables,
            "figures": [figure_html(figure) for figure in s.figures],
            "code": s.code,
        }
        for s in sections
    ]
    template = Environment(autoescape=True).from_string(_PAGE)
    return template.render(title=title, subtitle=subtitle, sections=rendered, drawing=drawing())


def figure_html(figure: go.Figure) -> str:
    """Return a figure for a page that ends with :func:`drawing`."""
    told = json.dumps({**json.loads(pio.to_json(figure)), "config": _CONFIG}).replace("<", "\\u003c")
    return f'<div><script type="application/vnd.plotly.v1+json">{told}</script></div>'


@cache
def drawing() -> str:
    """Return the end of a page with figures: Plotly's script, packed to a third of its size, and what draws with it."""
    return _DRAWING % base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()
