"""Heat in a milling machine and its hall: bodies that exchange heat, sources that go on and off.

The bodies obey C dT/dt = P + sum of G (T_other - T); between two readings the sources are constant,
so a step is exact whatever its length.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from dtwin.schema import Floats

# Castings have a skin, where thermocouples are stuck on, and a core, which deforms them.
CASTINGS = ("table", "bed", "column_side", "column_back", "column_top", "ram")
_OTHERS = ("front_air", "back_air", "foundation", "coolant_tank")
BODIES = (*CASTINGS, *_OTHERS, *(f"{name}_core" for name in CASTINGS))
# Heat capacity in kJ/K; of a casting with its core.
_CASTING = (900.0, 1600.0, 420.0, 420.0, 700.0, 480.0)
_SKIN_SHARE = 0.35
_CAPACITY = (
    *(_SKIN_SHARE * c for c in _CASTING),
    30.0,
    30.0,
    9000.0,
    250.0,
    *((1.0 - _SKIN_SHARE) * c for c in _CASTING),
)
_CORE_S = 2.2 * 3600.0
# Conductance between two bodies, or a body and the hall's air ("hall"), in W/K.
_LINKS = (
    ("table", "front_air", 22.0),
    ("table", "bed", 14.0),
    ("bed", "back_air", 30.0),
    ("bed", "foundation", 20.0),
    ("bed", "column_side", 9.0),
    ("bed", "column_back", 9.0),
    ("column_side", "column_back", 12.0),
    ("column_side", "column_top", 14.0),
    ("column_back", "column_top", 14.0),
    ("column_side", "back_air", 16.0),
    ("column_back", "back_air", 16.0),
    ("column_top", "back_air", 22.0),
    ("column_top", "ram", 16.0),
    ("ram", "front_air", 16.0),
    ("front_air", "hall", 60.0),
    ("back_air", "hall", 240.0),
    ("foundation", "hall", 25.0),
    ("coolant_tank", "front_air", 6.0),
)
# Bodies that the hot air of a ventilator reaches, and its share.
_VENTILATORS = {
    "h1": (("column_side", 0.75), ("bed", 0.10), ("back_air", 0.15)),
    "h2": (("column_back", 0.75), ("bed", 0.10), ("back_air", 0.15)),
}
_VENTILATOR_W = 700.0
_PUMP_W = 45.0


@dataclass(frozen=True)
class _Segment:
    """A stretch of the campaign with constant sources.

    ``h1``, ``h2``: ventilators at the side and at the back of the column.
    """

    until_h: float
    h1: bool = False
    h2: bool = False
    hall_c: float = 22.0


@dataclass(frozen=True)
class Schedule:
    """What heats a machine during a campaign.

    ``segments``: one after the other.
    ``day_swing_c``: half the daily swing of the hall.
    ``off_from_h``, ``night_rise_c``: hour of the day at which the climate control goes off, and how far the hall then
    drifts; 24 for a control that stays on.
    ``begun_c``, ``season_c``: temperature of the machine and of its foundation at the start.
    """

    name: str
    segments: tuple[_Segment, ...]
    day_swing_c: float = 0.4
    off_from_h: float = 24.0
    night_rise_c: float = 0.0
    begun_c: float = 22.0
    season_c: float = 21.5

    @property
    def length_h(self) -> float:
        """Length of the campaign."""
        return self.segments[-1].until_h

    def at(self, hour: float) -> _Segment:
        """Return the segment of a time."""
        return next((s for s in self.segments if hour < s.until_h), self.segments[-1])

    def hall_c(self, hour: float) -> float:
        """Return the temperature that the hall tends to."""
        of_day = (8.0 + hour) % 24.0
        out = self.at(hour).hall_c + self.day_swing_c * float(np.sin(2 * np.pi * (of_day - 9.0) / 24))
        night = of_day >= self.off_from_h or of_day < 6.0
        return out + (self.night_rise_c if night and self.off_from_h < 24.0 else 0.0)


_TRAINING = Schedule(
    "training",
    (
        _Segment(71),
        _Segment(81, h1=True),
        _Segment(93),
        _Segment(103, h2=True),
        _Segment(119),
        _Segment(129, h1=True, h2=True),
        _Segment(145),
        _Segment(159, h1=True),
        _Segment(173, h2=True),
        _Segment(186),
        _Segment(198, hall_c=17.5),
        _Segment(210, hall_c=26.5),
        _Segment(222, hall_c=18.0),
        _Segment(234, hall_c=26.5),
    ),
)
_VALIDATION = Schedule(
    "validation",
    (
        _Segment(48, hall_c=24.0),
        _Segment(54, h2=True, hall_c=24.0),
        _Segment(62, hall_c=24.0),
        _Segment(69, h1=True, h2=True, hall_c=24.0),
        _Segment(82, hall_c=24.0),
        _Segment(90, h1=True, hall_c=24.0),
        _Segment(108, hall_c=24.0),
        _Segment(114, h2=True, hall_c=24.0),
        _Segment(122, hall_c=24.0),
        _Segment(132, h1=True, hall_c=24.0),
        _Segment(144, hall_c=21.0),
        _Segment(156, hall_c=27.0),
        _Segment(169, hall_c=24.7),
    ),
    day_swing_c=0.7,
    off_from_h=18.0,
    night_rise_c=2.0,
    begun_c=25.6,
    season_c=24.6,
)
SCHEDULES = {schedule.name: schedule for schedule in (_TRAINING, _VALIDATION)}


def temperatures_c(schedule: Schedule, step_s: float, *, pump: bool = False) -> tuple[Floats, Floats]:
    """Return the temperatures of every body during a campaign.

    ``pump``: whether the coolant pump runs, twelve hours in every thirty.
    Returns ``hour`` (n,): time.
    Returns ``bodies`` (n, bodies): in the order of ``BODIES``.
    """
    n = round(schedule.length_h * 3600.0 / step_s)
    hour: Floats = np.arange(n, dtype=np.float64) * step_s / 3600.0
    flow, hall = _network()
    powers = np.array([_power_w(schedule.at(float(h)), float(h), pump=pump) for h in hour])
    powers += np.outer([schedule.hall_c(float(h)) for h in hour], hall)
    moved, gained = exact_step(flow, _CAPACITY, step_s)
    now = np.full(len(BODIES), schedule.begun_c)
    now[BODIES.index("foundation")] = schedule.season_c
    out = np.empty((n, len(BODIES)))
    for i in range(n):
        out[i] = now
        now = moved @ now + gained @ powers[i]
    return hour, out


def pumping(hour: Floats) -> Floats:
    """Return 1 at hours at which the coolant pump runs, else 0."""
    return np.where(hour % 30.0 < 12.0, 1.0, 0.0)


def _network() -> tuple[Floats, Floats]:
    """Return the conductances between the bodies, and those to the hall, in W/K."""
    cores = [
        (name, f"{name}_core", 1000.0 * (1.0 - _SKIN_SHARE) * capacity / _CORE_S)
        for name, capacity in zip(CASTINGS, _CASTING, strict=True)
    ]
    return conductances(BODIES, (*_LINKS, *cores))


def conductances(bodies: Sequence[str], links: Iterable[tuple[str, str, float]]) -> tuple[Floats, Floats]:
    """Return the conductances between bodies, shape (n, n), and those to the hall, (n,), of links in W/K."""
    flow, hall = np.zeros((len(bodies), len(bodies))), np.zeros(len(bodies))
    for one, other, conductance in links:
        i = bodies.index(one)
        flow[i, i] -= conductance
        if other == "hall":
            hall[i] += conductance
            continue
        j = bodies.index(other)
        flow[j, j] -= conductance
        flow[i, j] += conductance
        flow[j, i] += conductance
    return flow, hall


def exact_step(flow: Floats, capacity_kj_k: Sequence[float], step_s: float) -> tuple[Floats, Floats]:
    """Return what a step keeps of temperatures, and what it makes of constant powers, shape (n, n) each."""
    capacity = 1000.0 * np.array(capacity_kj_k)
    rate = flow / capacity[:, None]
    kept = expm(rate * step_s)
    return kept, np.linalg.solve(rate, kept - np.eye(len(capacity))) / capacity


def _power_w(segment: _Segment, hour: float, *, pump: bool) -> Floats:
    out = np.zeros(len(BODIES))
    for name, on in (("h1", segment.h1), ("h2", segment.h2)):
        for body, share in _VENTILATORS[name]:
            out[BODIES.index(body)] += _VENTILATOR_W * share * on
    out[BODIES.index("coolant_tank")] += _PUMP_W * pump * float(pumping(np.array(hour)))
    return out
