"""What wanders without anyone commanding it."""

from __future__ import annotations

import numpy as np

from dtwin.schema import Floats


def wandering(rng: np.random.Generator, t_s: Floats, time_constant_s: float) -> Floats:
    """Return a stationary Ornstein-Uhlenbeck process of standard deviation 1, shape (n,).

    ``t_s``, (n,): ascending times.
    """
    kept = np.exp(-np.diff(t_s) / time_constant_s)
    pushes = rng.normal(size=len(t_s))
    value = pushes[0]
    out = [value]
    for keep, push in zip(kept.tolist(), pushes[1:].tolist(), strict=True):
        value = keep * value + np.sqrt(1.0 - keep * keep) * push
        out.append(value)
    return np.array(out)
