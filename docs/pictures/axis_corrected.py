"""Draw what corrections leave of a virtual lathe's error.

``python docs/pictures/axis_corrected.py MAPPED.json TWIN.json FILE.svg`` measures one day of the lathe of
mechanism: without a correction, with each of the two bundles in the loop, and with an exact map.
"""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path

import numpy as np

from dtwin.kinds.linear._evidence import ExactCorrection, evidence_plan, looped, measured
from dtwin.kinds.linear._simulate import virtual_lathe
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats
from dtwin.serve.bundle_file import load_bundle

WIDTH, HEIGHT, LEFT, TOP = 300, 170, 46, 66
GAP, BELOW, FOOTER = 60, 34, 60
COLOURS = {"up": "#0072B2", "down": "#D55E00"}
DAY = 7


def axis_picture(mapped: Path, twin: Path) -> str:
    """Return an SVG with the error over the travel, four panels, both directions."""
    lathe = virtual_lathe("mechanism", DAY)
    plan = evidence_plan((1.0, 40.0), 0.25, "virtual-lathe")
    tests = {
        "no correction": measured(lathe, plan),
        "dtwin lathe fit, 1561 targets": looped(lathe, plan, load_bundle(mapped).bundle).test,
        "dtwin twin correct, 76 targets": looped(lathe, plan, load_bundle(twin).bundle).test,
        "exact map": measured(lathe, plan, ExactCorrection(lathe)),
    }
    errors = {title: _both(test) for title, test in tests.items()}
    rms = {title: float(np.sqrt(np.mean(e**2))) for title, e in errors.items()}
    corrected = max(float(np.abs(e).max()) for e in list(errors.values())[1:])
    x_mm = tests["no correction"].position_mm
    parts = []
    for number, (title, error) in enumerate(errors.items()):
        reach = _rounded(corrected if number else float(np.abs(error).max()))
        parts += _panel(number, title, rms[title], x_mm, error, reach)
    width, height = LEFT + 2 * (WIDTH + GAP) - GAP // 2, 2 * (TOP + HEIGHT + BELOW) + FOOTER
    told = ", ".join(f"{title} {value:.1f}" for title, value in rms.items())
    note = (
        f"One day that no fit has seen, {len(x_mm)} targets, mean of both directions taken out. "
        "The first panel has its own scale."
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'width="{width}" height="{height}" font-family="sans-serif" role="img" '
            f'aria-label="Error over the travel, um RMS: {escape(told)}">',
            f'<rect width="{width}" height="{height}" fill="white"/>',
            *parts,
            *_legend(height - 40),
            f'<text x="{LEFT}" y="{height - 12}" font-size="12" fill="#555">{escape(note)}</text>',
            "</svg>\n",
        ]
    )


def _both(test: LinearTest) -> Floats:
    """Return the mean error of the runs up and down, (2, targets), without their common mean."""
    error = np.stack([test.forward_um.mean(axis=1), test.reverse_um.mean(axis=1)])
    return np.asarray(error - error.mean())


def _rounded(reach_um: float) -> float:
    return float(5.0 * np.ceil(reach_um / 5.0))


def _panel(number: int, title: str, rms_um: float, x_mm: Floats, error: Floats, reach_um: float) -> list[str]:
    left = LEFT + number % 2 * (WIDTH + GAP)
    top = number // 2 * (TOP + HEIGHT + BELOW) + TOP
    middle = top + HEIGHT / 2.0
    across = left + WIDTH * (x_mm - x_mm[0]) / (x_mm[-1] - x_mm[0])
    parts = [
        f'<text x="{left}" y="{top - 42}" font-size="14" fill="#333">{escape(title)}</text>',
        f'<text x="{left}" y="{top - 14}" font-size="22" font-weight="bold">{rms_um:.1f} µm RMS</text>',
        f'<rect x="{left}" y="{top}" width="{WIDTH}" height="{HEIGHT}" fill="none" stroke="#ccc"/>',
        f'<line x1="{left}" x2="{left + WIDTH}" y1="{middle:g}" y2="{middle:g}" stroke="#888" stroke-width="0.8"/>',
        *(
            f'<text x="{left - 6}" y="{middle - share * HEIGHT / 2.0 + 4:g}" font-size="11" '
            f'fill="#333" text-anchor="end">{share * reach_um:+g}</text>'
            for share in (1.0, -1.0)
        ),
        f'<text x="{left - 6}" y="{middle + 4:g}" font-size="11" fill="#333" text-anchor="end">0 µm</text>',
        f'<text x="{left}" y="{top + HEIGHT + 16}" font-size="11" fill="#333">{x_mm[0]:.0f} mm</text>',
        f'<text x="{left + WIDTH}" y="{top + HEIGHT + 16}" font-size="11" fill="#333" '
        f'text-anchor="end">{x_mm[-1]:.0f} mm</text>',
    ]
    for (way, colour), values in zip(COLOURS.items(), error, strict=True):
        y = middle - values / reach_um * HEIGHT / 2.0
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, y, strict=True))
        dash = ' stroke-dasharray="5 3"' if way == "down" else ""
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.6"{dash}/>')
    return parts


def _legend(y: float) -> list[str]:
    up, down = COLOURS.values()
    return [
        f'<line x1="{LEFT}" x2="{LEFT + 28}" y1="{y}" y2="{y}" stroke="{up}" stroke-width="2"/>',
        f'<text x="{LEFT + 34}" y="{y + 4}" font-size="12" fill="#333">going up</text>',
        f'<line x1="{LEFT + 114}" x2="{LEFT + 142}" y1="{y}" y2="{y}" stroke="{down}" '
        'stroke-width="2" stroke-dasharray="5 3"/>',
        f'<text x="{LEFT + 148}" y="{y + 4}" font-size="12" fill="#333">going down</text>',
    ]


if __name__ == "__main__":
    Path(sys.argv[3]).write_text(axis_picture(Path(sys.argv[1]), Path(sys.argv[2])), encoding="utf-8")
