"""Squareness as Klipper's skew correction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dtwin.errors import InputError
from dtwin.physics.twin import Twin
from dtwin.train.twin_axes import AXES, Motion, axis_errors_um
from dtwin.units import UM_PER_MM

EFFECT = "squareness"
_SIDE_MM = 100.0


def skews(twin: Twin) -> dict[str, float]:
    """Return by how much the angle of two axes is less than 90 degrees, in rad, by plane (XY, XZ, YZ).

    Raises
    ------
    InputError
        When the twin has no squareness.
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
    motion = Motion.steady(_SIDE_MM * np.eye(3), np.ones(3))
    slope = axis_errors_um(replace(twin, terms=terms), motion) / UM_PER_MM / _SIDE_MM
    # Which of two axes leans, nobody can see: the sum is the angle.
    measured = {"".join(sorted(t.instance.axis)) for t in terms}
    return {
        plane: float(
            slope[AXES.index(plane[0]), AXES.index(plane[1])] + slope[AXES.index(plane[1]), AXES.index(plane[0])]
        )
        for plane in ("XY", "XZ", "YZ")
        if plane in measured
    }


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
    head = [*said, "needs [skew_correction] in printer.cfg; keep it with SKEW_PROFILE SAVE=dtwin and SAVE_CONFIG"]
    return "".join(f"; {line}\n" for line in head) + f"SET_SKEW {' '.join(parts)}\n"
