"""A three-axis mill that heat deforms, with thermocouples on it and a ball array on its table.

The error of the tool point comes from rigid bodies that are chained X, Z, Y and each displaced and
turned by its guideway; what displaces and turns them are the temperatures of the bodies. Guideways
bend to parabolas with a cubic part, so that no low-order polynomial describes them exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from dtwin.machines.thermal_network import BODIES, CASTINGS, Schedule, pumping, temperatures_c
from dtwin.schema import Floats

STROKES_MM = {"x": (30.0, 1460.0), "y": (50.0, 1200.0), "z": (460.0, 1490.0)}
READING_S = 30.0
BALL_S = 27.0
CYCLE_S = 3600.0
_FIXED_POSE = 0
FIXED_BALLS_MM = ((120.0, 130.0, 470.0), (1370.0, 150.0, 475.0), (700.0, 1090.0, 480.0))
AZIMUTHS_DEG = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
HELD_OUT_POSES = (3, 6)
_ELEVATION_DEG = 45.0
_BASE_MM = (745.0, 625.0, 480.0)
_ALONG_MM = (180.0, 380.0, 580.0, 780.0, 980.0)
# Rows of balls beside the arm: across, and at right angles to arm and across.
_ROWS_MM = ((-210.0, 0.0), (210.0, 0.0), (0.0, 240.0))
_CUBIC = 0.12
_REFERENCE_C = 22.0
_TOWARDS = 0.35
# What the control logs: sensors of the plant, slow and coarse.
_LOGGED_LAG_S, _LOGGED_NOISE_C, _LOGGED_STEP_C = 600.0, 0.2, 0.1
_SENSORS = {
    "table": 10,
    "bed": 10,
    "column_side": 6,
    "column_back": 5,
    "column_top": 5,
    "ram": 12,
    "front_air": 2,
    "back_air": 2,
}

# What moves with which body: its motion in um (um/m for turns) per kelvin. The letters are those of
# ISO 230-1: what moves (E, direction), of which axis, and the power of the travel.
_SENSITIVITY: Mapping[str, Mapping[str, float]] = {
    "EX0": {"column_side": 3.6, "column_back": -1.1, "bed": 1.6, "foundation": -6.0},
    "EZ0": {"column_side": 1.8, "column_back": 1.8, "column_top": 2.4, "table": -3.0},
    "EY0": {"column_back": -2.6, "column_top": -1.2, "ram": 2.2, "back_air": -0.7, "foundation": 3.0},
    "EA0": {"column_back": 2.1, "column_side": -0.5, "column_top": -0.8},
    "EB0": {"column_side": 0.7, "column_back": -0.3},
    "EC0": {"bed": 0.7, "foundation": -1.4},
    "EXX1": {"bed": 3.28, "back_air": -0.4},
    "EXX2": {"bed": 0.9, "foundation": -1.6},
    "EZX2": {"bed": 3.31, "table": -1.53},
    "EAX2": {"bed": 2.24, "back_air": -0.42},
    "EBX1": {"bed": 1.82, "column_side": 0.63, "table": -1.19},
    "EZZ1": {"column_side": 0.74, "column_back": 0.74, "column_top": 0.87},
    "EZZ2": {"column_side": 0.5, "column_top": -0.8},
    "EXZ1": {"coolant_tank": 3.0, "column_side": 0.05},
    "EXZ2": {"column_side": 0.95, "column_top": -0.8},
    "EYZ2": {"column_back": 0.4, "column_top": -0.3},
    "ECZ1": {"column_side": 0.5, "column_back": -0.3, "foundation": -1.5},
    "EAZ1": {"column_back": 1.05, "column_top": -0.63},
    "EYY1": {"ram": 3.4, "front_air": -0.3},
    "EYY2": {"ram": 1.2, "column_top": -0.3},
    "EZY1": {"ram": 2.6, "column_top": -1.2},
    "EZY2": {"ram": 1.3, "front_air": -0.5},
    "EXY1": {"column_side": 1.62, "ram": -0.99},
    "EXY2": {"ram": 0.8, "foundation": -1.0},
}


@dataclass(frozen=True)
class VolumetricParameters:
    """What a virtual mill is like.

    ``probe_um``: standard deviation of a measured coordinate.
    ``seating_um``, ``repeat_um``: how far the array stands from its nominal place in a pose, and how well the motor
    finds the pose again.
    ``pocket_1``: of every second thermocouple: the most that it feels of the casting's core, which is what deforms. 0
    for sensors stuck on the surface; 0.85 for sensors sunk into pockets.
    ``hidden``: more coefficients: name to um (um/m) per kelvin of each body, for example ``{"ECX1": {"bed": 2.0}}``.
    ``pump``: whether the coolant pump warms its tank.
    """

    probe_um: float = 0.7
    seating_um: float = 60.0
    repeat_um: float = 1.0
    sensor_bias_c: float = 0.25
    sensor_noise_c: float = 0.05
    sensor_lag_s: float = 120.0
    pocket_1: float = 0.0
    hidden: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    pump: bool = True


@dataclass(frozen=True)
class BallReadings:
    """What the probe found in one cycle.

    ``t_s``, shape (n,): time since the campaign began.
    ``nominal_mm``, shape (n, 3): where the balls should be.
    ``error_um``, shape (n, 3): measured minus nominal.
    ``pose``, ``ball``, shape (n,): pose 0 are the balls on the table.
    """

    t_s: Floats
    nominal_mm: Floats
    error_um: Floats
    pose: np.ndarray[tuple[int], np.dtype[np.int64]]
    ball: np.ndarray[tuple[int], np.dtype[np.int64]]


class VolumetricMill:
    """A mill during one campaign.

    ``seed``: of the machine, and with ``test``, the name of one, of what scatters during it.
    """

    def __init__(self, schedule: Schedule, parameters: VolumetricParameters, seed: int, test: str = "") -> None:
        self.schedule, self.parameters, self.seed = schedule, parameters, seed
        self.hour, self.bodies_c = temperatures_c(schedule, READING_S, pump=parameters.pump)
        self._rng = np.random.default_rng([seed, len(schedule.name), *test.encode()])
        machine = np.random.default_rng(seed)
        self._seating = {
            pose: (machine.normal(0, parameters.seating_um, 3), machine.normal(0, 60.0, 3))
            for pose in range(1, len(AZIMUTHS_DEG) + 1)
        }
        self._bias_c = machine.normal(0, parameters.sensor_bias_c, sum(_SENSORS.values()))

    @property
    def cycles(self) -> int:
        """Cycles that fit into the campaign."""
        return int(self.schedule.length_h * 3600.0 / CYCLE_S)

    def coefficients(self, hour: Floats) -> dict[str, Floats]:
        """Return what moves at some times, in um or um/m, each of shape (n,).

        ``hour`` (n,): time since the campaign began.
        """
        named = {body: np.interp(hour, self.hour, self.bodies_c[:, _deforming(body)]) - _REFERENCE_C for body in BODIES}
        every = {**_SENSITIVITY, **self.parameters.hidden}
        return {
            name: sum((k * named[body] for body, k in of.items()), start=np.zeros(len(hour)))
            for name, of in every.items()
        }

    def error_um(self, position_mm: Floats, hour: Floats) -> Floats:
        """Return actual minus commanded position of the tool point.

        ``position_mm``, shape (n, 3): commanded.
        ``hour``, shape (n,): time at each of them.
        Returns, shape (n, 3).
        """
        value = self.coefficients(hour)
        position = np.asarray(position_mm, float)
        still = np.zeros(len(position))
        travel = {
            axis: (position[:, i] - np.mean(STROKES_MM[axis])) / (0.5 * np.ptp(STROKES_MM[axis]))
            for i, axis in enumerate("xyz")
        }
        point = np.zeros_like(position)
        for axis in "yzx":
            moved, turned = _guideway(value, axis.upper(), travel[axis])
            point = Rotation.from_rotvec(1e-6 * turned).apply(point) + 1e-3 * moved
            point[:, "xyz".index(axis)] += position[:, "xyz".index(axis)]
        moved, turned = (
            np.column_stack([value.get(f"E{letter}0", still) for letter in letters]) for letters in ("XYZ", "ABC")
        )
        point = Rotation.from_rotvec(1e-6 * turned).apply(point) + 1e-3 * moved
        return np.asarray(1e3 * (point - position))

    def measure(self, cycle: int) -> BallReadings:
        """Return what the probe finds in a cycle, counted from 0, ball after ball while the mill drifts."""
        places = [(_FIXED_POSE, ball, np.array(at)) for ball, at in enumerate(FIXED_BALLS_MM)]
        places += [place for pose in range(1, len(AZIMUTHS_DEG) + 1) for place in array_balls(pose)]
        places += [(_FIXED_POSE, ball, np.array(at)) for ball, at in enumerate(FIXED_BALLS_MM)]
        t_s = np.float64(cycle * CYCLE_S) + BALL_S * np.arange(len(places), dtype=np.float64)
        again = {pose: self._rng.normal(0, self.parameters.repeat_um, 3) for pose in self._seating}
        nominal = np.array([at for _, _, at in places])
        true = nominal.copy()
        for i, (pose, _, at) in enumerate(places):
            if pose != _FIXED_POSE:
                moved, turned = self._seating[pose]
                arm_m = 1e-3 * (at - np.array(_BASE_MM))
                true[i] += 1e-3 * (moved + again[pose] + np.cross(turned, arm_m))
        # The scales read less where the machine goes too far.
        error = 1e3 * (true - nominal) - self.error_um(true, t_s / 3600.0)
        error += self._rng.normal(0, self.parameters.probe_um, error.shape)
        pose_of, ball = (np.array([place[k] for place in places]) for k in (0, 1))
        return BallReadings(t_s, nominal, error, pose_of, ball)

    def thermocouples_c(self, cycle: int) -> dict[str, Floats]:
        """Return the readings of a cycle by name of the sensor, every 30 s."""
        n = round(CYCLE_S / READING_S)
        return {name: v[cycle * n : (cycle + 1) * n] for name, v in self._sensed.items()}

    def control_c(self, cycle: int) -> dict[str, Floats]:
        """Return what the control logs by channel, every 30 s; only the tank's moves the machine."""
        n = round(CYCLE_S / READING_S)
        return {name: v[cycle * n : (cycle + 1) * n] for name, v in self._logged.items()}

    @cached_property
    def _logged(self) -> dict[str, Floats]:
        """Return the control's channels: a slow, coarse sensor each, of the tank and of what is beside it.

        The pump's motor warms in step with its tank, the oil by a duty of its own, cabinet and hall
        with the season.
        """
        rng = np.random.default_rng([len(self.hour), 11])
        tank, air = (self.bodies_c[:, BODIES.index(b)] for b in ("coolant_tank", "back_air"))
        hall = np.array([self.schedule.hall_c(float(h)) for h in self.hour])
        pump = _lagged(pumping(self.hour) * float(self.parameters.pump), _share(1500.0))
        oil = _lagged(((self.hour + 5.0) % 17.0 < 9.0).astype(float), _share(5400.0))
        true = {
            "coolant_tank_c": tank,
            "coolant_pump_c": hall + 14.0 * pump,
            "hydraulic_oil_c": hall + 9.0 * oil,
            "cabinet_c": air + 6.0,
            "hall_c": hall,
        }
        felt = {name: _lagged(values, _share(_LOGGED_LAG_S)) for name, values in true.items()}
        return {
            name: _LOGGED_STEP_C * np.round((values + rng.normal(0, _LOGGED_NOISE_C, len(values))) / _LOGGED_STEP_C)
            for name, values in felt.items()
        }

    @cached_property
    def _sensed(self) -> dict[str, Floats]:
        rng = np.random.default_rng([len(self.hour), 7])
        share = _share(self.parameters.sensor_lag_s)
        readings: dict[str, Floats] = {}
        for body, count in _SENSORS.items():
            source = self.bodies_c[:, BODIES.index(body)]
            neighbour = self.bodies_c[:, BODIES.index(_NEIGHBOUR[body])]
            core = self.bodies_c[:, _deforming(body)]
            for number in range(count):
                # Some sit on the skin towards a neighbour, some may sit in pockets of the casting.
                other, most = (core, self.parameters.pocket_1) if number % 2 else (neighbour, _TOWARDS)
                part = most * (number + 1) / count
                felt = _lagged((1 - part) * source + part * other, share)
                felt = felt + rng.normal(0, self.parameters.sensor_noise_c, len(felt))
                felt = felt + self._bias_c[len(readings)]
                readings[f"{body}_{number + 1:02d}_c"] = felt
        return readings


_NEIGHBOUR = {
    "table": "bed",
    "bed": "table",
    "column_side": "column_top",
    "column_back": "column_top",
    "column_top": "ram",
    "ram": "front_air",
    "front_air": "back_air",
    "back_air": "front_air",
}


def _deforming(body: str) -> int:
    return BODIES.index(f"{body}_core" if body in CASTINGS else body)


def array_balls(pose: int) -> list[tuple[int, int, Floats]]:
    """Return pose, number and nominal place in mm of the balls that the probe reaches."""
    azimuth, elevation = np.radians(AZIMUTHS_DEG[pose - 1]), np.radians(_ELEVATION_DEG)
    along = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    out = []
    upright = np.cross(along, across)
    for row, (beside, above) in enumerate(_ROWS_MM):
        for place, length in enumerate(_ALONG_MM):
            at = np.array(_BASE_MM) + length * along + beside * across + above * upright
            low, high = np.array([STROKES_MM[axis] for axis in "xyz"]).T
            if np.all((at >= low) & (at <= high)):
                out.append((pose, row * len(_ALONG_MM) + place, at))
    return out


def _guideway(value: Mapping[str, Floats], axis: str, travel: Floats) -> tuple[Floats, Floats]:
    """Return how an axis displaces (um) and turns (um/m) what it carries, shapes (n, 3)."""
    bent = travel**2 + _CUBIC * travel**3
    still = np.zeros(len(travel))
    moved, turned = np.zeros((len(travel), 3)), np.zeros((len(travel), 3))
    for into, letters in ((moved, "XYZ"), (turned, "ABC")):
        for column, letter in enumerate(letters):
            into[:, column] += value.get(f"E{letter}{axis}1", still) * travel
            into[:, column] += value.get(f"E{letter}{axis}2", still) * bent
    return moved, turned


def _share(lag_s: float) -> float:
    return float(1.0 - np.exp(-READING_S / lag_s))


def _lagged(values: Floats, share: float) -> Floats:
    from scipy.signal import lfilter

    begun = [(1.0 - share) * values[0]]
    return np.asarray(lfilter([share], [1.0, share - 1.0], values, zi=begun)[0])
