"""Draw how the error of a twin fell: ``python docs/pictures/residual_falls.py TWIN FILE.svg``.

Reads what ``dtwin twin fit`` and ``dtwin twin add`` have stored under ``DTWIN_HOME``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np

from dtwin.config import home
from dtwin.physics.localise import condition_means
from dtwin.physics.twin import frozen_residual_um
from dtwin.schema import Floats
from dtwin.statistics import deviation_interval
from dtwin.twins.measured import load
from dtwin.twins.verbs import Twins

PANEL, RADIUS, PX_PER_UM = 300, 88, 11.0
HEADER, FOOTER = 62, 50
GREYS = ("#eee", "#ddd", "#ccc")
COLOURS = {"CCW": "#0072B2", "CW": "#D55E00"}
ANGLE_RAD = np.deg2rad(np.arange(360) + 0.5)


def residual_picture(name: str) -> str:
    """Return an SVG with one polar plot for every version of a twin.

    Shown are both directions of the condition with the largest error, averaged over its repeats,
    all panels at one magnification.
    """
    twins = Twins(home())
    rungs = twins.history(name)
    newest = twins.newest(name)
    obs = load(twins.home, newest.campaign).obs
    versions = [twins.newest(name, r["version"]) for r in rungs]
    fields = [condition_means(obs, frozen_residual_um(t, obs)) for t in (replace(newest, terms=()), *versions)]
    worst = obs.conditions[int(np.argmax((fields[0] ** 2).mean(axis=1)))]
    shown = {
        c.direction: i
        for i, c in enumerate(obs.conditions)
        if (c.plane, c.radius_mm, c.feed_mm_min) == (worst.plane, worst.radius_mm, worst.feed_mm_min)
    }
    first = versions[0]
    known = ", ".join(dict.fromkeys(term.instance.effect.name.replace("_", " ") for term in first.terms))
    titles = ["as measured", f"fitted: {known}", *(r["action"] for r in rungs[1:])]
    rms_um = [rungs[0]["rms_before_um"], *(r["rms_after_um"] for r in rungs)]
    floor_um = float(newest.figures["noise_floor_um"])
    band_um = deviation_interval(floor_um, newest.figures["noise_floor_dof"])
    panels = [
        _panel(column, title, rms, (floor_um, *band_um), {str(d): field[i] for d, i in shown.items()})
        for column, (title, rms, field) in enumerate(zip(titles, rms_um, fields, strict=True))
    ]
    width, height = PANEL * len(panels), HEADER + PANEL + FOOTER
    note = (
        f"{worst.plane}, radius {worst.radius_mm:g} mm, {worst.feed_mm_min:g} mm/min, mean of the "
        f"repeats, centre and radius taken out; the figures are over all {len(obs.y_um)} runs"
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'width="{width}" height="{height}" font-family="sans-serif" role="img" '
            f'aria-label="The error falls: {", ".join(f"{r:.2f}" for r in rms_um)} um RMS">',
            f'<rect width="{width}" height="{height}" fill="white"/>',
            *panels,
            *_legend(height - FOOTER + 14, floor_um, band_um),
            f'<text x="16" y="{height - 12}" font-size="12" fill="#555">{escape(note)}</text>',
            "</svg>\n",
        ]
    )


def _panel(column: int, title: str, rms_um: float, floors_um: tuple[float, ...], curves: dict[str, Floats]) -> str:
    middle, down = PANEL * column + PANEL / 2, HEADER + PANEL / 2
    centre = f'cx="{middle:g}" cy="{down:g}"'
    parts = [
        f'<text x="{middle:g}" y="24" font-size="14" fill="#333" text-anchor="middle">{escape(title)}</text>',
        f'<text x="{middle:g}" y="52" font-size="22" font-weight="bold" text-anchor="middle">'
        f"{rms_um:.2f} µm RMS</text>",
        *(
            f'<circle {centre} r="{RADIUS}" fill="none" stroke="{colour}" '
            f'stroke-width="{2 * width_um * PX_PER_UM:.1f}"/>'
            for colour, width_um in zip(GREYS, sorted(floors_um, reverse=True), strict=True)
        ),
        f'<circle {centre} r="{RADIUS}" fill="none" stroke="#888" stroke-width="0.8"/>',
    ]
    for direction, curve in sorted(curves.items()):
        radius = RADIUS + PX_PER_UM * curve
        x, y = middle + radius * np.cos(ANGLE_RAD), down - radius * np.sin(ANGLE_RAD)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
        dash = ' stroke-dasharray="7 3"' if direction == "CW" else ""
        parts.append(f'<polygon points="{points}" fill="none" stroke="{COLOURS[direction]}" stroke-width="1.8"{dash}/>')
    return "\n".join(parts)


def _legend(y: float, floor_um: float, band_um: tuple[float, float]) -> list[str]:
    text = f'y="{y + 4:g}" font-size="12" fill="#333"'
    line = f'y1="{y:g}" y2="{y:g}" stroke-width="2"'
    scale = 5.0 * PX_PER_UM
    return [
        f'<line x1="16" x2="44" {line} stroke="{COLOURS["CCW"]}"/>',
        f'<text x="50" {text}>counter-clockwise</text>',
        f'<line x1="176" x2="204" {line} stroke="{COLOURS["CW"]}" stroke-dasharray="7 3"/>',
        f'<text x="210" {text}>clockwise</text>',
        f'<line x1="290" x2="318" y1="{y:g}" y2="{y:g}" stroke="#ddd" stroke-width="11"/>',
        f'<text x="324" {text}>noise floor {floor_um:.2f} µm, {band_um[0]:.2f} to {band_um[1]:.2f} at 95 %</text>',
        f'<line x1="590" x2="{590 + scale:g}" {line} stroke="#333"/>',
        f'<text x="{598 + scale:g}" {text}>5 µm of error</text>',
    ]


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(residual_picture(sys.argv[1]), encoding="utf-8")
