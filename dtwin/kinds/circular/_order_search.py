"""Find the orders per joint turn at which a robot's error repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dtwin.kinds.circular._library import FLANK_RAD, Gear
from dtwin.progress import Progress
from dtwin.schema import Floats
from dtwin.train.dataset import input_column
from dtwin.train.rows import Rows

_COARSE = np.arange(20.0, 460.0, 4.0)
_FINE = np.arange(-4.0, 4.01, 0.5)
_SMALLEST_GAIN = 0.01
# Orders at the most; of the rows each second one is looked at.
_MOST, _EVERY = 16, 2


def find_gears(
    rows: Rows, explained: Callable[[Sequence[Gear]], Floats], *, progress: Progress | None = None
) -> list[Gear]:
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
        if progress is not None:
            progress(step + 1, _MOST, f"joint {gears[-1].joint} order {gears[-1].order:g}")
    return gears


def _joint_state(rows: Rows) -> tuple[Floats, Floats, Floats]:
    """Return joint angles, levers and loaded flanks at the rows, shapes (n, 6)."""
    first_q, first_lever = input_column("q1_rad"), input_column("lever_1_mm_rad")
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
