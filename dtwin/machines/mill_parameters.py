"""What can be wrong with the virtual mill, and what does not repeat; every default is a machine without that fault."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from dtwin.errors import InputError
from dtwin.schema import Direction, Floats, Plane

AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class AxisParameters:
    """Drive, guideway, screw and structure of one axis.

    ``position_gain_1_s``, ``velocity_gain_1_s``: gains of the position loop and of the velocity loop inside it.
    ``integral_time_ms``: of the velocity loop; 0 switches the integral off.
    ``feed_forward``: share of the commanded speed that is fed forward; 1 follows without lag.
    ``play_um``, ``play_taper_um``: lost motion between screw and table at the middle, and its change over 100 mm.
    ``play_curve_um``: further change of the lost motion, quadratic in position, at 100 mm.
    ``lateral_um``, ``lateral_taper_um``: sideways step of the carriage on reversal at the middle, and its change over
    100 mm.
    ``lateral_travel_mm``: travel over which the carriage moves over.
    ``friction_mm_s2``: friction as the acceleration that it costs the drive.
    ``presliding_mm``: travel over which friction reverses.
    ``stribeck_mm_s2``, ``stribeck_mm_s``: extra friction near standstill, and the speed by which it has faded.
    ``pitch_error_um``, ``pitch_mm``, ``pitch_phase_rad``: once-per-turn error of the screw.
    ``pitch_flank_um``: part of it that changes sign with the flank that is in contact.
    ``mode_hz``, ``mode_damping``: first mode of the axis.
    ``mode_share``: share of the axis's acceleration that bends the mode.
    ``breakaway_mm``: error that builds up before a stuck axis breaks away; the jolt rings the mode.
    ``scale_ppm``, ``scale_cubic_um``: error of the scale: in proportion to position, and with its cube (at 100 mm).
    ``bow_um``: rise of the bent guideway 100 mm from the middle of the circle.
    ``tilt_urad``: rotation of the carriage per 100 mm of travel, at the height of the tool.
    ``slip_um``, ``slip_mm_s``: size of random stick-slip steps and the speed below which they occur.
    """

    position_gain_1_s: float = 40.0
    velocity_gain_1_s: float = 300.0
    integral_time_ms: float = 0.0
    feed_forward: float = 1.0
    play_um: float = 0.0
    play_taper_um: float = 0.0
    play_curve_um: float = 0.0
    lateral_um: float = 0.0
    lateral_taper_um: float = 0.0
    lateral_travel_mm: float = 0.05
    friction_mm_s2: float = 0.0
    presliding_mm: float = 0.01
    stribeck_mm_s2: float = 0.0
    stribeck_mm_s: float = 2.0
    pitch_error_um: float = 0.0
    pitch_mm: float = 10.0
    pitch_phase_rad: float = 0.0
    pitch_flank_um: float = 0.0
    mode_hz: float = 25.0
    mode_damping: float = 0.05
    mode_share: float = 0.0
    breakaway_mm: float = 0.0
    scale_ppm: float = 0.0
    scale_cubic_um: float = 0.0
    bow_um: float = 0.0
    tilt_urad: float = 0.0
    growth_um_m_k: float = 0.0
    slip_um: float = 0.0
    slip_mm_s: float = 1.0


@dataclass(frozen=True)
class HeatParameters:
    """One body that the running machine warms.

    ``rise_c``: temperature above the room that lasting work at ``feed_mm_min`` leads to.
    ``feed_share``: share of the heat that is in proportion to the feed; the spindle gives the rest.
    ``lag_share``: share of the growth that follows a second body of three times the time constant; the growth then
    forms a loop over temperature.
    ``room_c``, ``room_swing_c``, ``room_period_h``: mean temperature of the room, and a swing around it that the
    machine follows.
    """

    rise_c: float = 4.0
    feed_mm_min: float = 2000.0
    feed_share: float = 0.5
    time_constant_min: float = 25.0
    lag_share: float = 0.0
    sensor_noise_c: float = 0.02
    room_c: float = 20.0
    room_swing_c: float = 0.0
    room_period_h: float = 24.0

    def room_at_c(self, time_h: float) -> float:
        """Return the room's temperature at a time."""
        return self.room_c + self.room_swing_c * math.sin(2.0 * math.pi * time_h / self.room_period_h)


@dataclass(frozen=True)
class MillParameters:
    """The whole machine.

    ``squareness_um_m``: by how much the angle of two axes is more than 90 degrees, by plane.
    ``changeover_um``: step of the commanded radius where the leading axis changes.
    ``shift_um_h``: drift of the table along X, Y, Z.
    ``bar_growth_um_h``: drift of the measured length.
    ``delay_ms``: by which the bar's reading is older than the angle written beside it.
    ``cup_lobe_um``, ``cup_phase_rad``: three-lobed error of ball and cup.
    """

    x: AxisParameters = field(default_factory=AxisParameters)
    y: AxisParameters = field(default_factory=AxisParameters)
    z: AxisParameters = field(default_factory=AxisParameters)
    squareness_um_m: dict[str, float] = field(default_factory=dict)
    changeover_um: float = 0.0
    shift_um_h: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bar_growth_um_h: float = 0.0
    delay_ms: float = 0.0
    cup_lobe_um: float = 0.0
    cup_phase_rad: float = 0.0
    heat: HeatParameters = field(default_factory=HeatParameters)

    def axis(self, letter: str) -> AxisParameters:
        """Return the parameters of axis X, Y or Z."""
        return {"X": self.x, "Y": self.y, "Z": self.z}[letter]

    def with_axis(self, letter: str, **changes: float) -> MillParameters:
        """Return the machine with some parameters of one axis changed."""
        changed = replace(self.axis(letter), **changes)
        return replace(
            self,
            x=changed if letter == "X" else self.x,
            y=changed if letter == "Y" else self.y,
            z=changed if letter == "Z" else self.z,
        )


@dataclass(frozen=True)
class CircularTest:
    """One circle to be measured.

    ``repeat``: counts from 1.
    ``pause_s``: standstill before this test, in which the machine cools.
    ``abbe_offset_mm``: height of the bar above the scales; logged when given.
    ``correction``: which of the mill's corrections acts; empty for none.
    """

    plane: Plane = "XY"
    direction: Direction = "CCW"
    radius_mm: float = 100.0
    feed_mm_min: float = 2000.0
    repeat: int = 1
    setup: str = "s1"
    pause_s: float = 0.0
    abbe_offset_mm: float | None = None
    correction: str = ""

    def __post_init__(self) -> None:
        """Refuse what the machine cannot drive."""
        if not (1.0 <= self.radius_mm <= 1000.0 and 10.0 <= self.feed_mm_min <= 30000.0):
            raise InputError(
                "the virtual mill cannot drive this circle",
                code="mill.circle",
                got=f"radius {self.radius_mm:g} mm, feed {self.feed_mm_min:g} mm/min",
                allowed="radius 1 to 1000 mm, feed 10 to 30000 mm/min",
            )


_GRID = 360
_KINDS = ("plain", "feed", "reversal", "tails", "bad_run", "lobes")


@dataclass(frozen=True)
class NoiseParameters:
    """Random part of a measurement, by run.

    ``rms_um``: size over one run, averaged over runs; 0 measures without noise.
    ``kind``: ``plain``; ``feed``: in proportion to feed; ``reversal``: four times at reversals; ``tails``: Student's t
    with three degrees of freedom; ``bad_run``: one run eight times; ``lobes``: three lobes of random height in every
    run.
    ``keep``: correlation of the slow part from degree to degree.
    ``reference_feed_mm_min``: feed at which the kind ``feed`` has its nominal size.
    """

    rms_um: float = 0.5
    kind: str = "plain"
    keep: float = 0.95
    reference_feed_mm_min: float = 2300.0

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise InputError("unknown kind of noise", code="mill.noise", got=self.kind[:40], allowed=", ".join(_KINDS))


def noise_um(
    parameters: NoiseParameters, angle_rad: Floats, feed_mm_min: float, rng: np.random.Generator, *, bad: bool
) -> Floats:
    """Return the noise of one run, shape (n,). ``angle_rad``, (n,): path angle of the samples."""
    per_degree = len(angle_rad) / _GRID
    fast = 0.3 * np.sqrt(max(per_degree, 1.0)) * _draw(parameters, len(angle_rad), rng)
    slow = 0.3 * _slow(parameters, rng)
    degree = np.degrees(angle_rad) % 360.0
    out = fast + np.interp(degree, np.arange(_GRID) + 0.5, slow, period=360.0)
    out += 0.15 * rng.standard_normal()
    for order in range(1, 5):
        a, b = 0.15 * _draw(parameters, 2, rng)
        out += a * np.cos(order * angle_rad) + b * np.sin(order * angle_rad)
    scale = parameters.rms_um / np.sqrt(2 * 0.3**2 + 0.15**2 + 4 * 0.15**2)
    if parameters.kind == "lobes":
        a, b = rng.standard_normal(2)
        out += a * np.cos(3.0 * angle_rad) + b * np.sin(3.0 * angle_rad)
    if parameters.kind == "feed":
        scale *= feed_mm_min / parameters.reference_feed_mm_min
    if parameters.kind == "reversal":
        out *= np.where(np.abs((degree + 45.0) % 90.0 - 45.0) < 10.0, 4.0, 1.0)
    if bad and parameters.kind == "bad_run":
        scale *= 8.0
    return np.asarray(scale * out)


def _draw(parameters: NoiseParameters, n: int, rng: np.random.Generator) -> Floats:
    if parameters.kind == "tails":
        return np.asarray(rng.standard_t(3, n) / np.sqrt(3.0))
    return rng.standard_normal(n)


def _slow(parameters: NoiseParameters, rng: np.random.Generator) -> Floats:
    """Return a first-order autoregressive series of unit variance over one turn."""
    fresh = _draw(parameters, 2 * _GRID, rng)
    weights = parameters.keep ** np.arange(_GRID) * np.sqrt(1.0 - parameters.keep**2)
    return np.convolve(fresh, weights)[_GRID - 1 : 2 * _GRID - 1]
