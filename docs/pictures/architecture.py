"""Draw the packages of dtwin and what they import: ``python docs/pictures/architecture.py``.

Writes ``architecture.svg`` beside itself. A line leads from a package down to one that it imports; what
follows from other lines is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import grimp

Edges = Mapping[str, set[str]]
BASE = "modules and records"
BASE_SAYS = "Single modules, from the lake down to units and errors, and the records of kinds."
WIDTH, HEIGHT, GAP, DROP, MARGIN, WORDS = 144, 30, 22, 34, 12, 640
PASSES = "->"
_RECORDS = ("registry", "kind", "machine")


def package_of(module: str) -> str:
    """Return the box of a module."""
    root, *parts = module.split(".")
    if root != "dtwin":
        return ".".join([root, *parts[:1]]) if parts[:1] == ["commands"] else root
    if parts and parts[0] == "kinds":
        return BASE if len(parts) == 1 or parts[1] in _RECORDS else "kinds"
    if parts in (["cli"], ["__main__"]):
        return "cli"
    return parts[0] if len(parts) > 1 or (parts and _is_package(parts[0])) else BASE


def _is_package(name: str) -> bool:
    return hasattr(import_module(f"dtwin.{name}"), "__path__")


def imports() -> dict[str, set[str]]:
    """Return what each box imports, by the import graph of the code."""
    # The cache of lint-imports may still hold modules that were moved.
    graph = grimp.build_graph("dtwin", "flows", "studies", exclude_type_checking_imports=True, cache_dir=None)
    box = {module: package_of(module) for module in graph.modules}
    found: dict[str, set[str]] = {name: set() for name in box.values()}
    for module in graph.modules:
        for target in graph.find_modules_directly_imported_by(module):
            if box[target] != box[module]:
                found[box[module]].add(box[target])
    return found


def levels(edges: Edges) -> dict[str, int]:
    """Return how many floors each box stands above the lowest.

    Raises:
        ValueError: When boxes import each other in a circle.
    """
    found: dict[str, int] = {}
    while len(found) < len(edges):
        ready = [n for n, targets in edges.items() if n not in found and targets <= set(found)]
        if not ready:
            raise ValueError(f"a circle among {', '.join(sorted(set(edges) - set(found)))}")
        found |= {n: 1 + max((found[t] for t in edges[n]), default=-1) for n in ready}
    return found


def needed(edges: Edges) -> list[tuple[str, str]]:
    """Return the imports that do not follow from others."""
    below: dict[str, set[str]] = {}
    for name in sorted(edges, key=levels(edges).__getitem__):
        below[name] = edges[name].union(*(below[target] for target in edges[name]))
    return sorted(
        (name, target)
        for name, targets in edges.items()
        for target in targets
        if not any(target in below[other] for other in targets - {target})
    )


def picture() -> str:
    """Return the drawing as SVG."""
    edges = imports()
    floor = levels(edges)
    ways = [_way(name, target, floor) for name, target in needed(edges)]
    # Where a line passes a floor it takes a place there, so that it runs behind no box.
    on_floor = floor | {stop: number for way in ways for stop, number in way}
    above = {stop: [a for way in ways for (a, _), (b, _) in pairwise(way) if b == stop] for stop in on_floor}
    top = max(floor.values())
    rows = [[stop for stop in on_floor if on_floor[stop] == number] for number in range(top + 1)]
    width = 2 * MARGIN + max(map(_row_width, rows))
    place: dict[str, tuple[float, float]] = {}
    for number in range(top, -1, -1):
        x = (width - _row_width(rows[number])) / 2
        y = MARGIN + (top - number) * (HEIGHT + DROP)
        means = {s: _mean([place[a][0] for a in above[s]], width / 2) for s in rows[number]}
        for stop in sorted(rows[number], key=lambda stop, means=means: (means[stop], stop)):
            place[stop] = (x + _width(stop) / 2, y)
            x += _width(stop) + GAP
    height = 2 * MARGIN + top * (HEIGHT + DROP) + HEIGHT
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width + WORDS} {height}" '
            f'width="{width + WORDS}" height="{height}" font-family="sans-serif" role="img" '
            'aria-label="Packages of dtwin and their imports, each above what it imports">',
            f'<rect width="{width + WORDS}" height="{height}" fill="white"/>',
            *(_line([place[stop] for stop, _ in way]) for way in ways),
            *(_box(name, place[name]) for name in sorted(floor)),
            *_words(width, height, sorted(floor, key=lambda name: place[name][::-1])),
            "</svg>\n",
        ]
    )


def _way(name: str, target: str, floor: Mapping[str, int]) -> list[tuple[str, int]]:
    """Return the stops of a line with their floors: both boxes, and a place on each floor between."""
    between = range(floor[name] - 1, floor[target], -1)
    stops = [(f"{name} {PASSES} {target} {number}", number) for number in between]
    return [(name, floor[name]), *stops, (target, floor[target])]


def _width(stop: str) -> int:
    return 0 if PASSES in stop else WIDTH


def _row_width(row: list[str]) -> int:
    return sum(map(_width, row)) + GAP * (len(row) - 1)


def _mean(values: list[float], otherwise: float) -> float:
    return sum(values) / len(values) if values else otherwise


def _line(stops: list[tuple[float, float]]) -> str:
    x, y = stops[0]
    path = f"M{x:g},{y + HEIGHT:g}"
    for x2, y2 in stops[1:]:
        bend = y2 - DROP / 2
        path += f" C{x:g},{bend:g} {x2:g},{bend:g} {x2:g},{y2:g} V{y2 + HEIGHT:g}"
        x = x2
    return f'<path d="{path}" fill="none" stroke="#8a97a8" stroke-width="1.2"/>'


def _box(name: str, middle: tuple[float, float]) -> str:
    x, y = middle
    return (
        f'<rect x="{x - WIDTH / 2:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" '
        'fill="#eef2f7" stroke="#33475b"/>'
        f'<text x="{x:g}" y="{y + HEIGHT / 2 + 4:g}" font-size="12.5" text-anchor="middle" '
        f'fill="#1a1a1a">{escape(name)}</text>'
    )


def _words(left: float, height: float, names: list[str]) -> list[str]:
    """Return what every box says of itself, from the highest down."""
    step = (height - 2 * MARGIN) / len(names)
    return [
        f'<text font-size="12" fill="#333" y="{MARGIN + (number + 0.5) * step:.1f}">'
        f'<tspan x="{left + GAP:g}" font-weight="bold">{escape(name)}</tspan>'
        f'<tspan x="{left + GAP:g}" dy="15">{escape(_says(name))}</tspan></text>'
        for number, name in enumerate(names)
    ]


def _says(name: str) -> str:
    """Return what a package says of itself in its first line."""
    if name == BASE:
        return BASE_SAYS
    module = name if name.partition(".")[0] in ("flows", "studies") else f"dtwin.{name}"
    return (import_module(module).__doc__ or "").partition("\n")[0]


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(picture(), encoding="utf-8")
