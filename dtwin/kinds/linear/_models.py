"""What a control can hold of a positioning error: tables, networks, and a play of two flanks.

Direction is 0 forward, 1 reverse. Networks take and give inches inside, as the published ones do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dtwin.kinds.linear._small_net import SmallNet, Trained, new_net, train_net
from dtwin.positioning.matrix import LinearTest
from dtwin.schema import Floats

MM_PER_IN, UM_PER_IN = 25.4, 25_400.0
# As published: sums of squared errors at which the trainings stop.
_GOALS = (4e-8, 9e-9)


class PositionModel(Protocol):
    """Predicts the error of an axis."""

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return the error, shape (n,)."""


@dataclass(frozen=True)
class Averages:
    """Mean error at each target of a bidirectional test.

    ``position_mm`` (targets,): ascending.
    ``forward_um``, ``reverse_um`` (targets,): mean errors.
    """

    position_mm: Floats
    forward_um: Floats
    reverse_um: Floats

    def stacked(self) -> tuple[Floats, Floats, Floats]:
        """Return direction, position and error of both directions, each (2 targets,)."""
        n = len(self.position_mm)
        return (
            np.repeat([0.0, 1.0], n),
            np.tile(self.position_mm, 2),
            np.concatenate([self.forward_um, self.reverse_um]),
        )

    def every(self, step_mm: float) -> Averages:
        """Return the targets that are whole steps from the first one."""
        offset = (self.position_mm - self.position_mm[0]) / step_mm
        kept = np.abs(offset - np.round(offset)) < 1e-6
        return Averages(self.position_mm[kept], self.forward_um[kept], self.reverse_um[kept])


def averages_of(test: LinearTest) -> Averages:
    """Return the mean errors of a test."""
    return Averages(test.position_mm, test.forward_um.mean(axis=1), test.reverse_um.mean(axis=1))


@dataclass(frozen=True)
class Uncorrected:
    """No correction: an error of zero everywhere."""

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return zeros, shape (n,)."""
        return np.zeros(np.broadcast(direction, position_mm).shape)


@dataclass(frozen=True)
class Bidirectional:
    """Two tables, chosen by direction; straight between entries, ends held."""

    averages: Averages

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return the error, shape (n,)."""
        a = self.averages
        forward = np.interp(position_mm, a.position_mm, a.forward_um)
        reverse = np.interp(position_mm, a.position_mm, a.reverse_um)
        return np.where(np.asarray(direction) >= 0.5, reverse, forward)


@dataclass(frozen=True)
class Unidirectional:
    """One table and one backlash for the whole axis.

    ``averages``: forward entries are used; the backlash is the mean difference of the directions.
    """

    averages: Averages

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return the error, shape (n,)."""
        a = self.averages
        backlash = float(np.mean(a.reverse_um - a.forward_um))
        forward = np.interp(position_mm, a.position_mm, a.forward_um)
        return forward + backlash * (np.asarray(direction) >= 0.5)


@dataclass(frozen=True)
class DualNet:
    """One network for the travel, one for a turn of the screw, added.

    ``full``, ``cyclic``: inputs are direction and position; direction and position within the turn; in inches.
    ``pitch_in``: travel in one turn of the screw, as the published program has it.
    """

    full: SmallNet
    cyclic: SmallNet
    pitch_in: float
    trained: tuple[Trained, ...] = ()

    def error_um(self, direction: Floats, position_mm: Floats) -> Floats:
        """Return the error, shape (n,)."""
        position_in = in_inches(position_mm)
        turned = np.fmod(position_in, self.pitch_in)
        slow = self.full.evaluate(np.column_stack([direction, position_in]))
        return UM_PER_IN * (slow + self.cyclic.evaluate(np.column_stack([direction, turned])))


def whole_turns(averages: Averages, pitch_in: float) -> tuple[Floats, Floats]:
    """Return inputs (n, 2) and errors (n,) in inches at whole turns of the screw, where the cyclic error is zero.

    ``averages``: its first target must lie at a whole turn.
    """
    direction, position, error = inches_of(averages.every(pitch_in * MM_PER_IN))
    return np.column_stack([direction, position]), error


def inches_of(averages: Averages) -> tuple[Floats, Floats, Floats]:
    """Return direction, position and error of both directions as networks take them."""
    direction, position_mm, error_um = averages.stacked()
    return direction, in_inches(position_mm), error_um / UM_PER_IN


def in_inches(position_mm: Floats) -> Floats:
    """Return positions for networks: a whole turn of the screw is one, whatever the conversion rounds."""
    return np.asarray(np.round(position_mm / MM_PER_IN, 9))


def _one_turn(averages: Averages, full: SmallNet, pitch_in: float) -> tuple[Floats, Floats]:
    """Return inputs (n, 2) and what a slow network leaves over a turn (n,), averaged over all turns.

    ``averages``: several targets in each turn.
    """
    direction, position, error = inches_of(averages)
    rest = error - full.evaluate(np.column_stack([direction, position]))
    # As it is served: below zero a place within the turn is, like C's remainder, below zero.
    phase = np.fmod(np.round(np.fmod(position, pitch_in), 6), pitch_in)
    cells, place = np.unique(np.column_stack([direction, phase]), axis=0, return_inverse=True)
    place = place.ravel()
    return cells, np.bincount(place, weights=rest) / np.bincount(place)


def fit_dual(
    averages: Averages, pitch_in: float, seed: int, *, epochs: int = 1000, hidden: Sequence[int] = (30, 8)
) -> DualNet:
    """Train the published pair: the slow network on whole turns, the cyclic one on what is left.

    ``averages``: mean errors.
    ``hidden``: neurons of both.
    """
    rng = np.random.default_rng(seed)
    inputs, target = whole_turns(averages, pitch_in)
    reach = (float(averages.position_mm[0]) / MM_PER_IN, float(averages.position_mm[-1]) / MM_PER_IN)
    slow = train_net(new_net(hidden[0], ((0.0, 1.0), reach), rng), inputs, target, epochs=epochs, goal=_GOALS[0])
    cells, rest = _one_turn(averages, slow.net, pitch_in)
    fast = train_net(new_net(hidden[1], ((0.0, 1.0), (0.0, pitch_in)), rng), cells, rest, epochs=epochs, goal=_GOALS[1])
    return DualNet(slow.net, fast.net, pitch_in, (slow, fast))
