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


def find_modes(rows: Rows, residual_um: Floats, *, most: int = 4) -> list[Mode]:
    """Add one decaying oscillation after the other while the residual after starts falls.

    ``residual_um``, (n,): what position-locked terms leave.
    ``most``: largest number of modes.
    """
    since_s, directions = _after_start(rows)
    inside = np.flatnonzero((since_s < _AFTER_S) & (since_s > 0.0))
    since_s, directions, left = since_s[inside], directions[inside], residual_um[inside].copy()
    modes: list[Mode] = []
    while len(modes) < most and left.size > 200:
        scored = [
            (_explained(left, since_s, directions, mode)[0], mode)
            for mode in (
                Mode(float(f), z)
                for f in _FREQUENCIES_HZ
                for z in _DAMPING
                if all(abs(f - m.frequency_hz) > 1.5 for m in modes)
            )
        ]
        gain, mode = max(scored, key=lambda pair: pair[0])
        if gain < _SMALLEST_GAIN * float(left @ left):
            break
        modes.append(mode)
        left -= _explained(left, since_s, directions, mode)[1]
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


def _explained(left: Floats, since_s: Floats, directions: Floats, mode: Mode) -> tuple[float, Floats]:
    """Return the sum of squares that a mode takes from a residual, and its prediction."""
    w = 2.0 * np.pi * mode.frequency_hz
    decay = np.exp(-mode.damping_ratio * w * since_s)
    waves = [decay * np.cos(w * since_s), decay * np.sin(w * since_s)]
    terms = np.column_stack([directions * wave[:, None] for wave in waves])
    gram = terms.T @ terms
    moment = terms.T @ left
    ridge = 1e-4 * np.trace(gram) / len(gram) * np.eye(len(gram))
    weights = np.linalg.solve(gram + ridge, moment)
    return float(moment @ weights), np.asarray(terms @ weights)
