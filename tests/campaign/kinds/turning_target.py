"""A made-up target on a turning axis, in closed form: what probes read, and the files that they leave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from dtwin.schema import Floats


@dataclass(frozen=True)
class Target:
    """What a probe reads is a sum of these, in µm.

    ``once``: amplitude and phase, deg. ``lobes``: amplitude and phase by times a turn. ``others``: the same by orders that are no
    whole number. ``dips``: angle, width in deg, depth; of a rectangle. ``each_turn_um``: what lobe 3 differs by from turn to turn.
    """

    once: tuple[float, float] = (8.0, 30.0)
    lobes: Mapping[int, tuple[float, float]] = field(default_factory=lambda: {2: (1.0, 10.0), 3: (0.6, 80.0)})
    others: Mapping[float, tuple[float, float]] = field(default_factory=dict)
    dips: tuple[tuple[float, float, float], ...] = ()
    each_turn_um: float = 0.0
    noise_um: float = 0.05
    drift_um_turn: float = 0.0

    def read(self, angle_deg: Floats, seed: int) -> Floats:
        """Return the readings at angles that go on from turn to turn."""
        rng = np.random.default_rng(seed)
        a = np.deg2rad(angle_deg)
        out = self.once[0] * np.cos(a - np.deg2rad(self.once[1])) + self.drift_um_turn * angle_deg / 360.0
        for order, (um, phase) in (*self.lobes.items(), *self.others.items()):
            out = out + um * np.cos(order * a - np.deg2rad(phase))
        for at, width, depth in self.dips:
            out = out - depth * (np.abs((angle_deg - at + 180.0) % 360.0 - 180.0) < width / 2.0)
        turn = np.floor(angle_deg / 360.0).astype(int)
        turn -= turn.min()
        differs = rng.normal(0.0, 1.0, (2, turn.max() + 1)) * self.each_turn_um
        out = out + differs[0, turn] * np.cos(3 * a) + differs[1, turn] * np.sin(3 * a)
        return np.asarray(out + rng.normal(0.0, self.noise_um, a.size))

    def synchronous_um(self, once: bool = False) -> float:
        """Return the range of the mean turn, without what comes once per turn or with it; dips are left out."""
        a = np.deg2rad(np.arange(0.0, 360.0, 0.05))
        kept = {**self.lobes, **({1: self.once} if once else {})}
        return float(np.ptp(sum(um * np.cos(k * a - np.deg2rad(p)) for k, (um, p) in kept.items())))


def turned(turns: float, readings: int = 200, begin: float = 17.0) -> Floats:
    """Return angles of steady turns."""
    return begin + 360.0 * np.arange(round(turns * readings)) / readings


def table(columns: Mapping[str, Floats], part: str = ",", form: Callable[[float], str] = lambda v: f"{v:.6f}") -> str:
    """Return columns by head as text."""
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    return "\n".join([part.join(columns), *(part.join(map(form, row)) for row in rows)]) + "\n"
