"""Whether something foretells stretches of time that were held out, and whether time alone foretells them as well.

What only wanders or rises takes much of whatever wanders or rises; a cause takes more than a course of time does.
Squares are those that are left in each stretch when it was held out, shape (stretches,).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dtwin.schema import Floats
from dtwin.statistics import gain_tail

ALPHA = 0.05
MATERIAL = 0.02
"""Share of the squares left on stretches held out that something must take to count."""
TIME_ALONE = "time alone"
_SETTLING = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Time constants of what settles, as shares of a log."""
_TAU_TO = 0.01


def share_taken(before: Floats, after: Floats) -> float:
    """Return the share of the squares that something takes; of nothing it takes nothing."""
    whole = float(before.sum())
    return 1.0 - float(after.sum()) / whole if whole > 0.0 else 0.0


def is_no_less(left: Floats, other: Floats) -> bool:
    """Tell whether another leaves less only as chance may."""
    return share_taken(left, other) <= MATERIAL or gain_tail(left, other) >= ALPHA


def needed(without: Floats, now: Floats, much: float) -> bool:
    """Tell whether something takes enough: surely, or a share of at least ``much`` even where stretches do not agree."""
    share = share_taken(without, now)
    return share > MATERIAL and (share > much or gain_tail(without, now) < ALPHA)


def courses(t_s: Floats) -> tuple[Floats, ...]:
    """Return courses of time, nought at its begin, shape (n,) each: straight, and what settles."""
    part = _part(t_s)
    return part, *(_settling(part, tau) for tau in _SETTLING)


def left_with_time(t_s: Floats, left: Callable[[Floats], Floats]) -> Floats:
    """Return the least squares with a course of time: straight, or an exponential.

    ``left``: returns the squares with a course, shape (n,), as one column more.
    """
    part = _part(t_s)

    def settling(tau: float) -> Floats:
        return left(_settling(part, tau))

    near = min(_SETTLING, key=lambda tau: float(settling(tau).sum()))
    import scipy

    # Where it is a little off, what is left looks like more than noise.
    best = scipy.optimize.minimize_scalar(
        lambda log: float(settling(float(np.exp(log))).sum()),
        bounds=(np.log(0.5 * near), np.log(2.0 * near)),
        method="bounded",
        options={"xatol": _TAU_TO},
    )
    return min(left(part), settling(float(np.exp(best.x))), key=lambda one: float(one.sum()))


def _part(t_s: Floats) -> Floats:
    return np.asarray((t_s - t_s.min()) / (float(np.ptp(t_s)) or 1.0))


def _settling(part: Floats, tau: float) -> Floats:
    return np.exp(-part / tau) - 1.0
