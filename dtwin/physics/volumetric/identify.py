"""Error motions of a cycle from the balls that the probe found in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.physics.volumetric.chain import COEFFICIENTS, Identifiability, design, identifiability
from dtwin.schema import Floats

FIXED_POSE = 0
_RIGID = ("EX0", "EY0", "EZ0", "EA0", "EB0", "EC0")
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Balls:
    """Readings of one cycle.

    Attributes
    ----------
    position_mm : ndarray, shape (n, 3)
        Nominal places.
    error_um : ndarray, shape (n, 3)
        Measured minus nominal, as the machine's scales say.
    pose, ball : ndarray of int, shape (n,)
        Pose of the array, 0 for balls that stand on the table; number of the ball.
    """

    position_mm: Floats
    error_um: Floats
    pose: Numbers
    ball: Numbers


@dataclass(frozen=True)
class Identified:
    """Error motions of one cycle.

    Attributes
    ----------
    values, uncertainty : ndarray, shape (coefficients,)
        Since the reference cycle; standard uncertainty from the residual.
    left_um : float
        RMS of the residual of the poses that were fitted, per coordinate.
    held_out_um : float
        The same in the poses that were not, the place of the array in each fitted; NaN without.
    readings : int
        Coordinates that were used.
    """

    values: Floats
    uncertainty: Floats
    left_um: float
    held_out_um: float
    readings: int


@dataclass(frozen=True)
class Artefact:
    """How readings are turned into error motions.

    Attributes
    ----------
    strokes_mm : mapping of str to tuple of float
        Ends of the strokes.
    held_out : tuple of int
        Poses that are left out of the fit.
    pose_repeat_um : float
        How well the array comes back to the place of the reference cycle (um, and um/m for its
        turn): a standard deviation; infinite when it may stand anywhere.
    noise_um : float
        Standard deviation of how the probe finds a coordinate in two cycles.
    names : tuple of str
        Coefficients to find.
    """

    strokes_mm: Mapping[str, tuple[float, float]]
    held_out: tuple[int, ...] = ()
    pose_repeat_um: float = float("inf")
    noise_um: float = 1.0
    names: tuple[str, ...] = COEFFICIENTS

    def variation_um(self, cycle: Balls, reference: Balls) -> tuple[Balls, Floats]:
        """Return the balls that both cycles have, and how the tool point moved there, shape (n, 3).

        Parameters
        ----------
        cycle, reference : Balls
            Readings; where the machine goes too far its scales read less.
        """
        place = {key: i for i, key in enumerate(_keys(reference))}
        kept = [(i, place[key]) for i, key in enumerate(_keys(cycle)) if key in place]
        mine, theirs = (np.array([pair[k] for pair in kept], dtype=int) for k in (0, 1))
        moved = -(cycle.error_um[mine] - reference.error_um[theirs])
        shown = Balls(
            cycle.position_mm[mine], cycle.error_um[mine], cycle.pose[mine], cycle.ball[mine]
        )
        return shown, moved

    def identify(self, balls: Balls, moved_um: Floats) -> Identified:
        """Return the error motions that explain how the tool point moved.

        Parameters
        ----------
        balls : Balls
            Where it was measured.
        moved_um : ndarray, shape (n, 3)
            How it moved.

        Raises
        ------
        InputError
            When the balls cannot tell the coefficients.
        """
        use = ~np.isin(balls.pose, self.held_out)
        columns = self._columns(balls, use)
        known = columns.shape[1] - len(self.names)
        self._require(columns, known)
        y = np.zeros(len(columns))
        measured = 3 * int(use.sum())
        y[:measured] = moved_um[use].ravel()
        found = np.linalg.lstsq(columns, y, rcond=None)[0]
        left = y - columns @ found
        # The pulled places cost what the rows that pull give.
        pulled = len(y) - measured if np.isfinite(self.pose_repeat_um) else 0
        free = max(measured + pulled - columns.shape[1], 1)
        inverse = np.linalg.pinv(columns.T @ columns)
        spread = np.sqrt(np.diag(inverse)[known:] * float(left @ left) / free)
        values: Floats = np.asarray(found[known:], dtype=float)
        return Identified(
            values, spread, float(np.sqrt(left @ left / free)),
            self._held_out_um(balls, moved_um, values), measured,
        )  # fmt: skip

    def report(self, balls: Balls) -> Identifiability:
        """Return what a cycle's balls can tell of the coefficients."""
        use = ~np.isin(balls.pose, self.held_out)
        columns = self._columns(balls, use)
        known = columns.shape[1] - len(self.names)
        return identifiability(_without(columns[:, :known], columns[:, known:]), self.names)

    def predicted_um(self, balls: Balls, values: Floats) -> Floats:
        """Return how the tool point moves with given coefficients, shape (n, 3)."""
        return design(balls.position_mm, self.strokes_mm, self.names) @ values

    def _columns(self, balls: Balls, use: NDArray[np.bool_]) -> Floats:
        """Return the columns of the poses' places, then those of the coefficients."""
        part = design(balls.position_mm[use], self.strokes_mm, self.names)
        pose = balls.pose[use]
        poses = sorted({int(p) for p in pose if p != FIXED_POSE})
        placed = [_placed(balls.position_mm[use], pose == p) for p in poses]
        both = np.concatenate([*placed, part], axis=2)
        columns = both.reshape(-1, both.shape[2])
        # What is known of the place beforehand: rows that pull it to where it was.
        pull = self.noise_um / self.pose_repeat_um * np.eye(6 * len(poses), both.shape[2])
        return np.concatenate([columns, pull])

    def _held_out_um(self, balls: Balls, moved_um: Floats, values: Floats) -> float:
        total, count = 0.0, 0
        for pose in self.held_out:
            rows = balls.pose == pose
            if rows.sum() < 4:
                continue
            one = Balls(
                balls.position_mm[rows], balls.error_um[rows], balls.pose[rows], balls.ball[rows]
            )
            rest = (moved_um[rows] - self.predicted_um(one, values)).ravel()
            place = _placed(one.position_mm, np.ones(int(rows.sum()), bool)).reshape(len(rest), 6)
            left = rest - place @ np.linalg.lstsq(place, rest, rcond=None)[0]
            total += float(left @ left)
            count += len(rest) - 6
        return float(np.sqrt(total / count)) if count else float("nan")

    def _require(self, columns: Floats, known: int) -> None:
        found = identifiability(_without(columns[:, :known], columns[:, known:]), self.names)
        if found.rank < found.wanted:
            bad = (*found.unseen, *found.entangled)
            raise InputError(
                "these balls cannot tell the error motions from one another",
                code="volumetric.rank", got=f"rank {found.rank} of {found.wanted}: {', '.join(bad)[:160]}",
                hint="measure the fixed balls for the rigid motions, more poses for the others, or "
                "leave coefficients out",
            )  # fmt: skip


def averaged_balls(cycles: Sequence[Balls]) -> Balls:
    """Return the mean readings of some cycles, of the balls that each of them has."""
    first = cycles[0]
    sums = {key: [first.error_um[i]] for i, key in enumerate(_keys(first))}
    for cycle in cycles[1:]:
        for i, key in enumerate(_keys(cycle)):
            if key in sums:
                sums[key].append(cycle.error_um[i])
    whole = [i for i, key in enumerate(_keys(first)) if len(sums[key]) == len(cycles)]
    keys = _keys(first)
    return Balls(
        first.position_mm[whole],
        np.array([np.mean(sums[keys[i]], axis=0) for i in whole]),
        first.pose[whole],
        first.ball[whole],
    )


def _keys(balls: Balls) -> list[tuple[int, int, int]]:
    """Return pose, ball and how often it came before, for every reading."""
    seen: dict[tuple[int, int], int] = {}
    out = []
    for pose, ball in zip(balls.pose.tolist(), balls.ball.tolist(), strict=True):
        count = seen.get((pose, ball), 0)
        seen[pose, ball] = count + 1
        out.append((pose, ball, count))
    return out


def _placed(position_mm: Floats, rows: NDArray[np.bool_]) -> Floats:
    """Return what shifts and turns of a pose do, shape (n, 3, 6): they are not the machine's."""
    out = np.zeros((len(position_mm), 3, 6))
    arm_m = 1e-3 * (position_mm - position_mm[rows].mean(axis=0))
    for k in range(3):
        out[rows, k, k] = 1.0
        out[rows, :, 3 + k] = np.cross(np.eye(3)[k], arm_m[rows])
    return out


def _without(known: Floats, columns: Floats) -> Floats:
    if not known.shape[1]:
        return columns
    basis = np.linalg.qr(known)[0]
    return np.asarray(columns - basis @ (basis.T @ columns))
