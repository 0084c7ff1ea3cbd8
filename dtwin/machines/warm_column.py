"""A milling head on a column that its spindle and its hall warm: a network of bodies, with sensors that are late.

Skins warm first, cores later, and cores are what moves the spindle nose: by growth, and by a bend where front and back
differ. All bodies obey C dT/dt = P + sum of G (T_other - T); between two steps the sources are constant, so that a step is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dtwin.machines._wandering import wandering
from dtwin.machines.thermal_network import conductances, exact_step
from dtwin.schema import Floats

STEP_S = 5.0
_SENSORS = ("spindle", "front", "back", "hall")
_BODIES = ("spindle", "front_skin", "front_core", "back_skin", "back_core", "bed")
# Heat capacity in kJ/K.
_CAPACITY = (15.0, 18.0, 110.0, 15.0, 90.0, 250.0)
# Conductance between two bodies, or a body and the hall's air, in W/K.
_LINKS = (
    ("spindle", "front_core", 12.0),
    ("front_skin", "front_core", 45.0),
    ("front_core", "back_core", 30.0),
    ("back_skin", "back_core", 40.0),
    ("front_core", "bed", 10.0),
    ("back_core", "bed", 10.0),
    ("spindle", "hall", 18.0),
    ("front_skin", "hall", 12.0),
    ("back_skin", "hall", 15.0),
    ("bed", "hall", 20.0),
)
# Share of the heat of the spindle's drive: its air blows on the skin in front.
_HEATED = {"spindle": 0.55, "front_skin": 0.45}
# What a degree of each body moves the nose by, up: growth of spindle and cores, and the bend by front against back, in um/K.
_UM_PER_K = {"spindle": -2.2, "front_core": 6.0, "back_core": 2.5}


@dataclass(frozen=True)
class ColumnParameters:
    """What the column is like.

    ``sunk``: whether sensors of front and back sit in pockets of the castings, else on their skins.
    ``air_share``: of the air beside a sensor on a skin in its reading.
    ``sensor_s``: time constant of a sensor.
    ``curve_per_k``: how far the scale of the front's sensor bends, 1/K.
    """

    sunk: bool = False
    air_share: float = 0.08
    sensor_s: float = 40.0
    curve_per_k: float = 0.0
    reading_c: float = 0.02
    probe_um: float = 0.5


@dataclass(frozen=True)
class Day:
    """A stretch of time, one value for each step.

    ``moved_um``: how far the nose has moved since the start, without noise.
    ``read_c``: what the sensors read.
    """

    t_s: Floats
    moved_um: Floats
    read_c: dict[str, Floats]


class WarmColumn:
    """The machine; a seed is of one day: its hall, its program, its noise."""

    def __init__(self, parameters: ColumnParameters | None = None) -> None:
        self.parameters = parameters or ColumnParameters()

    def drawn_program_w(self, hours: float, seed: int) -> Floats:
        """Return heat of the spindle at each step of a day of many jobs."""
        rng = np.random.default_rng([seed, 1])
        out = np.zeros(round(hours * 3600.0 / STEP_S))
        at = 0
        while at < out.size:
            until = at + int(rng.uniform(1200.0, 4800.0) / STEP_S)
            out[at:until] = rng.choice([0.0, 200.0, 400.0, 700.0])
            at = until
        return out

    def day(self, heat_w: Floats, seed: int) -> Day:
        """Return what a day does to the column. ``heat_w`` (n,): of the spindle, at each step."""
        rng = np.random.default_rng([seed, 2])
        n = heat_w.size
        t_s: Floats = STEP_S * np.arange(n, dtype=np.float64)
        hall = 21.0 + rng.uniform(-1.5, 1.5) + 0.8 * wandering(rng, t_s, 7200.0)
        hall += 0.6 * np.sin(2.0 * np.pi * t_s / 86400.0 + rng.uniform(0.0, 6.28))
        bodies = self._warmed(heat_w, hall, hall[0] + rng.uniform(-0.5, 0.5))
        moved = sum(per_k * (bodies[name] - bodies[name][0]) for name, per_k in _UM_PER_K.items())
        return Day(t_s, np.asarray(moved), self._read(bodies, hall, rng))

    def probed_um(self, moved_um: Floats, seed: int) -> Floats:
        """Return what a probe reads of the nose."""
        noise = np.random.default_rng([seed, 3]).standard_normal(moved_um.shape)
        return np.asarray(moved_um + self.parameters.probe_um * noise)

    def _warmed(self, heat_w: Floats, hall_c: Floats, begun_c: float) -> dict[str, Floats]:
        flow, air = conductances(_BODIES, _LINKS)
        kept, gained = exact_step(flow, _CAPACITY, STEP_S)
        powers = np.outer(hall_c, air)
        for body, share in _HEATED.items():
            powers[:, _BODIES.index(body)] += share * heat_w
        powers = powers @ gained.T
        now = np.full(len(_BODIES), begun_c)
        out = np.empty((heat_w.size, len(_BODIES)))
        for i in range(heat_w.size):
            out[i] = now
            now = kept @ now + powers[i]
        return dict(zip(_BODIES, out.T, strict=True))

    def _read(self, bodies: dict[str, Floats], hall_c: Floats, rng: np.random.Generator) -> dict[str, Floats]:
        made = self.parameters
        true = {"spindle": bodies["spindle"], "hall": hall_c}
        for side in ("front", "back"):
            skin = (1.0 - made.air_share) * bodies[f"{side}_skin"] + made.air_share * hall_c
            true[side] = bodies[f"{side}_core"] if made.sunk else skin
        true["front"] = true["front"] + made.curve_per_k * (true["front"] - 20.0) ** 2
        share = 1.0 - np.exp(-STEP_S / made.sensor_s)
        out = {}
        for name in _SENSORS:
            read = np.empty(hall_c.size)
            now = true[name][0]
            for i, value in enumerate(true[name]):
                now += share * (value - now)
                read[i] = now
            out[name] = np.round(read + made.reading_c * rng.standard_normal(read.size), 2)
        return out
