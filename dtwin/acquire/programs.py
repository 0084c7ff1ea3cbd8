"""Motion programs of a planned test: ball-bar G-code and URScript."""

from __future__ import annotations

import math

from dtwin.plan import PlannedTest, arc_deg, ends_deg
from dtwin.schema import Direction

_FEED_IN_MM = 1.5
# Of a UR: the centre of the circles in the base frame, and the length of the tool along the flange's z.
_UR_CENTRE_MM = (-550.0, 0.0, 75.0)
_UR_TCP_MM = 158.3
NO_DIAMETERS = "(X is the travel of the slide: on a lathe switch diameter programming off)"
"""Comment of a program that may run on a lathe, where X may be a diameter."""
_WORD = {"XY": ("G17", "X", "Y", "I", "J"), "YZ": ("G19", "Y", "Z", "J", "K"), "ZX": ("G18", "Z", "X", "K", "I")}


def gcode(test: PlannedTest, directions: tuple[Direction, ...] = ("CCW", "CW")) -> str:
    """Return the ball-bar program for a CNC, centre at the work zero.

    ``test``: full turns in XY; in upright planes half a turn over the top with 5 degrees at each end.
    ``directions``: directions in the order they are run.
    """
    plane_code, a, b, i, j = _WORD[test.plane]
    r, outside = test.radius_mm, test.radius_mm + _FEED_IN_MM
    lines = [
        "%",
        f"({test.test_id} {test.plane} R{r:g} F{test.feed_mm_min:g} {test.setup})",
        *([NO_DIAMETERS] if test.plane == "ZX" else []),
        f"G21 G90 G94 {plane_code}",
        f"G1 F{test.feed_mm_min:g}",
    ]
    for direction in directions:
        code = "G3" if direction == "CCW" else "G2"
        if test.plane == "XY":
            turns = round(arc_deg(test.plane) / 360.0)
            lines += [f"G1 {a}{outside:z.4f} {b}0", "M0 (load the bar)", f"G1 {a}{r:z.4f} {b}0"]
            lines += [f"{code} {a}{r:z.4f} {b}0 {i}{-r:z.4f} {j}0"] * turns
            lines += [f"G1 {a}{outside:z.4f} {b}0"]
        else:
            lines += _half_turn(test, direction, code)
    return "\n".join([*lines, "M30", "%", ""])


def _half_turn(test: PlannedTest, direction: Direction, code: str) -> list[str]:
    _, a, b, i, j = _WORD[test.plane]
    begin, end = ends_deg(test.plane)[:: 1 if direction == "CCW" else -1]

    def point(angle_deg: float, radius: float) -> tuple[float, float]:
        angle = math.radians(angle_deg)
        return radius * math.cos(angle), radius * math.sin(angle)

    outside, first = point(begin, test.radius_mm + _FEED_IN_MM), point(begin, test.radius_mm)
    last, away = point(end, test.radius_mm), point(end, test.radius_mm + _FEED_IN_MM)
    return [
        f"G1 {a}{outside[0]:z.4f} {b}{outside[1]:z.4f}",
        "M0 (load the bar)",
        f"G1 {a}{first[0]:z.4f} {b}{first[1]:z.4f}",
        f"{code} {a}{last[0]:z.4f} {b}{last[1]:z.4f} {i}{-first[0]:z.4f} {j}{-first[1]:z.4f}",
        f"G1 {a}{away[0]:z.4f} {b}{away[1]:z.4f}",
    ]


def urscript(test: PlannedTest, directions: tuple[Direction, ...] = ("CCW", "CW")) -> str:
    """Return the ball-bar program for a UR robot, by three-point half circles.

    Not yet run on a controller. The path data that a serving loop needs are written to output
    registers before each half circle.

    ``directions``: directions in the order they are run.
    """
    axes = {"XY": (0, 1), "YZ": (1, 2), "ZX": (2, 0)}[test.plane]
    speed = test.feed_mm_min / 60_000.0

    def pose(angle_deg: float, radius_mm: float) -> str:
        point = [c / 1000.0 for c in _UR_CENTRE_MM]
        point[axes[0]] += radius_mm / 1000.0 * math.cos(math.radians(angle_deg))
        point[axes[1]] += radius_mm / 1000.0 * math.sin(math.radians(angle_deg))
        return f"p[{point[0]:z.6f},{point[1]:z.6f},{point[2]:z.6f},3.141593,0,0]"

    lines = [f"def {test.test_id}():", f"  set_tcp(p[0,0,{_UR_TCP_MM / 1000.0:z.4f},0,0,0])"]
    for direction in directions:
        sign = 1 if direction == "CCW" else -1
        begin = 0.0 if test.plane == "XY" else ends_deg(test.plane)[0 if sign > 0 else 1]
        arcs = [180.0] * 4 if test.plane == "XY" else [arc_deg(test.plane)]
        lines += [
            f"  movel({pose(begin, test.radius_mm + _FEED_IN_MM)},1.2,0.25)",
            "  sleep(2.5)",
            f"  movel({pose(begin, test.radius_mm)},1.2,{speed:z.6f})",
        ]
        for number, arc in enumerate(arcs, start=1):
            via, end = begin + sign * arc / 2.0, begin + sign * arc
            lines += [
                f"  write_output_integer_register(12,{number})",
                f"  movec({pose(via, test.radius_mm)},{pose(end, test.radius_mm)},1.2,{speed:z.6f},0)",
            ]
            begin = end
        lines += [f"  movel({pose(begin, test.radius_mm + _FEED_IN_MM)},1.2,0.25)"]
    return "\n".join([*lines, "end", ""])
