"""How a diagnosis says what it did not resolve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dtwin.physics import localise
from dtwin.physics._screen import Channel
from dtwin.physics._search import Search
from dtwin.physics.diagnosis import Unresolved
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.schema import Floats
from dtwin.units import shown_number


def many_runs(obs: Observations) -> str:
    """Return how many runs a campaign has, in words."""
    return f"{int(obs.run_of.max()) + 1} runs"


def unresolved_part(search: Search, left: Floats, p_value: float, laws_um: float = 0.0, laws: str = "") -> Unresolved:
    """Describe what the effects that are believed leave.

    ``left``, (rows, n): um, without what laws that have no name do, which is ``laws_um`` as RMS, and ``laws`` in words.
    """
    obs = search.plain.obs
    rms_um = float(np.hypot(localise.systematic_rms_um(obs, left), laws_um))
    return Unresolved(
        systematic_rms_um=rms_um,
        share=min(1.0, (rms_um / max(search.systematic_um[0], 1e-9)) ** 2),
        p_value=p_value,
        words=laws or localise.headline(obs, left),
        where=localise.worst_places(obs, left),
    )


def unexplained(words: str, channels: Sequence[Channel], search: Search, known: Sequence[Term]) -> str:
    """Return why nothing has a name; ``words``: what is left."""
    because = "no known effect explains it"
    if known:
        whole_um = localise.systematic_rms_um(search.plain.obs, localise.residual_um(search.plain.obs, []))
        of_um = f"{shown_number(search.systematic_um[0], 2)} of {shown_number(whole_um, 2)} µm"
        because = f"no known effect explains what is left, {of_um}"
    if search.untold:
        because = f"{' or '.join(search.untold)} may be it, which {many_runs(search.plain.obs)} do not tell"
    moving = ", ".join(c.name for c in channels)
    return f"{because}: {words}" + f"; it moves with {moving}" * bool(moving)
