"""Small plots as SVG, for pages that show Markdown and nothing else."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

import numpy as np

from dtwin.schema import Floats

COLOURS = ("#1f6fb2", "#c8541b", "#4c9a4c", "#8a5aa8")
_FLOOR = "#888888"
_WIDTH, _LEFT, _RIGHT = 720, 210, 90
_BAR, _GAP = 17, 7
_POINTS = 360


def markdown(title: str, svg: str) -> str:
    """Return a plot as a Markdown image that holds its own content.

    Args:
        title: Shown where images are not.
        svg: The plot.
    """
    data = base64.b64encode(svg.encode()).decode()
    return f"![{title}](data:image/svg+xml;base64,{data})"


def bars(
    title: str,
    rows: Sequence[tuple[str, Mapping[str, float]]],
    *,
    floor: float | None = None,
    longest: float | None = None,
) -> str:
    """Return horizontal bars, one group per row and one colour per series.

    Args:
        title: With the unit.
        rows: Label, and value by series.
        floor: Noise floor, drawn as a line.
        longest: Where bars are cut; a value beyond it is written out beside its bar.
    """
    series = list(dict.fromkeys(name for _, values in rows for name in values))
    finite = [v for _, values in rows for v in values.values() if math.isfinite(v)]
    top = longest or max([*finite, floor or 0.0, 1e-9])
    scale = (_WIDTH - _LEFT - _RIGHT) / top
    parts, y = [_text(10, 20, title, size=15)], 36.0
    if len(series) > 1:
        parts += _legend(series, y)
        y += 24
    first = y
    for label, values in rows:
        middle = y + 0.5 * _BAR * len(values)
        parts.append(_text(_LEFT - 8, middle + 4, label, anchor="end"))
        for name, value in values.items():
            colour = COLOURS[series.index(name) % len(COLOURS)]
            parts += _bar(y, scale * min(max(value, 0.0), top), value, colour)
            y += _BAR
        y += _GAP
    if floor is not None and math.isfinite(floor):
        x = _LEFT + scale * floor
        parts.append(
            f'<line x1="{x:z.1f}" y1="{first - 4}" x2="{x:z.1f}" y2="{y}" stroke="{_FLOOR}" stroke-dasharray="4 3"/>'
        )
        parts.append(_text(x, y + 14, f"noise floor {_short(floor)}", anchor="middle"))
        y += 18
    return _svg(_WIDTH, y + 8, parts)


def polar(title: str, curves: Mapping[str, tuple[Floats, Floats]]) -> str:
    """Return errors over the path angle as deviations from a circle.

    Args:
        title: What it shows.
        curves: Angles in degrees and errors in um, each of shape (n,).
    """
    largest = max([float(np.max(np.abs(e))) for _, e in curves.values() if e.size] or [1.0])
    step = _round_up(largest)
    centre, radius, reach = 190.0, 110.0, 60.0
    parts = [_text(10, 20, title, size=15)]
    for share, dash in ((-1.0, "2 4"), (0.0, "none"), (1.0, "2 4")):
        parts.append(
            f'<circle cx="{centre}" cy="{centre + 20}" r="{radius + share * reach:z.1f}" '
            f'fill="none" stroke="#bbbbbb" stroke-dasharray="{dash}"/>'
        )
    for i, (angle, error) in enumerate(curves.values()):
        keep = slice(None, None, max(1, len(angle) // _POINTS))
        theta, r = np.radians(angle[keep]), radius + reach * error[keep] / step
        x, y = centre + r * np.cos(theta), centre + 20 - r * np.sin(theta)
        points = " ".join(f"{a:z.1f},{b:z.1f}" for a, b in zip(x, y, strict=True))
        colour = COLOURS[i % len(COLOURS)]
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
    parts += _legend(list(curves), 400)
    parts.append(_text(centre, 392, f"rings: 0 and ±{step:g} µm", anchor="middle"))
    return _svg(380, 425, parts)


def _bar(y: float, width: float, value: float, colour: str) -> list[str]:
    if not math.isfinite(value):
        return [_text(_LEFT + 6, y + 12, "no number")]
    return [
        f'<rect x="{_LEFT}" y="{y:z.1f}" width="{width:z.1f}" height="{_BAR - 2}" fill="{colour}"/>',
        _text(_LEFT + width + 6, y + 12, _short(value)),
    ]


def _legend(names: Sequence[str], y: float) -> list[str]:
    parts, x = [], 20.0
    for i, name in enumerate(names):
        colour = COLOURS[i % len(COLOURS)]
        parts.append(f'<rect x="{x}" y="{y}" width="12" height="12" fill="{colour}"/>')
        parts.append(_text(x + 18, y + 11, name))
        x += 40 + 7 * len(name)
    return parts


def _text(x: float, y: float, text: str, *, size: int = 12, anchor: str = "start") -> str:
    return f'<text x="{x:z.1f}" y="{y:z.1f}" font-size="{size}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(width: int, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height:z.0f}" '
        f'viewBox="0 0 {width} {height:z.0f}" font-family="sans-serif" fill="#1a1a1a">'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{"".join(parts)}</svg>'
    )


def _short(value: float) -> str:
    return f"{value:z.1f}" if abs(value) < 1e4 else f"{value:.1e}"


def _round_up(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return min(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value)
