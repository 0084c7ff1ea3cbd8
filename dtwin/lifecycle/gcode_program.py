"""A small part of G-code: straight lines and arcs in absolute millimetres, read strictly."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dtwin.acquire.xmlsafe import read_bounded
from dtwin.errors import InputError
from dtwin.schema import Floats

_WORD = re.compile(r"([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))")
_COMMENT = re.compile(r"\([^)]*\)|;.*")
_PLANES = {17.0: (0, 1), 18.0: (2, 0), 19.0: (1, 2)}
_MODES = (0.0, 1.0, 2.0, 3.0)
# Said once, and they do not change where the tool goes in absolute millimetres.
_HARMLESS = {17.0, 18.0, 19.0, 21.0, 40.0, 49.0, 54.0, 61.0, 64.0, 71.0, 80.0, 90.0, 94.0}
_ALLOWED = "G0 to G4, G17 to G19, G21 (G71), G40, G49, G54, G61, G64, G80, G90, G94; X Y Z I J K F"
# What ends a program or switches something off acts once the motion of its line is over (ISO 6983, Fanuc, RS274).
_AFTER = {0.0, 1.0, 2.0, 5.0, 9.0, 30.0, 60.0, 99.0}
# Calls of other programs: where the tool is afterwards, this one does not say.
_CALLS = {97.0, 98.0, 198.0}
_MARK = "(DTWIN COMPENSATED"
_BEFORE_A_COMMENT = re.compile(r"\s*(%.*|[O:]\s*\d+.*)?$", re.IGNORECASE)
_LONGEST_LINE = 400
MAX_BYTES = 20_000_000


@dataclass(frozen=True)
class Passed:
    """A line without motion; it is written as it is."""

    text: str


@dataclass(frozen=True)
class Move:
    """A motion.

    ``line``: line of the program, from 1.
    ``rapid``: whether it is a G0.
    ``start_mm``, ``end_mm``, (3,): programmed points.
    ``feed_mm_min``: feed in force; 0 before the first F.
    ``known``, ``started``: axes whose position the program has said, with this line and before it.
    ``rest``: other words of the line, such as M3 or S, which come before the motion.
    ``after``: those that act when the motion is over, such as M5 or M30.
    ``centre_mm``, (2,): centre of an arc in its plane; None for a straight line.
    ``turn_rad``: angle of an arc, positive from the first axis of the plane to its second.
    """

    line: int
    rapid: bool
    start_mm: Floats
    end_mm: Floats
    feed_mm_min: float
    known: tuple[bool, ...]
    started: tuple[bool, ...]
    rest: str = ""
    after: str = ""
    plane: tuple[int, int] = (0, 1)
    centre_mm: Floats | None = None
    turn_rad: float = 0.0

    def points(self, shares: Floats) -> Floats:
        """Return the programmed points at shares of the way (n,), shape (n, 3)."""
        out = self.start_mm + shares[:, None] * (self.end_mm - self.start_mm)
        if self.centre_mm is not None:
            a, b = self.plane
            radius, angle = self._polar()
            at = angle + shares * self.turn_rad
            out[:, a] = self.centre_mm[0] + radius * np.cos(at)
            out[:, b] = self.centre_mm[1] + radius * np.sin(at)
        return np.asarray(out)

    def directions(self, shares: Floats) -> Floats:
        """Return unit vectors of motion at shares of the way (n,), shape (n, 3)."""
        way = np.tile(self.end_mm - self.start_mm, (len(shares), 1))
        if self.centre_mm is not None:
            a, b = self.plane
            radius, angle = self._polar()
            at = angle + shares * self.turn_rad
            way[:, a] = -radius * np.sin(at) * self.turn_rad
            way[:, b] = radius * np.cos(at) * self.turn_rad
        length = np.linalg.norm(way, axis=1, keepdims=True)
        return np.asarray(way / np.where(length > 0.0, length, 1.0))

    @property
    def length_mm(self) -> float:
        """Length of the way."""
        straight = self.end_mm - self.start_mm
        if self.centre_mm is None:
            return float(np.linalg.norm(straight))
        (through,) = {0, 1, 2} - set(self.plane)
        return math.hypot(self._polar()[0] * self.turn_rad, float(straight[through]))

    def quadrants(self) -> list[float]:
        """Return the shares at which an axis of an arc turns round, with 0 and 1."""
        if self.centre_mm is None:
            return [0.0, 1.0]
        _, angle = self._polar()
        low, high = sorted((angle, angle + self.turn_rad))
        quarter = 0.5 * math.pi
        at = [k * quarter for k in range(math.ceil(low / quarter), math.floor(high / quarter) + 1)]
        inside = sorted((a - angle) / self.turn_rad for a in at)
        return [0.0, *(s for s in inside if 1e-9 < s < 1.0 - 1e-9), 1.0]

    def _polar(self) -> tuple[float, float]:
        assert self.centre_mm is not None
        a, b = self.plane
        x, y = self.start_mm[a] - self.centre_mm[0], self.start_mm[b] - self.centre_mm[1]
        return math.hypot(x, y), math.atan2(y, x)


def program_of(path: Path) -> str:
    """Return the text of a program; raises InputError for one that is missing, too large or no plain text."""
    return plain(read_bounded(path, MAX_BYTES), str(path))


def plain(program: bytes, where: str) -> str:
    """Return the text of a program; raises InputError for what is no plain text."""
    try:
        return program.decode("ascii")
    except UnicodeDecodeError as error:
        raise InputError("the program is no plain text", code="gcode.text", where=where, got=str(error)[:80]) from error


def marked(text: str, whose: str) -> str:
    """Return a compensated program with a comment that says so, below its % and its number.

    ``whose``: twin, version and state; what an old control may not take in a comment becomes a blank.
    """
    lines = text.splitlines()
    at = next((n for n, line in enumerate(lines) if not _BEFORE_A_COMMENT.match(line)), len(lines))
    plain = " ".join(re.sub(r"[^A-Z0-9.,+-]+", " ", whose.upper()).split())
    return "\n".join([*lines[:at], f"{_MARK}, {plain})", *lines[at:]]) + "\n"


def require_unmarked(text: str, where: str) -> None:
    """Refuse a program that is compensated already: its errors would be corrected twice."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.upper().startswith(_MARK):
            raise InputError(
                "the program is compensated already",
                code="gcode.twice",
                where=f"{where} line {number}",
                got=line[:120],
                allowed="a program as it was before",
            )


def read_program(text: str, where: str) -> Iterator[Passed | Move]:
    """Read a program line by line."""
    at = np.zeros(3)
    known = [False] * 3
    mode, plane, feed = -1.0, (0, 1), 0.0
    for number, raw in enumerate(text.splitlines(), start=1):
        words = _words(raw, f"{where} line {number}")
        codes = [v for k, v in words if k == "G"]
        for code in codes:
            if code in _PLANES:
                plane = _PLANES[code]
        feed = next((v for k, v in words if k == "F"), feed)
        mode = next((c for c in codes if c in _MODES), mode)
        target = {k: v for k, v in words if k in "XYZ"}
        # A whole circle may name its centre alone.
        turns = mode in (2.0, 3.0) and any(k in "IJK" for k, _ in words)
        if not (target or turns) or 4.0 in codes:
            yield Passed(raw)
            continue
        if mode < 0.0:
            raise _wrong(f"{where} line {number}", raw, "a G0, G1, G2 or G3 before the first point")
        end, before = at.copy(), tuple(known)
        for k, v in target.items():
            end["XYZ".index(k)] = v
            known["XYZ".index(k)] = True
        rest, after = _rest(words)
        if mode in (2.0, 3.0):
            if not all(before[axis] for axis in plane):
                raise _wrong(f"{where} line {number}", raw, "an arc from a point that the program has named")
            arc = _arc(words, at, end, mode, plane, f"{where} line {number}")
            yield Move(number, False, at.copy(), end, feed, tuple(known), before, rest, after, *arc)
        else:
            yield Move(number, mode == 0.0, at.copy(), end, feed, tuple(known), before, rest, after)
        at = end


def _rest(words: list[tuple[str, float]]) -> tuple[str, str]:
    """Return the other words of a line, before and after its motion."""
    kept = [(k, v) for k, v in words if not (k in "XYZIJKFN" or (k == "G" and v in _MODES))]
    late = [k == "M" and v in _AFTER for k, v in kept]
    before, after = (
        " ".join(f"{k}{v:g}" for (k, v), x in zip(kept, late, strict=True) if x == is_late) for is_late in (False, True)
    )
    return before, after


def _arc(
    words: list[tuple[str, float]], at: Floats, end: Floats, mode: float, plane: tuple[int, int], where: str
) -> tuple[tuple[int, int], Floats, float]:
    """Return plane, centre and angle of an arc."""
    offsets = {k: v for k, v in words if k in "IJK"}
    a, b = plane
    centre = np.array([at[a] + offsets.get("IJK"[a], 0.0), at[b] + offsets.get("IJK"[b], 0.0)])
    first = math.hypot(at[a] - centre[0], at[b] - centre[1])
    last = math.hypot(end[a] - centre[0], end[b] - centre[1])
    if first == 0.0 or abs(first - last) > 0.002:
        raise InputError(
            "the ends of an arc are not equally far from its centre",
            code="gcode.arc",
            where=where,
            got=f"{first:z.4f} and {last:z.4f} mm",
            hint="give the centre with I, J, K from the start of the arc",
        )
    begin = math.atan2(at[b] - centre[1], at[a] - centre[0])
    finish = math.atan2(end[b] - centre[1], end[a] - centre[0])
    turn = (finish - begin) % (2.0 * math.pi)
    if turn < 1e-9:
        turn = 2.0 * math.pi
    if mode == 2.0:
        turn = turn - 2.0 * math.pi if turn < 2.0 * math.pi - 1e-9 else -2.0 * math.pi
    return plane, centre, turn


def _words(raw: str, where: str) -> list[tuple[str, float]]:
    plain = _COMMENT.sub("", raw[:_LONGEST_LINE]).strip().upper()
    if plain in ("", "%"):
        return []
    if plain.startswith("/"):
        if any(letter in plain for letter in "GXYZ") or any(f"M{call:g}" in plain for call in _CALLS):
            raise _wrong(where, raw, "no motion that a switch of the control can leave out (/)")
        return []
    words = [(m[1], float(m[2])) for m in _WORD.finditer(plain)]
    if _WORD.sub("", plain).strip() or len(raw) > _LONGEST_LINE:
        raise _wrong(where, raw, _ALLOWED)
    for letter, value in words:
        good = letter in "XYZIJKFNSTMOP"
        if letter == "G":
            good = value in _MODES or value in _HARMLESS or value == 4.0
        elif letter == "M" and (value in _CALLS or (value == 99.0 and any(k == "P" for k, _ in words))):
            raise _wrong(where, raw, "no calls of other programs (M97, M98, M198) and no jumps (M99 P)")
        if not good:
            raise _wrong(where, f"{letter}{value:g} in {raw}", _ALLOWED)
    return words


def _wrong(where: str, got: str, allowed: str) -> InputError:
    return InputError(
        "the program says what compensation does not understand",
        code="gcode.word",
        where=where,
        got=got.strip()[:120],
        allowed=allowed,
        hint="nothing was written; absolute millimetres, arcs by their centre",
    )
