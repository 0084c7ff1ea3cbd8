"""The harder rival: harmonics whose orders are chosen the way effects are chosen."""

from __future__ import annotations

import numpy as np

from dtwin.kinds.circular._recording_models import Passes, stack
from dtwin.kinds.circular._recording_search import Search
from dtwin.schema import Floats

_HIGHEST = 90
_PER_ORDER = 3


def chosen_harmonics(passes: Passes, most: int, *, by_direction: bool) -> tuple[int, tuple[Floats, Floats]]:
    """Return harmonics added one after the other by what they leave on the other pass.

    An order counts as three parameters: two amplitudes and its number, as shapes of effects do.

    ``by_direction``: each direction has orders of its own.
    Returns ``columns`` (n, k): model in both passes.
    """
    runs = range(len(passes.aligned))
    groups = [(run,) for run in runs] if by_direction else [tuple(runs)]
    model = stack([_wave(passes, 0, group) for group in groups])
    pool = [_wave(passes, order, group) for group in groups for order in range(1, _HIGHEST + 1)]
    search = Search(passes.y_um, pool)
    search.add(model)
    chosen: list[int] = []
    while len(groups) + _PER_ORDER * (len(chosen) + 1) <= most and len(chosen) < len(pool):
        left_um = search.left_um()
        left_um[chosen] = np.inf
        best = int(np.argmin(left_um))
        search.add(pool[best])
        chosen.append(best)
    model = stack([model, *(pool[number] for number in chosen)])
    return len(groups) + _PER_ORDER * len(chosen), model


def _wave(passes: Passes, order: int, group: tuple[int, ...]) -> tuple[Floats, Floats]:
    whole = []
    for number, aligned in enumerate(passes.aligned):
        phase = order * aligned.state.angle_rad
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=1)[:, : 2 if order else 1]
        whole.append(waves * float(number in group))
    return passes.both(whole)
