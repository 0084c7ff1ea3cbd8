"""What runs of every kind are compared on: conditions, and the points along a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dtwin.physics.state import State
from dtwin.schema import Floats, Run, RunMeta


class PathCondition(Protocol):
    """What is set for a run, whatever its kind; repeats share it.

    Every kind has a place (``plane``: a plane, or an axis that moves alone), a size of its path
    (``radius_mm``), a speed along it and a sense, so that one set of laws serves them all.
    """

    @property
    def plane(self) -> str:
        """Plane of the path, or its only axis."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that move."""

    @property
    def radius_mm(self) -> float:
        """Radius, half the stroke, or amplitude."""

    @property
    def feed_mm_min(self) -> float:
        """Speed along the path; of a tone the highest."""

    @property
    def direction(self) -> str:
        """Sense of motion as people name it."""

    @property
    def sense(self) -> float:
        """Sense of motion: +1 or -1."""

    @property
    def turned(self) -> PathCondition | None:
        """The same in the other sense; None when a run has both."""

    @property
    def mounted(self) -> str:
        """What needs a set-up of its own."""

    @property
    def swept(self) -> Mapping[str, float]:
        """What campaigns change, by its usual name."""

    @property
    def seconds(self) -> float:
        """Time that one run takes on the machine."""

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""

    def __hash__(self) -> int:
        """Return what lets it be looked up."""


@dataclass(frozen=True)
class OneAxis:
    """The part of a condition that all tests of a single axis share."""

    axis: str

    @property
    def plane(self) -> str:
        """The axis."""
        return self.axis

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that move."""
        return (self.axis,)

    @property
    def mounted(self) -> str:
        """The axis: another one needs another set-up."""
        return self.axis


@dataclass(frozen=True)
class Row:
    """One passage of a run on the grid.

    ``y_um``, (n,): mean deviation in each bin.
    ``mask``, (n,): where something was measured.
    ``columns``: what was logged: a number, or an array of shape (n,).
    ``feed_mm_s``: path speed that was reached.
    """

    run: Run
    condition: PathCondition
    y_um: Floats
    mask: NDArray[np.bool_]
    columns: Mapping[str, Any]
    feed_mm_s: float


@dataclass(frozen=True)
class Grid:
    """The points along a path.

    ``coordinate``: what counts along the path, with its unit: ``angle_deg``, ``position_mm``, ``phase_deg``.
    ``points``, (n,): its value in the middle of every bin.
    ``setup``, (n, k): what belongs to a set-up and never to the machine.
    ``setup_names``: names of these, with unit.
    ``fine``: points in each bin at which effects are evaluated.
    ``averaged``: takes values at the fine points, shape (..., n * fine, k), to the bins, shape (..., n, k).
    ``state``: ``state(meta, condition, feed_mm_s, geometry)``: the machine at the fine points of a run, nothing logged.
    ``described``: highest harmonic that a headline names.
    ``in_plane``: whether two axes move in a plane; else one moves alone.
    """

    kind: str
    coordinate: str
    points: Floats
    setup: Floats
    setup_names: tuple[str, ...]
    fine: int
    averaged: Callable[[Floats], Floats]
    state: Callable[[RunMeta, PathCondition, float, Mapping[str, Any]], State]
    described: int
    wave: Callable[[int], str]
    in_plane: bool = False

    @property
    def n(self) -> int:
        """Number of bins."""
        return len(self.points)

    @property
    def phase_rad(self) -> Floats:
        """Share of the path travelled, as an angle, in the middle of every bin, shape (n,)."""
        return np.asarray((np.arange(self.n) + 0.5) * (2.0 * np.pi / self.n), dtype=np.float64)

    def between(self, first: int, end: int) -> list[float]:
        """Return the stretch from one bin up to another as values of the coordinate."""
        step = np.diff(self.points)
        half = 0.5 * float(np.median(step)) if len(step) else 0.5
        return [round(float(self.points[first]) - half, 6), round(float(self.points[end - 1]) + half, 6)]
