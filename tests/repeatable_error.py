"""What the virtual cobot does wrong every time."""

from __future__ import annotations

import numpy as np

from dtwin.machines import mechanism as m_
from dtwin.machines._instrument_record import _path_geometry
from dtwin.machines.cobot import VirtualCobot
from dtwin.machines.motion import CircleCondition
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM


def repeatable_error_um(cobot: VirtualCobot, condition: CircleCondition) -> tuple[Floats, Floats, Floats]:
    """Return the truth without set-up, noise and drift, at every controller tick.

    Returns (n,), (n,) and (n, 3): machine time in s, radial error in um, error vector in the base frame in um.
    """
    condition = condition.standard()
    plan = cobot.plan(condition)
    truths = cobot.run(plan).truths
    vector_um = UM_PER_MM * (truths[:, m_.TCP : m_.TCP + 3] - truths[:, :3])
    _, _, radial = _path_geometry(plan, condition.plane, truths[:, :3])
    t_s = np.arange(len(truths)) / cobot.parameters.controller.rate_hz
    return t_s, np.sum(vector_um * radial, axis=1), vector_um
