"""The error of the tool point from the errors of three axes, to first order.

Workpiece, bed, X, Z, Y, tool. Letters as in ISO 230-1: ``EAZ2`` is the turn about the first linear
axis (A, about X) of the Z axis, second order in its travel; ``EX0`` a rigid shift. Displacements are in um,
turns in um/m, polynomials are Legendre's over the stroke, so that a coefficient is a size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

COEFFICIENTS = (
    "EX0",
    "EZ0",
    "EY0",
    "EA0",
    "EC0",
    "EB0",
    "EXX1",
    "EXX2",
    "EZX2",
    "EAX2",
    "EBX1",
    "EZZ1",
    "EZZ2",
    "EXZ1",
    "EXZ2",
    "EYZ2",
    "ECZ1",
    "EAZ1",
    "EYY1",
    "EYY2",
    "EZY1",
    "EZY2",
    "EXY1",
    "EXY2",
)
_MOVES, _TURNS, _AXES = "XYZ", "ABC", "XYZ"
_MOST_ORDER = 4
# What an axis' turn swings: everything that it carries, less the axis itself.
_CARRIED: Mapping[str, tuple[bool, bool, bool]] = {
    "X": (False, True, True),
    "Z": (False, True, False),
    "Y": (False, False, False),
    "0": (True, True, True),
}
_SEEN = 1e-9


@dataclass(frozen=True)
class _Coefficient:
    """A named error motion.

    ``name``: as in ISO 230-1, with the order.
    ``letter``: X, Y, Z for a displacement, A, B, C for a turn.
    ``axis``: axis that moves, or ``0`` for the whole machine.
    ``order``: order of the polynomial over the stroke.
    """

    name: str
    letter: str
    axis: str
    order: int

    @property
    def unit(self) -> str:
        """``um`` or ``um/m``."""
        return "um" if self.letter in _MOVES else "um/m"


def coefficient(name: str) -> _Coefficient:
    """Return a coefficient by name. Raises ``InputError`` when the name means nothing."""
    letters = name[1:2]
    rigid = len(name) == 3 and name[2:] == "0"
    moving = len(name) == 4 and name[2] in _AXES and name[3].isdigit()
    if name[:1] == "E" and letters and letters in _MOVES + _TURNS and (rigid or moving):
        order = 0 if rigid else int(name[3])
        if rigid or 1 <= order <= _MOST_ORDER:
            return _Coefficient(name, letters, "0" if rigid else name[2], order)
    raise InputError(
        "no such error motion",
        code="volumetric.coefficient",
        got=name[:20],
        allowed=f"E, a letter of XYZABC, and 0 or an axis with an order from 1 to {_MOST_ORDER}: EX0, EAZ2",
    )


def design(
    position_mm: Floats, strokes_mm: Mapping[str, tuple[float, float]], names: Sequence[str] = COEFFICIENTS
) -> Floats:
    """Return what a unit of each coefficient does to the tool point.

    ``position_mm``, (n, 3): positions x, y, z of the axes.
    ``strokes_mm``: ends of the stroke of ``x``, ``y`` and ``z``.
    Returns (n, 3, len(names)): um per unit.
    """
    position = np.asarray(position_mm, float)
    out = np.zeros((len(position), 3, len(names)))
    for column, name in enumerate(names):
        what = coefficient(name)
        profile = _profile(position, strokes_mm, what)
        if what.letter in _MOVES:
            out[:, _MOVES.index(what.letter), column] = profile
            continue
        arm_m = 1e-3 * position * np.array(_CARRIED[what.axis], dtype=float)
        turn = np.zeros(3)
        turn[_TURNS.index(what.letter)] = 1.0
        out[:, :, column] = np.cross(turn, arm_m) * profile[:, None]
    return out


def _profile(position: Floats, strokes_mm: Mapping[str, tuple[float, float]], what: _Coefficient) -> Floats:
    if what.axis == "0":
        return np.ones(len(position))
    low, high = strokes_mm[what.axis.lower()]
    travel = (2.0 * position[:, _AXES.index(what.axis)] - low - high) / (high - low)
    only = np.zeros(what.order + 1)
    only[what.order] = 1.0
    return np.asarray(np.polynomial.legendre.legval(travel, only))


@dataclass(frozen=True)
class Identifiability:
    """What a set of readings can tell.

    ``rank``, ``wanted``: of the columns less what the poses take up, and their number.
    ``condition``: condition number of the normalised columns.
    ``unseen``: coefficients that change nothing that is measured.
    ``entangled``: coefficients that others can imitate.
    """

    rank: int
    wanted: int
    condition: float
    unseen: tuple[str, ...]
    entangled: tuple[str, ...]


def identifiability(columns: Floats, names: Sequence[str]) -> Identifiability:
    """Say which coefficients readings can tell.

    ``columns``, (m, k): what each coefficient does to the readings, less what else is fitted.
    """
    size = np.linalg.norm(columns, axis=0)
    seen = size > _SEEN * max(float(size.max()), 1e-300)
    unit = columns[:, seen] / size[seen]
    values, vectors = np.linalg.svd(unit, full_matrices=False)[1:]
    weak = values < 1e-6 * values[0]
    kept = [name for name, there in zip(names, seen, strict=True) if there]
    in_null = np.abs(vectors[weak]).max(axis=0) > 1e-3 if weak.any() else np.zeros(len(kept), bool)
    return Identifiability(
        rank=int((~weak).sum()),
        wanted=len(names),
        condition=float(values[0] / values[-1]) if not weak.any() else float("inf"),
        unseen=tuple(n for n, there in zip(names, seen, strict=True) if not there),
        entangled=tuple(n for n, bad in zip(kept, in_null, strict=True) if bad),
    )
