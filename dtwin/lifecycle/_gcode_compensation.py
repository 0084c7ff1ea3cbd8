"""A program whose points are moved by what the twin says the machine does wrong there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dtwin.errors import InputError
from dtwin.lifecycle.gcode_program import Move, Passed, read_program
from dtwin.physics.twin import Twin
from dtwin.schema import Floats
from dtwin.train.twin_axes import Motion, axis_errors_um
from dtwin.units import UM_PER_MM

_TOLERANCE_UM = 0.1
_MOST_CHORDS = 2**16
_JUMP_MM = 1e-5
# No wave of a screw hides between two points.
_LONGEST_CHORD_MM = 2.0
_MOST_POINTS = 2_000_000
# An axis that stands still keeps the side that it came from.
_CREEP_MM_S = 1e-9


@dataclass(frozen=True)
class _Compensated:
    """A compensated program.

    ``largest_um``: largest shift of a point.
    ``interpolation_um``: largest distance between the written chords and the compensated path, at their middles.
    ``outside``: evaluated points outside of the positions that were measured.
    """

    text: str
    points: int
    largest_um: float
    interpolation_um: float
    outside: int


def compensate(
    text: str, twin: Twin, *, origin_mm: Floats, where: str, tolerance_um: float = _TOLERANCE_UM
) -> _Compensated:
    """Move every point of a program against the predicted error.

    Lines and arcs become chords that stay within the tolerance of the compensated path; where an
    axis turns round, the point is taken twice, once for each side of its lost motion.

    ``twin``: reduced to what offsets can correct.
    ``origin_mm``: centre of the measured circles in the coordinates of the program, shape (3,).
    ``where``: name of the program, for messages.
    Raises ``InputError`` when the program says something that is not understood, or needs too many points.
    """
    work = _Work(twin, origin_mm, tolerance_um)
    lines = []
    for item in read_program(text, where):
        lines += [item.text] if isinstance(item, Passed) else work.move(item)
        if work.points > _MOST_POINTS:
            raise InputError(
                "the program needs too many points",
                code="gcode.size",
                where=where,
                got=f"more than {_MOST_POINTS}",
                hint="allow a larger --tolerance-um",
            )
    return _Compensated("\n".join(lines) + "\n", work.points, work.largest_um, work.interpolation_um, work.outside)


class Followed:
    """A program followed motion by motion: where the machine is, and from which side each axis comes.

    ``origin_mm``, (3,): centre of the measured circles in the coordinates of the program.
    """

    def __init__(self, origin_mm: Floats) -> None:
        self.origin_mm = origin_mm
        self.side = np.zeros(3)

    def turn(self, direction: Floats) -> None:
        """Let axes move in a direction, shape (3,); those that stand keep the side that they came from."""
        self.side = np.where(np.abs(direction) > 1e-9, np.sign(direction), self.side)

    def motion(self, move: Move, shares: Floats) -> Motion:
        """Return the motion at shares of the way (n,), from the centre of the measured circles."""
        points, speed = move.points(shares), move.feed_mm_min / 60.0
        # At a quadrant the axis that turns round has no speed, but a side.
        velocity = np.maximum(np.abs(move.directions(shares)) * speed, _CREEP_MM_S) * self.side
        # Of an axis that the program has not placed nothing is known; it counts as centred.
        here = np.where(move.known, points - self.origin_mm, 0.0)
        return Motion(here, velocity, _acceleration(move, points, speed))


def _acceleration(move: Move, points: Floats, speed: float) -> Floats:
    out = np.zeros(points.shape)
    if move.centre_mm is not None:
        plane = list(move.plane)
        spokes = points[:, plane] - move.centre_mm
        out[:, plane] = -(speed**2) * spokes / (spokes**2).sum(axis=1, keepdims=True)
    return out


def outside(twin: Twin, motion: Motion) -> int:
    """Return how many points of a motion lie further out than anything that the twin was fitted to."""
    reach = twin.box.radius_mm[1] * (1.0 + 1e-9)
    return int((np.abs(motion.position_mm).max(axis=1) > reach).sum())


class _Work:
    """What is remembered from motion to motion."""

    def __init__(self, twin: Twin, origin_mm: Floats, tolerance_um: float) -> None:
        self.twin, self.tolerance_um = twin, tolerance_um
        self.followed = Followed(origin_mm)
        self.points = self.outside = 0
        self.largest_um = self.interpolation_um = 0.0
        self.written = np.full(3, np.nan)

    def move(self, move: Move) -> list[str]:
        """Return the lines of one motion."""
        head, tail = [move.rest] if move.rest else [], [move.after] if move.after else []
        return [*head, *self._motion(move), *tail]

    def _motion(self, move: Move) -> list[str]:
        last = np.array([1.0])
        if move.rapid:
            self.followed.turn(move.directions(last)[0])
            return [self._line("G0", move, self._targets(move, last)[0])]
        if move.feed_mm_min <= 0.0:
            raise InputError("a motion has no feed", code="gcode.feed", where=f"line {move.line}", hint="add F")
        if move.started != move.known:
            # Where this motion begins is not known: its end is.
            self.followed.turn(np.where(move.started, move.directions(last)[0], 0.0))
            return [self._line("G1", move, self._targets(move, last)[0])]
        lines: list[str] = []
        for first, final in pairwise(move.quadrants()):
            self.followed.turn(move.directions(np.array([0.5 * (first + final)]))[0])
            begin, *chords = self._chords(move, first, final)
            if not np.all(np.abs(begin - self.written) < _JUMP_MM):
                lines.append(self._line("G1", move, begin))
            lines += [self._line("G1", move, target) for target in chords]
        return lines

    def _chords(self, move: Move, first: float, last: float) -> Floats:
        """Return the corners of chords within the tolerance, shape (n + 1, 3)."""
        n = max(1, math.ceil(move.length_mm * (last - first) / _LONGEST_CHORD_MM))
        while True:
            targets = self._targets(move, np.linspace(first, last, 2 * n + 1))
            gap = targets[1::2] - 0.5 * (targets[:-1:2] + targets[2::2])
            off_um = UM_PER_MM * float(np.linalg.norm(gap, axis=1).max())
            if off_um <= self.tolerance_um or n >= _MOST_CHORDS:
                self.interpolation_um = max(self.interpolation_um, off_um)
                return np.asarray(targets[::2])
            n *= 2

    def _targets(self, move: Move, shares: Floats) -> Floats:
        motion = self.followed.motion(move, shares)
        errors = axis_errors_um(self.twin, motion)
        self.largest_um = max(self.largest_um, float(np.linalg.norm(errors, axis=1).max()))
        self.outside += outside(self.twin, motion)
        return np.asarray(move.points(shares) - errors / UM_PER_MM)

    def _line(self, code: str, move: Move, target: Floats) -> str:
        self.points += 1
        self.written = target
        places = zip("XYZ", target.tolist(), move.known, strict=True)
        words = [f"{letter}{value:z.5f}" for letter, value, known in places if known]
        feed = [f"F{move.feed_mm_min:g}"] if code == "G1" else []
        return " ".join([code, *words, *feed])
