"""The laser's own trigger: no wire to the control, only the motion it sees."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dtwin.schema import Finding, Floats

_SEEK, _DWELL, _TURN = range(3)
_HALT_S = 1.0
_NEAR = 5.0
_CLEAR_MM = 1e-6


@dataclass(frozen=True)
class LaserSetup:
    """What the operator enters at the laser.

    ``targets_mm``: from the first to the last.
    ``runs``: sweeps forward and back.
    ``window_mm``, ``dwell_s``: a reading is due when the axis has been within the window for the dwell; it is the
    average of the dwell's second half.
    """

    targets_mm: tuple[float, ...]
    runs: int
    window_mm: float
    dwell_s: float


@dataclass(frozen=True)
class _Reading:
    """One finished reading.

    ``target_mm``: what the laser took it for.
    ``run``: from 0.
    ``begin_s``, ``end_s``: time over which the laser averaged.
    """

    target_mm: float
    direction: Literal["forward", "reverse"]
    run: int
    begin_s: float
    end_s: float


@dataclass(frozen=True)
class Triggered:
    """What a laser made of a motion.

    ``readings``: in the order of time.
    ``alarms``: missed triggers and why.
    """

    readings: tuple[_Reading, ...]
    alarms: tuple[Finding, ...]


def watch(t_s: Floats, position_mm: Floats, setup: LaserSetup) -> Triggered:
    """Watch a motion as the laser does.

    ``t_s``, ``position_mm``, (knots,): where the slide really is, straight between knots, from when the laser was
    zeroed.
    """
    trigger = _Trigger(setup)
    knots = zip(t_s.tolist(), position_mm.tolist(), strict=True)
    before = next(knots)
    for after in knots:
        trigger.see(*before, *after)
        before = after
    return Triggered(tuple(trigger.readings), tuple(trigger.summary(t_s, position_mm)))


class _Trigger:
    def __init__(self, setup: LaserSetup) -> None:
        self.setup = setup
        up = list(setup.targets_mm)
        self.order = [(t, 1) for t in up] + [(t, -1) for t in reversed(up)]
        self.total = setup.runs * len(self.order)
        self.number = 0
        self.state = _SEEK
        self.entered_s = 0.0
        self.readings: list[_Reading] = []
        self.left_early: list[float] = []
        self.never_inside: list[float] = []

    def see(self, t0: float, p0: float, t1: float, p1: float) -> None:
        """Take one straight piece of the motion."""
        t = t0
        while self.number < self.total and t <= t1:
            target, way = self.order[self.number % len(self.order)]
            if self.state == _TURN:
                left = self._beyond(t, t0, p0, t1, p1)
                if left is None:
                    return
                self.state, t = _SEEK, left
                continue
            low, high = target - self.setup.window_mm, target + self.setup.window_mm
            inside = _inside(t, t0, p0, t1, p1, low, high)
            if self.state == _SEEK:
                if inside is None:
                    self._note_halt(target, t0, p0, t1, p1)
                    return
                self.state, self.entered_s, t = _DWELL, inside[0], inside[0]
                continue
            due = self.entered_s + self.setup.dwell_s
            leaves = t if inside is None else inside[1]
            stays = inside is not None and leaves >= t1
            if due <= leaves:
                self._read(target, way, due)
                t = max(t, due)
            elif stays:
                return
            else:
                self.left_early.append(target)
                self._next()
                t = leaves

    def _read(self, target: float, way: int, due: float) -> None:
        self.readings.append(
            _Reading(
                target,
                "forward" if way > 0 else "reverse",
                self.number // len(self.order),
                due - self.setup.dwell_s / 2.0,
                due,
            )
        )
        self._next()

    def _next(self) -> None:
        self.number += 1
        turns = self.number % (len(self.order) // 2) == 0
        self.state = _TURN if turns else _SEEK

    def _beyond(self, t: float, t0: float, p0: float, t1: float, p1: float) -> float | None:
        """Return when the axis is further out than the window of the end at which it turns."""
        upper = (self.number // (len(self.order) // 2)) % 2 == 1
        edge = self.setup.targets_mm[-1] + self.setup.window_mm
        if upper:
            crossed = _inside(t, t0, p0, t1, p1, edge + _CLEAR_MM, np.inf)
        else:
            edge = self.setup.targets_mm[0] - self.setup.window_mm
            crossed = _inside(t, t0, p0, t1, p1, -np.inf, edge - _CLEAR_MM)
        return None if crossed is None else crossed[0]

    def _note_halt(self, target: float, t0: float, p0: float, t1: float, p1: float) -> None:
        halted = t1 - t0 >= _HALT_S and abs(p1 - p0) < self.setup.window_mm
        first, second, last = (self.setup.targets_mm[k] for k in (0, 1, -1))
        beyond = not first - self.setup.window_mm <= p1 <= last + self.setup.window_mm
        step = abs(second - first)
        near = abs(p1 - target) <= min(_NEAR * self.setup.window_mm, 0.4 * step)
        if halted and near and not beyond and (not self.never_inside or self.never_inside[-1] != target):
            self.never_inside.append(target)

    def summary(self, t_s: Floats, position_mm: Floats) -> Iterator[Finding]:
        """Yield the alarms after the last piece."""
        if self.left_early:
            yield _alarm(
                "trigger.dwell_too_short",
                self.left_early,
                f"the axis left the window before {self.setup.dwell_s:g} s were over: halt longer",
            )
        if self.never_inside:
            yield _alarm(
                "trigger.window_too_small",
                self.never_inside,
                f"the axis halted near, but not within {self.setup.window_mm:g} mm: widen the window",
            )
        moved = [r.target_mm for r in self.readings if _moved(r, t_s, position_mm, self.setup)]
        if moved:
            yield _alarm(
                "trigger.moved_while_reading",
                moved,
                "the axis moved while the laser averaged: windows overlap, or the halts are short",
            )
        missing = self.total - len(self.readings)
        if missing:
            yield Finding(
                "trigger.missed",
                "error",
                f"{missing} of {self.total} readings were not taken",
                {"missed_1": float(missing)},
            )


def _alarm(code: str, targets: Sequence[float], why: str) -> Finding:
    return Finding(
        code,
        "error",
        f"{len(targets)} targets, the first at {targets[0]:z.3f} mm: {why}",
        {"targets_1": float(len(targets)), "first_mm": targets[0]},
    )


def _moved(reading: _Reading, t_s: Floats, position_mm: Floats, setup: LaserSetup) -> bool:
    begin, end = np.interp([reading.begin_s, reading.end_s], t_s, position_mm)
    return bool(abs(end - begin) > 0.1 * setup.window_mm)


def _inside(
    t: float, t0: float, p0: float, t1: float, p1: float, low: float, high: float
) -> tuple[float, float] | None:
    """Return from when to when, after ``t``, a straight piece lies between two positions."""
    if p0 == p1 or t1 <= t0:
        return (t, t1) if low <= p0 <= high else None
    speed = (p1 - p0) / (t1 - t0)
    a, b = t0 + (low - p0) / speed, t0 + (high - p0) / speed
    begin, end = max(t, min(a, b)), min(t1, max(a, b))
    return (begin, end) if begin <= end else None
