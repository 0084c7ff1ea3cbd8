"""What a machine that is served is doing now, as far as its board shows it."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass

import numpy as np

from dtwin.serve import safety
from dtwin.serve.live_board import Seen
from dtwin.serve.safety import REASONS

RECENT_S = 5.0
"""Controller time that a state is told of."""
_NOW_S = 0.5
"""Controller time that is now: what was before a pause, or in it, is no longer true."""
_CORRECTS = (safety.OK, safety.SHRUNK, safety.CLAMPED, safety.SLEWED)
_SILENT_S = 1.0


@dataclass(frozen=True)
class _LiveState:
    """What a served machine is doing now.

    ``word``, one of "starting", "correcting", "outside", "held", "silent": ``starting``: no tick was seen yet;
    ``outside``: outside the model's range now; ``held``: zeros are sent now for another reason, as of a dry run;
    ``silent``: the loop shows no new ticks.
    ``said``: the same as the end of a sentence that begins with the machine.
    ``outside_share``: share of the newest ticks outside the model's range.
    """

    word: str
    said: str
    outside_share: float = 0.0

    def as_dict(self) -> dict[str, str | float]:
        return asdict(self)


def live_state(seen: Seen | None, now_s: float) -> _LiveState:
    """Return what a board shows of the newest seconds.

    ``seen``: the board; None when there is none, as before the first tick and of loops that have none.
    ``now_s``: this computer's ``time.monotonic()``.
    """
    if seen is None or not seen.ticks:
        return _LiveState("starting", "is held by a server that has shown no tick yet")
    silent_s = now_s - seen.shown_s
    if silent_s > _SILENT_S:
        return _LiveState("silent", f"was not answered for {silent_s:z.0f} s: what is in force is not known")
    reasons = seen.column("reason")[seen.newest(RECENT_S)].astype(int)
    outside = float(np.mean(reasons == safety.OUTSIDE))
    beyond = f"outside the model's range for {100 * outside:z.0f} % of the newest {RECENT_S:z.0f} s"
    now = seen.column("reason")[seen.newest(_NOW_S)].astype(int)
    held = now[~np.isin(now, (*_CORRECTS, safety.OUTSIDE))]
    # A latched guard stays so: what was before it is no longer true.
    if now[-1] == safety.LATCHED or 2 * len(held) > len(now):
        often = safety.LATCHED if now[-1] == safety.LATCHED else Counter(held.tolist()).most_common(1)[0][0]
        return _LiveState("held", f"is not corrected now: {REASONS[often].replace('_', ' ')}", outside)
    if 2 * np.count_nonzero(now == safety.OUTSIDE) > len(now):
        return _LiveState("outside", f"is not corrected now: {beyond}", outside)
    if not seen.corrects:
        return _LiveState("held", "is not corrected: a dry run sends zeros", outside)
    return _LiveState("correcting", "is being corrected" + (f", {beyond}" if outside > 0 else ""), outside)
