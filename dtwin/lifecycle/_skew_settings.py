"""Squareness as Klipper's skew correction, and with the scales of the axes as settings of RepRapFirmware (Duet).

Read in the firmware's own sources: ``klippy/extras/skew_correction.py`` subtracts its factors, the tangents by which angles
are less than 90 degrees; RepRapFirmware (3.5 and 3.6, ``Move::AxisTransform``) adds its tangents, positive where an angle is
more, after it has multiplied by the factors of M579. Both leave alone what a command does not name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.train.twin_axes import AXES, Motion, axis_errors_um
from dtwin.units import UM_PER_MM

EFFECT, _SCALE = "squareness", "scale_mismatch"
HELD = {"klipper": (EFFECT,), "reprap": (EFFECT, _SCALE)}
"""Effects that a form holds."""
_SIDE_MM = 100.0
_REPRAP = (
    "RepRapFirmware (Duet), for config.g. The values replace those that were in force while it was measured: measure with",
    "M556 S100 X0 Y0 Z0 and M579 X1 Y1 Z1. M556 adds a tangent, positive for an angle of more than 90 degrees; M579 multiplies.",
)
_KLIPPER = (
    "needs [skew_correction] in printer.cfg; keep it with SKEW_PROFILE SAVE=dtwin and SAVE_CONFIG. Klipper loads no profile by",
    "itself: SKEW_PROFILE LOAD=dtwin after homing, in each program. It replaces what was in force while it was measured: measure",
    "with SET_SKEW CLEAR=1.",
)


def skews(twin: Twin) -> dict[str, float]:
    """Return by how much the angle of two axes is less than 90 degrees, in rad, by plane (XY, XZ, YZ).

    Raises ``InputError`` when the twin has no squareness.
    """
    terms = tuple(t for t in twin.terms if t.instance.effect.name == EFFECT)
    if not terms:
        raise InputError(
            "the twin has no squareness to correct",
            code="export.skew",
            where=twin.name,
            got=", ".join(t.label for t in twin.terms) or "no effects",
            allowed=EFFECT,
            hint="dtwin twin discover NAME",
        )
    slope = _slope(replace(twin, terms=terms))
    # Which of two axes leans, nobody can see: the sum is the angle.
    measured = {"".join(sorted(t.instance.axis)) for t in terms}
    return {
        plane: float(
            slope[AXES.index(plane[0]), AXES.index(plane[1])] + slope[AXES.index(plane[1]), AXES.index(plane[0])]
        )
        for plane in ("XY", "XZ", "YZ")
        if plane in measured
    }


def _slope(twin: Twin) -> Floats:
    """Return the error of an axis (second index) for a motion along another (first), shape (3, 3)."""
    motion = Motion.steady(_SIDE_MM * np.eye(3), np.ones(3))
    return axis_errors_um(twin, motion) / UM_PER_MM / _SIDE_MM


def reprap_settings(twin: Twin, said: Sequence[str]) -> tuple[str, dict[str, float]]:
    """Return the commands M556 (skew) and M579 (scale of the axes) for RepRapFirmware, and their values.

    Raises ``InputError`` when the twin has neither squareness nor scale.
    """
    terms = tuple(t for t in twin.terms if t.instance.effect.name == _SCALE)
    square = any(t.instance.effect.name == EFFECT for t in twin.terms)
    by_plane = skews(twin) if square or not terms else {}
    scale = np.diag(_slope(replace(twin, terms=terms))) if terms else np.zeros(3)
    lines = [*(f"; {line}" for line in (*said, *_REPRAP))]
    if by_plane:
        letters = {"XY": "X", "YZ": "Y", "XZ": "Z"}
        sides = [f"{letter}{-_SIDE_MM * by_plane[p]:z.6f}" for p, letter in letters.items() if p in by_plane]
        lines.append(f"M556 S{_SIDE_MM:g} " + " ".join(sides))
    if terms:
        measured = (axis for axis in AXES if any(axis in plane for plane in twin.box.planes))
        lines.append("M579 " + " ".join(f"{axis}{1.0 / (1.0 + scale[AXES.index(axis)]):z.8f}" for axis in measured))
    return "\n".join(lines) + "\n", by_plane | {f"scale {a}": float(s) for a, s in zip(AXES, scale, strict=True) if s}


def klipper_settings(by_plane: dict[str, float], said: Sequence[str]) -> str:
    """Return the command for Klipper's module ``skew_correction``.

    It takes the diagonals AC and BD and the side AD of a measured parallelogram; these are of one with sides of 100 mm.
    ``by_plane``: from ``skews``.
    ``said``: comments for the head.
    """
    parts = []
    for plane, skew in by_plane.items():
        cosine = math.sin(math.atan(skew))
        lengths = (math.sqrt(2.0 + 2.0 * cosine), math.sqrt(2.0 - 2.0 * cosine), 1.0)
        parts.append(f"{plane}=" + ",".join(f"{_SIDE_MM * length:z.7f}" for length in lengths))
    return "".join(f"; {line}\n" for line in (*said, *_KLIPPER)) + f"SET_SKEW {' '.join(parts)}\n"
