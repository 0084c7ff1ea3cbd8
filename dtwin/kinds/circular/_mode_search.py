"""Find the frequencies at which a robot's error rings after a start."""

from __future__ import annotations

import numpy as np

from dtwin.kinds.circular._library import Mode
from dtwin.schema import Floats
from dtwin.train.dataset import TickRun, input_column
from dtwin.train.rows import Rows

_FREQUENCIES_HZ = np.arange(4.0, 40.01, 0.25)
_DAMPING = (0.02, 0.035, 0.06)
_AFTER_S = 1.5
_SMALLEST_GAIN = 0.03
# Fewer rows after starts cannot tell modes; closer frequencies would be one mode found twice.
_FEWEST_ROWS, _APART_HZ = 200, 1.5
_MOST = 4


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
    while len(modes) < _MOST:
        near = [np.abs(_FREQUENCIES_HZ - mode.frequency_hz) <= _APART_HZ for mode in modes]
        gains = np.where(np.any(near, axis=0), 0.0, [one.taken(left) for one in ringing])
        which, place = np.unravel_index(int(np.argmax(gains)), gains.shape)
        if gains[which, place] < _SMALLEST_GAIN * float(left @ left):
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
    since = run.inputs[:, input_column("segment_time_s")].astype(float)
    start = np.maximum.accumulate(np.where(np.diff(since, prepend=1.0) < 0, np.arange(since.size), 0))[run.arc]
    q1 = run.inputs[:, input_column("q1_rad")].astype(float)
    radial, tangent = input_column("radial_x_1"), input_column("tangent_x_1")
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
