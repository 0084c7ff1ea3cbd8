"""Find the orders per joint turn at which a robot's error repeats, and the frequencies at which it rings after a start."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dtwin.features.path_inputs import PATH_INPUTS
from dtwin.kinds.circular._library import FLANK_RAD, Gear, Mode
from dtwin.progress import Progress, silent
from dtwin.schema import Floats
from dtwin.train.campaign_rows import Rows
from dtwin.train.dataset import TickRun

_COARSE = np.arange(20.0, 460.0, 4.0)
_FINE = np.arange(-4.0, 4.01, 0.5)
_SMALLEST_GAIN = 0.01
# Orders at the most; of the rows each second one is looked at.
_MOST, _EVERY = 16, 2


def find_gears(rows: Rows, explained: Callable[[Sequence[Gear]], Floats], *, progress: Progress = silent) -> list[Gear]:
    """Add one order of one joint after the other while the residual falls.

    Every order of every joint is correlated with the residual of the terms so far
    (orthogonal matching pursuit); the best one is refined and joins them. The search ends
    when an order explains less than one per cent of what is left.

    ``explained``: given the gears so far, returns the fitted prediction at all rows.
    """
    some = np.arange(0, rows.n, _EVERY)
    q, lever, flank = (part[some] for part in _joint_state(rows))
    coarse = [_Waves(q[:, j], lever[:, j], flank[:, j], _COARSE) for j in range(6)]
    gears: list[Gear] = []
    residual = rows.target_um - explained(gears)
    for step in range(_MOST):
        part = residual[some]
        taken = np.array([waves.taken(part) for waves in coarse])
        j, place = np.unravel_index(int(np.argmax(taken)), taken.shape)
        fine = _COARSE[place] + _FINE
        refined = _Waves(q[:, j], lever[:, j], flank[:, j], fine).taken(part)
        if float(refined.max()) < _SMALLEST_GAIN * float(part @ part):
            break
        gears.append(Gear(int(j) + 1, float(fine[int(np.argmax(refined))])))
        residual = rows.target_um - explained(gears)
        progress(step + 1, _MOST, f"joint {gears[-1].joint} order {gears[-1].order:g}")
    return gears


def _joint_state(rows: Rows) -> tuple[Floats, Floats, Floats]:
    """Return joint angles, levers and loaded flanks at the rows, shapes (n, 6)."""
    first_q, first_lever = PATH_INPUTS.index("q1_rad"), PATH_INPUTS.index("lever_1_mm_rad")
    q = np.concatenate([run.inputs[run.arc, first_q : first_q + 6] for run in rows.runs])
    lever = np.concatenate([run.inputs[run.arc, first_lever : first_lever + 6] for run in rows.runs])
    flank = np.concatenate([_flank(run.inputs[:, first_q : first_q + 6].astype(float))[run.arc] for run in rows.runs])
    return q.astype(float), lever.astype(float), flank


def _flank(q: Floats) -> Floats:
    """Return the sign of the last motion of each joint that exceeded the play."""
    moved = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    moved[np.abs(np.diff(q, axis=0, prepend=q[:1])) < 0.01 * FLANK_RAD] = 0.0
    index = np.where(moved != 0.0, np.arange(len(q))[:, None], 0)
    return np.asarray(np.take_along_axis(moved, np.maximum.accumulate(index, axis=0), axis=0))


class _Waves:
    """The four terms of each of several orders of a joint: cosine and sine, the same with the sign of the flank.

    ``q_rad``, ``lever``, ``flank``, (n,): of the joint.
    ``orders``: evenly spaced.
    """

    def __init__(self, q_rad: Floats, lever: Floats, flank: Floats, orders: Floats) -> None:
        # The orders lie evenly: each wave is the one before, turned further.
        turns = np.empty((orders.size, q_rad.size), dtype=complex)
        turns[0], turns[1:] = np.exp(1j * orders[0] * q_rad), np.exp(1j * (orders[1] - orders[0]) * q_rad)
        spun = np.multiply.accumulate(turns, axis=0)
        waves = np.stack([spun.real, spun.imag], axis=1) * lever
        turned = waves * flank
        plain, mixed, both = (a @ b.transpose(0, 2, 1) for a, b in ((waves, waves), (waves, turned), (turned, turned)))
        gram = np.block([[plain, mixed], [mixed, both]])
        size = np.trace(gram, axis1=1, axis2=2)
        self._still = size <= 1e-12 * q_rad.size
        gram += np.where(self._still, 1.0, 1e-6 * size)[:, None, None] * np.eye(4)
        self._gram, self._flank = gram, flank
        # Single precision: what is kept is large, and only compared.
        self._waves = waves.reshape(-1, q_rad.size).astype(np.float32)

    def taken(self, residual: Floats) -> Floats:
        """Return the sum of squares that the terms of each order take from a residual (n,), shape (orders,)."""
        seen = self._waves @ np.column_stack([residual, residual * self._flank]).astype(np.float32)
        moment = seen.reshape(-1, 2, 2).transpose(0, 2, 1).reshape(-1, 4).astype(float)
        weights = np.linalg.solve(self._gram, moment[:, :, None])[:, :, 0]
        return np.where(self._still, 0.0, np.sum(moment * weights, axis=1))


_FREQUENCIES_HZ = np.arange(4.0, 40.01, 0.25)
_DAMPING = (0.02, 0.035, 0.06)
_AFTER_S = 1.5
_LEAST_GAIN_OF_MODE = 0.03
# Fewer rows after starts cannot tell modes; closer frequencies would be one mode found twice.
_FEWEST_ROWS, _APART_HZ = 200, 1.5
_MOST_MODES = 4


def find_modes(rows: Rows, residual_um: Floats) -> list[Mode]:
    """Add one decaying oscillation after the other while the residual after starts falls.

    ``residual_um``, (n,): what position-locked terms leave.
    """
    since_s, directions = _after_start(rows)
    inside = np.flatnonzero((since_s < _AFTER_S) & (since_s > 0.0))
    left = residual_um[inside].copy()
    if left.size <= _FEWEST_ROWS:
        return []
    ringing = [_Ringing(since_s[inside], directions[inside], damping) for damping in _DAMPING]
    modes: list[Mode] = []
    while len(modes) < _MOST_MODES:
        near = [np.abs(_FREQUENCIES_HZ - mode.frequency_hz) <= _APART_HZ for mode in modes]
        gains = np.where(np.any(near, axis=0), 0.0, [one.taken(left) for one in ringing])
        which, place = np.unravel_index(int(np.argmax(gains)), gains.shape)
        if gains[which, place] < _LEAST_GAIN_OF_MODE * float(left @ left):
            break
        modes.append(Mode(float(_FREQUENCIES_HZ[place]), _DAMPING[which]))
        left -= ringing[which].explained(int(place), left)
    return modes


def _after_start(rows: Rows) -> tuple[Floats, Floats]:
    """Return time since segment start, and kick times view for the nine direction pairs."""
    times, pairs = [], []
    for run in rows.runs:
        since, products = _run_after_start(run)
        times.append(since)
        pairs.append(products)
    return np.concatenate(times), np.concatenate(pairs)


def _run_after_start(run: TickRun) -> tuple[Floats, Floats]:
    since = run.inputs[:, PATH_INPUTS.index("segment_time_s")].astype(float)
    start = np.maximum.accumulate(np.where(np.diff(since, prepend=1.0) < 0, np.arange(since.size), 0))[run.arc]
    q1 = run.inputs[:, PATH_INPUTS.index("q1_rad")].astype(float)
    radial, tangent = PATH_INPUTS.index("radial_x_1"), PATH_INPUTS.index("tangent_x_1")
    seen = _turned(run.inputs[run.arc, radial : radial + 3].astype(float), q1[run.arc])
    kick = _turned(run.inputs[start + 1, tangent : tangent + 3].astype(float), q1[start + 1])
    feed = float(run.meta.feed_mm_min or 0.0) / 1000.0
    products = (kick[:, :, None] * seen[:, None, :]).reshape(len(run.arc), 9) * feed
    return since[run.arc], products


def _turned(vector: Floats, q1: Floats) -> Floats:
    cos, sin = np.cos(q1), np.sin(q1)
    x, y, z = vector.T
    return np.column_stack([x * cos + y * sin, y * cos - x * sin, z])


class _Ringing:
    """The terms of every frequency at one damping: each pair of directions times a decaying cosine, and a sine.

    ``since_s``, (n,): time since the start.
    ``directions``, (n, 9): pairs of directions.
    """

    def __init__(self, since_s: Floats, directions: Floats, damping_ratio: float) -> None:
        w = 2.0 * np.pi * _FREQUENCIES_HZ[:, None]
        decay = np.exp(-damping_ratio * w * since_s)
        waves = np.stack([decay * np.cos(w * since_s), decay * np.sin(w * since_s)], axis=1)
        pairs = (directions[:, :, None] * directions[:, None, :]).reshape(len(directions), -1)
        squares = np.stack([waves[:, i] * waves[:, j] for i, j in ((0, 0), (0, 1), (1, 1))]) @ pairs
        plain, mixed, both = squares.reshape(3, w.size, 9, 9)
        gram = np.block([[plain, mixed], [mixed, both]])
        ridge = 1e-4 * np.trace(gram, axis1=1, axis2=2) / gram.shape[1]
        self._gram = gram + ridge[:, None, None] * np.eye(gram.shape[1])
        # Single precision: what is kept is large, and only compared.
        self._waves, self._directions = waves.astype(np.float32), directions

    def taken(self, left: Floats) -> Floats:
        """Return the sum of squares that each frequency takes from a residual (n,), shape (frequencies,)."""
        moment = (self._waves @ (self._directions * left[:, None]).astype(np.float32)).reshape(len(self._gram), -1)
        return np.einsum("fi,fi->f", moment, np.linalg.solve(self._gram, moment[:, :, None])[:, :, 0])

    def explained(self, place: int, left: Floats) -> Floats:
        """Return what the terms of one frequency explain of a residual, (n,)."""
        terms = np.concatenate([self._directions * wave[:, None] for wave in self._waves[place]], axis=1)
        return np.asarray(terms @ np.linalg.solve(self._gram[place], terms.T @ left))
