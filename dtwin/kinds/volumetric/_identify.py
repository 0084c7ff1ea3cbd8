"""Error motions of a cycle from the balls that the probe found in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, Identifiability, design, identifiability
from dtwin.schema import Floats

FIXED_POSE = 0
_CYCLES_FOR_NOISE, _ORDERS_FOR_NOISE = 30, (1, 2, 3)
_Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Balls:
    """Readings of one cycle.

    ``position_mm``, (n, 3): nominal places.
    ``error_um``, (n, 3): measured minus nominal, as the machine's scales say.
    ``pose``, ``ball``, (n,): pose of the array, 0 for balls that stand on the table; number of the ball.
    """

    position_mm: Floats
    error_um: Floats
    pose: _Numbers
    ball: _Numbers


@dataclass(frozen=True)
class Identified:
    """Error motions of one cycle.

    ``values``, ``uncertainty``, (coefficients,): since the reference cycle; standard uncertainty from the residual.
    ``left_um``: RMS of the residual of the poses that were fitted, per coordinate.
    ``held_out_um``: the same in the poses that were not, the place of the array in each fitted; NaN without.
    """

    values: Floats
    uncertainty: Floats
    left_um: float
    held_out_um: float
    readings: int


@dataclass(frozen=True)
class Settled:
    """Error motions of one cycle with the places of the array taken out.

    ``values``, (coefficients,): since the reference cycle.
    ``covariance``, (coefficients, coefficients): of the values, from the residual.
    ``moved_um``, (n, 3): how the tool point moved, less where the array stood otherwise than in the reference.
    """

    values: Floats
    covariance: Floats
    moved_um: Floats


@dataclass(frozen=True)
class _Prepared:
    use: NDArray[np.bool_]
    columns: Floats
    solve: Floats
    inverse: Floats


@dataclass(frozen=True)
class Artefact:
    """How readings are turned into error motions.

    ``strokes_mm``: ends of the strokes.
    ``held_out``: poses that are left out of the fit.
    ``pose_repeat_um``: how well the array comes back to the place of the reference cycle (um, and um/m for its turn): a
    standard deviation; infinite when it may stand anywhere.
    ``noise_um``: standard deviation of how the probe finds a coordinate in two cycles; how strongly places are held is by it.
    """

    strokes_mm: Mapping[str, tuple[float, float]]
    held_out: tuple[int, ...] = ()
    pose_repeat_um: float = float("inf")
    noise_um: float = 1.0
    names: tuple[str, ...] = COEFFICIENTS
    _ready: dict[bytes, _Prepared] = field(default_factory=dict, repr=False, compare=False)

    def variation_um(self, cycle: Balls, reference: Balls) -> tuple[Balls, Floats]:
        """Return the balls that both cycles have, and how the tool point moved there, shape (n, 3).

        ``cycle``, ``reference``: readings; where the machine goes too far its scales read less.
        """
        place = {key: i for i, key in enumerate(keys_of(reference))}
        kept = [(i, place[key]) for i, key in enumerate(keys_of(cycle)) if key in place]
        mine, theirs = (np.array([pair[k] for pair in kept], dtype=int) for k in (0, 1))
        moved = -(cycle.error_um[mine] - reference.error_um[theirs])
        shown = Balls(cycle.position_mm[mine], cycle.error_um[mine], cycle.pose[mine], cycle.ball[mine])
        return shown, moved

    def with_noise_of(self, moved: Sequence[tuple[Balls, Floats]]) -> Artefact:
        """Return the same with the noise that cycles show (median), wherever the array stood and however the machine moved."""
        every = tuple(f"E{letter}{axis}{order}" for letter in "XYZABC" for axis in "XZY" for order in _ORDERS_FOR_NOISE)
        free = replace(self, pose_repeat_um=float("inf"), names=tuple(dict.fromkeys((*self.names, *every))), _ready={})
        shown = []
        for balls, moved_um in moved[:: -(-len(moved) // _CYCLES_FOR_NOISE)]:
            use = ~np.isin(balls.pose, self.held_out)
            columns = free._columns(balls, use)[: 3 * int(use.sum())]
            y = moved_um[use].ravel()
            fitted, _, rank, _ = np.linalg.lstsq(columns, y)
            if len(y) > rank:
                left = y - columns @ fitted
                shown.append(float(np.sqrt(left @ left / (len(y) - rank))))
        noise_um = float(np.median(shown)) if shown else 0.0
        return replace(self, noise_um=noise_um, _ready={}) if noise_um > 0.0 else self

    def identify(self, balls: Balls, moved_um: Floats) -> Identified:
        """Return the error motions that explain how the tool point moved. ``moved_um``, (n, 3): how it moved."""
        ready = self._prepared(balls)
        parameters, noise_um = self._solved(ready, moved_um)
        spread = np.sqrt(np.diag(ready.inverse) * noise_um**2)
        values: Floats = np.asarray(parameters[-len(self.names) :], dtype=np.float64)
        return Identified(
            values, spread, noise_um, self._held_out_um(balls, moved_um, values), 3 * int(ready.use.sum())
        )

    def settle(self, balls: Balls, moved_um: Floats) -> Settled:
        """Return error motions from all poses, held out or not, and the movement less the places.

        ``moved_um``, (n, 3): how the tool point moved.
        """
        if self.held_out:
            raise InputError("no pose may be held out here", code="volumetric.held_out")
        ready = self._prepared(balls)
        parameters, noise_um = self._solved(ready, moved_um)
        known = len(parameters) - len(self.names)
        taken = ready.columns[: moved_um.size, :known] @ parameters[:known]
        values: Floats = np.asarray(parameters[known:], dtype=np.float64)
        return Settled(values, ready.inverse * noise_um**2, moved_um - taken.reshape(-1, 3))

    def _solved(self, ready: _Prepared, moved_um: Floats) -> tuple[Floats, float]:
        """Return places and coefficients, and the RMS that they leave of a free coordinate."""
        y = np.zeros(len(ready.columns))
        measured = 3 * int(ready.use.sum())
        y[:measured] = moved_um[ready.use].ravel()
        solution = ready.solve @ y
        left = y - ready.columns @ solution
        # The pulled places cost what the rows that pull give.
        pulled = len(y) - measured if np.isfinite(self.pose_repeat_um) else 0
        free = max(measured + pulled - ready.columns.shape[1], 1)
        return solution, float(np.sqrt(left @ left / free))

    def report(self, balls: Balls) -> Identifiability:
        """Return what a cycle's balls can tell of the coefficients."""
        use = ~np.isin(balls.pose, self.held_out)
        columns = self._columns(balls, use)
        known = columns.shape[1] - len(self.names)
        return identifiability(_without(columns[:, :known], columns[:, known:]), self.names)

    def predicted_um(self, balls: Balls, values: Floats) -> Floats:
        """Return how the tool point moves with given coefficients, shape (n, 3)."""
        return design(balls.position_mm, self.strokes_mm, self.names) @ values

    def _prepared(self, balls: Balls) -> _Prepared:
        """Return what is the same for all cycles that touched the same balls."""
        key = balls.position_mm.tobytes() + balls.pose.tobytes()
        if key not in self._ready:
            use = ~np.isin(balls.pose, self.held_out)
            columns = self._columns(balls, use)
            self._require(columns, columns.shape[1] - len(self.names))
            inverse = np.linalg.pinv(columns.T @ columns)
            block: Floats = np.asarray(inverse[-len(self.names) :, -len(self.names) :], dtype=float)
            self._ready[key] = _Prepared(use, columns, inverse @ columns.T, block)
        return self._ready[key]

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
            one = Balls(balls.position_mm[rows], balls.error_um[rows], balls.pose[rows], balls.ball[rows])
            rest = (moved_um[rows] - self.predicted_um(one, values)).ravel()
            place = _placed(one.position_mm, np.ones(int(rows.sum()), bool)).reshape(len(rest), 6)
            left = rest - place @ np.linalg.lstsq(place, rest, rcond=None)[0]
            total += float(left @ left)
            count += len(rest) - 6
        return float(np.sqrt(total / count)) if count else float("nan")

    def _require(self, columns: Floats, known: int) -> None:
        hidden = identifiability(_without(columns[:, :known], columns[:, known:]), self.names)
        if hidden.rank < hidden.wanted:
            bad = (*hidden.unseen, *hidden.entangled)
            raise InputError(
                "these balls cannot tell the error motions from one another",
                code="volumetric.rank",
                got=f"rank {hidden.rank} of {hidden.wanted}: {', '.join(bad)[:160]}",
                hint="measure the fixed balls for the rigid motions, more poses for the others, or "
                "leave coefficients out",
            )


def averaged_balls(cycles: Sequence[Balls]) -> Balls:
    """Return the mean readings of some cycles, of the balls that each of them has."""
    first = cycles[0]
    sums = {key: [first.error_um[i]] for i, key in enumerate(keys_of(first))}
    for cycle in cycles[1:]:
        for i, key in enumerate(keys_of(cycle)):
            if key in sums:
                sums[key].append(cycle.error_um[i])
    whole = [i for i, key in enumerate(keys_of(first)) if len(sums[key]) == len(cycles)]
    keys = keys_of(first)
    return Balls(
        first.position_mm[whole],
        np.array([np.mean(sums[keys[i]], axis=0) for i in whole]),
        first.pose[whole],
        first.ball[whole],
    )


def keys_of(balls: Balls) -> list[tuple[int, int, int]]:
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
