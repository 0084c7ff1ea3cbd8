"""What of the error of a rotary axis comes once and twice a turn."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtwin.positioning.matrix import LinearTest
from dtwin.statistics import f_quantile, rms, t_quantile

_FEWEST = 8
"""Places of a turn: five numbers are fitted to them."""
_UNEVEN = 1.5
"""Times the mean step that a gap may have: a turn that is measured in part has no waves of its own."""
_WAVES = (
    (1, "once", "graduation or encoder off centre, or the instrument"),
    (2, "twice", "graduation elliptic, or its two reading heads unlike"),
)
"""How many times a turn, in words, and what it may be."""
_CHANCE = 0.05
"""How often one of the waves is told where there is none."""


def waves(test: LinearTest) -> dict[str, Any]:
    """Return the waves of a whole turn, JSON-ready, in seconds of arc; empty where the targets are no whole turn or too few.

    They are fitted by least squares to the mean of both directions, run by run; ``k95_arcsec`` is what covers 95 % of
    the amplitude's scatter by what runs differ by, None of one run; ``chance_arcsec`` what an amplitude must exceed to be no chance,
    which is more, for it has two parts. At n even steps a wave of n - 1 times a turn looks like one
    of once: what a worm or a gear does is told by targets within one of its teeth alone.
    ``drift_arcsec``: how far the error goes on over a turn, where a place is measured again a turn later; it is no part of the
    waves. Where none is, a drift looks like them.
    """
    angle = np.radians(test.position_mm)
    place = np.unique(np.round(np.mod(test.position_mm, 360.0), 3))
    gaps = np.diff(place, append=place[:1] + 360.0)
    if place.size < _FEWEST or gaps.max() > _UNEVEN * 360.0 / place.size:
        return {}
    columns = [np.ones_like(angle), *(of(times * angle) for times, _, _ in _WAVES for of in (np.cos, np.sin))]
    again = place.size < np.unique(np.round(test.position_mm, 3)).size
    if again:
        columns.append(angle / (2.0 * np.pi))
    design = np.stack(columns, axis=1)
    middle = 0.5 * (test.forward_um + test.reverse_um)
    found, *_ = np.linalg.lstsq(design, middle, rcond=None)
    runs = middle.shape[1]
    told = []
    for number, (times, often, may_be) in enumerate(_WAVES):
        both = found[1 + 2 * number : 3 + 2 * number]
        cosine, sine = both.mean(axis=1)
        half = chance = None
        if runs > 1:
            deviation = np.sqrt(np.mean(both.var(axis=1, ddof=1)))
            dof = 2.0 * (runs - 1)
            half = float(t_quantile(0.975, dof) * deviation / np.sqrt(runs))
            chance = float(np.sqrt(2.0 * f_quantile(_CHANCE / len(_WAVES), (2.0, dof)) / runs) * deviation)
        at = float(np.degrees(np.arctan2(sine, cosine)) / times % (360.0 / times))
        told.append(
            {
                "times_a_turn": times,
                "often": often,
                "amplitude_arcsec": float(np.hypot(cosine, sine)),
                "k95_arcsec": half,
                "chance_arcsec": chance,
                "largest_at_deg": at,
                "may_be": may_be,
            }
        )
    left = middle.mean(axis=1) - design @ found.mean(axis=1)
    drift = {"drift_arcsec": float(found[-1].mean())} if again else {}
    return {"waves": told, **drift, "left_rms_arcsec": rms(left)}
