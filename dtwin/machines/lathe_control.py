"""A control that runs a positioning program: blocks become positions over time."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Floats

_SETTLE_S = 0.3
# What an operator takes to zero the laser, and to start the machine again: the laser takes its first
# reading in between.
_ZEROING_S, _RESUME_S = 20.0, 10.0
_WORD = re.compile(r"([A-Z])\s*(-?\d+\.?\d*|-?\.\d+)")


@dataclass(frozen=True)
class Motion:
    """Commanded positions of one axis over time, straight between knots.

    ``t_s``, ``position_mm``, shape (knots,): times and positions; a halt is two knots at one position.
    ``zeroed_s``: when the operator zeroed the laser, during the first program stop.
    """

    t_s: Floats
    position_mm: Floats
    zeroed_s: float

    def at(self, t_s: Floats) -> Floats:
        """Return commanded positions in mm at times, shape (n,)."""
        return np.interp(t_s, self.t_s, self.position_mm)


def run_program(text: str, axis: str) -> Motion:
    """Run a program on one axis.

    ``text``: moves in machine coordinates with feed, dwells, stops; inch or metric by G70/G20 or G71/G21. Anything that
    would move otherwise is refused.
    Raises ``InputError`` when a block is not understood, or the axis moves without a feed.
    """
    state = _State(axis)
    for number, line in enumerate(text.splitlines(), start=1):
        state.block(line, number)
    if len(state.t_s) < 2:
        raise InputError("the program moves nothing", code="lathe.program", got=f"axis {axis}")
    zeroed = state.zeroed_s if state.zeroed_s is not None else state.t_s[0]
    return Motion(np.array(state.t_s), np.array(state.position), zeroed)


class _State:
    def __init__(self, axis: str) -> None:
        self.axis = axis
        self.mm = 1.0
        self.feed_mm_s = 0.0
        self.t_s: list[float] = []
        self.position: list[float] = []
        self.zeroed_s: float | None = None

    def block(self, line: str, number: int) -> None:
        code = re.sub(r"\([^)]*\)", "", line).strip().upper()
        if not code or code == "%":
            return
        words = _WORD.findall(code)
        if re.sub(r"\s", "", "".join(a + b for a, b in words)) != re.sub(r"\s", "", code):
            raise self._refused(line, number)
        named = [(letter, float(value)) for letter, value in words]
        codes = {value for letter, value in named if letter == "G"}
        self._units(codes)
        values = {letter: value for letter, value in named if letter not in "GM"}
        if 4.0 in codes:
            self._halt(values.get("F", values.get("P", 0.0) / 1000.0))
            return
        if "F" in values:
            self.feed_mm_s = values["F"] * self.mm / 60.0
        if self.axis in values and 53.0 in codes:
            self._move(values[self.axis] * self.mm, line, number)
        elif set(values) - {"F"}:
            raise self._refused(line, number)
        if ("M", 0.0) in named:
            self._halt(_ZEROING_S)
            self.zeroed_s = self.t_s[-1] if self.zeroed_s is None else self.zeroed_s
            self._halt(_RESUME_S)

    def _units(self, codes: set[float]) -> None:
        if codes & {70.0, 20.0}:
            self.mm = 25.4
        elif codes & {71.0, 21.0}:
            self.mm = 1.0

    def _move(self, target: float, line: str, number: int) -> None:
        if not self.t_s:
            self.t_s, self.position = [0.0], [target]
            return
        if self.feed_mm_s <= 0.0:
            raise self._refused(line, number)
        length = abs(target - self.position[-1])
        if length > 0.0:
            self._knot(length / self.feed_mm_s, target)
        self._knot(_SETTLE_S, target)

    def _halt(self, seconds: float) -> None:
        if self.t_s and seconds > 0.0:
            self._knot(seconds, self.position[-1])

    def _knot(self, after_s: float, position: float) -> None:
        self.t_s.append(self.t_s[-1] + after_s)
        self.position.append(position)

    def _refused(self, line: str, number: int) -> InputError:
        return InputError(
            "the virtual lathe does not understand this block",
            code="lathe.block",
            where=f"line {number}",
            got=line[:60],
            allowed=f"G53 {self.axis}..., F, G04, M00, M01, M30, modes",
        )
