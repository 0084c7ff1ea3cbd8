"""Set-ups whose centre moved between runs at one feed and runs at another, though they have one name."""

from __future__ import annotations

import numpy as np

from dtwin.physics import localise
from dtwin.physics.observations import Observations
from dtwin.schema import Floats
from dtwin.units import shown_number

# Of the mean square that is left: so much of it, centres of their own explain.
_MOST = 0.8


def moved_setup(obs: Observations, left: Floats) -> str:
    """Return which set-up moved most, how far and what to do, in words; empty unless such moves make most of what is left.

    ``left``, (rows, n): um, what the effects found leave.
    """
    if not obs.grid.in_plane:
        return ""
    means = localise.condition_means(obs, left)
    circle = np.stack([np.cos(obs.grid.phase_rad), np.sin(obs.grid.phase_rad), np.ones(obs.n_bins)], axis=1)
    first = [int(np.flatnonzero(obs.condition_of == c)[0]) for c in range(len(obs.conditions))]
    explained, by_um, said = 0.0, 0.0, ""
    for setup in range(len(obs.setups)):
        mine = [c for c, row in enumerate(first) if obs.setup_of[row] == setup]
        centres = {}
        for feed in sorted({obs.conditions[c].feed_mm_min for c in mine}):
            of_feed = [c for c in mine if obs.conditions[c].feed_mm_min == feed]
            mask = np.concatenate([obs.mask[first[c]] for c in of_feed])
            columns, y = np.tile(circle, (len(of_feed), 1))[mask], means[of_feed].ravel()[mask]
            found = np.linalg.lstsq(columns, y, rcond=None)[0]
            # An effect may change the radius, too.
            explained += float(((y - y.mean()) ** 2).sum() - ((y - columns @ found) ** 2).sum())
            centres[feed] = found[:2]
        for feed, centre in centres.items():
            for other in (f for f in centres if f > feed):
                apart_um = float(np.hypot(*(centres[other] - centre)))
                if apart_um > by_um:
                    feeds = f"{shown_number(feed)} and {shown_number(other)} mm/min"
                    by_um, name = apart_um, obs.runs[first[mine[0]]].setup
                    said = (
                        f"as if set-up {name} had moved by {shown_number(apart_um, 2)} µm between its runs at {feeds}"
                    )
    if not said or explained < _MOST * float((means**2).sum()):
        return ""
    return f"{said}; give runs after a move a set-up of another name"
