"""The virtual ultra-precision mill: aerostatic slides, a slow error, and what its control logs.

Four linear and two rotary axes; programs move X and Y at an angle of C. Servo, structure and
guideways are those of the virtual mill; strokes, mode, room and correction input are its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from dtwin.errors import InputError
from dtwin.machines import mill_drive
from dtwin.machines.mill_drive import STEP_S, Command
from dtwin.machines.mill_parameters import HeatParameters, MillParameters
from dtwin.schema import Floats
from dtwin.units import UM_PER_MM

_STROKE_MM = {"X": 400.0, "Y": 150.0, "Z": 150.0, "W": 150.0}
"""Published."""
_FASTEST_MM_MIN = 3000.0
_SPINDLE_V = 2.5
MODE_HZ = 194.0
ITEMS = (
    "ProgramPositionCommand",
    "ProgramPositionFeedback",
    "PositionError",
    "VelocityFeedbackAverage",
    "CurrentFeedbackAverage",
)
_SENSOR_CORNER_HZ, SENSOR_NOISE_G = 0.5, 50e-6
_G_MM_S2 = 9806.65
_ACCELERATION_MM_S2 = 200.0
_AMPERE_PER_MM_S2 = 0.004
_AXES = ("X", "Y")


@dataclass(frozen=True)
class CorrectionInput:
    """Analogue input that shifts an axis's encoder.

    ``limit_um``: range on both sides of the neutral voltage.
    ``quantum_um``: smallest step of the converter; 8-bit pulse widths have 0.98.
    ``delay_s``: from a written value to the shift.
    ``update_hz``: how often a value is written; a microcontroller with three axes does 6.
    """

    limit_um: float = 125.0
    quantum_um: float = 0.98
    delay_s: float = 0.02
    update_hz: float = 6.0

    def applied_um(self, wanted_um: Floats) -> Floats:
        """Return what is really added, by steps of ``STEP_S``, shape as ``wanted_um`` (2, n)."""
        every = max(1, round(1.0 / self.update_hz / STEP_S))
        n = wanted_um.shape[1]
        written = wanted_um[:, np.arange(n) // every * every]
        written = self.quantum_um * np.round(written / self.quantum_um)
        late = min(round(self.delay_s / STEP_S), n)
        out = np.zeros_like(wanted_um)
        out[:, late:] = np.clip(written, -self.limit_um, self.limit_um)[:, : n - late]
        return out


def hybrid_parameters() -> MillParameters:
    """Return the mill: an error of some micrometres that moves slowly, and nearly no servo error.

    The scale of X, the bent guideways and the angle between the axes are assumed; together they
    give the published mean error of 6 to 8 um on circles of 50 mm. The room goes from 16 to 21 C.
    """
    heat = HeatParameters(
        rise_c=3.0,
        feed_mm_min=500.0,
        feed_share=0.4,
        time_constant_min=40.0,
        room_c=18.5,
        room_swing_c=2.5,
        room_period_h=12.0,
    )
    made = MillParameters(squareness_um_m={"XY": 100.0}, heat=heat)
    slide = {"mode_hz": MODE_HZ, "mode_damping": 0.03, "mode_share": 0.05, "feed_forward": 0.999, "growth_um_m_k": 11.5}
    made = made.with_axis("X", scale_ppm=-270.0, bow_um=2.0, **slide)
    return made.with_axis("Y", scale_ppm=120.0, bow_um=-1.5, **slide)


@dataclass(frozen=True)
class _HybridRun:
    """One program.

    ``t_s``, (n,): time since the start of the program.
    ``items``, (2, n): what the control logs, for X and Y, under the names of its data items.
    ``scalars``, (n,): data items of the whole machine: path speed in mm/s, feed override in percent, and the voltage
    from which the spindle's speed follows (3000 rpm/V).
    ``analogue_v``, (2, n): correction inputs as voltages around 5 V, 25 um/V.
    ``table_g``, ``frame_g``, (2, n): accelerometers.
    ``error_um``, (2, n): truth: tool against workpiece, minus the command.
    """

    t_s: Floats
    items: dict[str, Floats]
    scalars: dict[str, Floats]
    analogue_v: Floats
    table_g: Floats
    frame_g: Floats
    error_um: Floats
    temperature_c: float


@dataclass
class HybridMill:
    """The mill, with its clock.

    ``correction_input``: how corrections reach its axes.
    ``time_s``: session time; the room follows it.
    """

    seed: int = 0
    parameters: MillParameters = field(default_factory=hybrid_parameters)
    correction_input: CorrectionInput = field(default_factory=CorrectionInput)
    time_s: float = 0.0
    _runs: int = 0

    @property
    def temperature_c(self) -> float:
        """Temperature of the body, which follows the room."""
        return self.parameters.heat.room_at_c(self.time_s / 3600.0)

    def mounting_um(self) -> Floats:
        """Return how far the workpiece sits from the table's centre, shape (2,)."""
        return 8.0 * np.random.default_rng([self.seed, 91]).standard_normal(2)

    def run(
        self, corners_mm: Floats, feed_mm_min: float, *, c_deg: float = 0.0, wanted_um: Floats | None = None
    ) -> _HybridRun:
        """Drive straight moves that stop at every corner.

        ``corners_mm``, shape (k, 2): X and Y of the program.
        ``c_deg``: angle of the C table, with which the workpiece's offset turns.
        ``wanted_um``, shape (2, n): correction of X and Y at every step of ``command``; it passes the correction input.
        Raises ``InputError`` when the program leaves the strokes, or is faster than the axes.
        """
        command = self.command(corners_mm, feed_mm_min)
        n = len(command.phase_rad)
        wanted = np.zeros((2, n)) if wanted_um is None else np.asarray(wanted_um, dtype=float)
        if wanted.shape != (2, n):
            raise InputError(
                "the correction does not fit the program",
                code="hybrid.correction",
                got=str(wanted.shape),
                allowed=f"(2, {n})",
            )
        added = self.correction_input.applied_um(wanted)
        driven = [
            mill_drive.drive(command, i, self.parameters.axis(a), 0.0, added[i] / UM_PER_MM)
            for i, a in enumerate(_AXES)
        ]
        error_um = self._error_um(command, driven, np.radians(c_deg))
        rng = np.random.default_rng([self.seed, 92, self._runs])
        table_g, frame_g = _sensors(command, error_um, rng)
        temperature = self.temperature_c
        self._runs += 1
        self.time_s += n * STEP_S
        return _HybridRun(
            t_s=np.asarray(np.arange(n) * STEP_S, dtype=np.float64),
            items=_items(command, driven, added, rng),
            scalars=_scalars(command, rng),
            analogue_v=5.0 + added / 25.0,
            table_g=table_g,
            frame_g=frame_g,
            error_um=error_um,
            temperature_c=temperature,
        )

    def wait(self, seconds: float) -> None:
        """Let time pass at standstill."""
        self.time_s += seconds

    def command(self, corners_mm: Floats, feed_mm_min: float) -> Command:
        """Return the timed program; parameters and errors as in ``run``."""
        corners = np.asarray(corners_mm, dtype=float)
        reach = np.array([_STROKE_MM[a] / 2.0 for a in _AXES])
        if corners.ndim != 2 or corners.shape[1] != 2 or not np.all(np.abs(corners) <= reach):
            raise InputError(
                "the program leaves the strokes of the mill",
                code="hybrid.stroke",
                got=str(np.abs(corners).max(axis=0).tolist()) if corners.ndim == 2 else "no corners",
                allowed="X within ±200 mm, Y within ±75 mm",
            )
        if not 1.0 <= feed_mm_min <= _FASTEST_MM_MIN:
            raise InputError(
                "the mill cannot drive this feed",
                code="hybrid.feed",
                got=f"{feed_mm_min:g} mm/min",
                allowed=f"1 to {_FASTEST_MM_MIN:g} mm/min",
            )
        parts = [_move(here, there, feed_mm_min / 60.0) for here, there in pairwise(corners)]
        place, speed, gain = (np.concatenate([p[k] for p in parts], axis=1) for k in range(3))
        return Command(0.0, np.zeros(place.shape[1]), place, speed, gain)

    def _error_um(self, command: Command, driven: list[mill_drive.Driven], c_rad: float) -> Floats:
        reading = command.position_mm + np.stack([d.along_mm for d in driven])
        rise_c = self.temperature_c - 20.0
        ideal = command.position_mm
        out = reading.copy()
        for i, letter in enumerate(_AXES):
            a = self.parameters.axis(letter)
            out[i] += 1e-6 * (a.scale_ppm + a.growth_um_m_k * rise_c) * reading[i]
            out[i] += driven[1 - i].sideways_mm
        lean = 1e-6 * self.parameters.squareness_um_m.get("XY", 0.0)
        out[0] -= np.sin(lean) * reading[1]
        offset = self.mounting_um()
        turned = np.array(
            [
                np.cos(c_rad) * offset[0] - np.sin(c_rad) * offset[1],
                np.sin(c_rad) * offset[0] + np.cos(c_rad) * offset[1],
            ]
        )
        return np.asarray(UM_PER_MM * (out - ideal) - turned[:, None])


def _move(start: Floats, end: Floats, speed_mm_s: float) -> tuple[Floats, Floats, Floats]:
    """Return position, velocity and acceleration of a straight move, each (2, n)."""
    way = end - start
    length = float(np.linalg.norm(way))
    if length < 1e-9:
        return start[:, None].copy(), np.zeros((2, 1)), np.zeros((2, 1))
    peak = min(speed_mm_s, np.sqrt(length * _ACCELERATION_MM_S2))
    # Speed rises as a raised cosine, twice as long as at constant acceleration.
    ramp_s = 2.0 * peak / _ACCELERATION_MM_S2
    total_s = length / peak + ramp_s
    t = np.arange(int(np.ceil(total_s / STEP_S)) + 1) * STEP_S
    rise = np.clip(t / ramp_s, 0.0, 1.0)
    fall = np.clip((t - (total_s - ramp_s)) / ramp_s, 0.0, 1.0)

    def ramped(x: Floats) -> Floats:
        return ramp_s * (0.5 * x - np.sin(np.pi * x) / (2.0 * np.pi))

    gone = ramped(rise) + np.clip(t - ramp_s, 0.0, None)
    gone -= ramped(fall) + np.clip(t - total_s, 0.0, None)
    travelled = np.minimum(peak * gone, length)
    speed = peak * 0.5 * (np.cos(np.pi * fall) - np.cos(np.pi * rise))
    gain = peak * 0.5 * np.pi / ramp_s * (np.sin(np.pi * rise) - np.sin(np.pi * fall))
    unit = (way / length)[:, None]
    return start[:, None] + unit * travelled, unit * speed, unit * gain


def _items(
    command: Command, driven: list[mill_drive.Driven], added_um: Floats, rng: np.random.Generator
) -> dict[str, Floats]:
    followed = np.stack([d.encoder_mm for d in driven])
    # The loop follows command and offset; its own error is what is left of both.
    lag = followed - added_um / UM_PER_MM
    current = _AMPERE_PER_MM_S2 * command.acceleration_mm_s2
    return {
        ITEMS[0]: command.position_mm,
        ITEMS[1]: command.position_mm + followed,
        ITEMS[2]: -lag,
        ITEMS[3]: command.velocity_mm_s,
        ITEMS[4]: current + 0.002 * rng.standard_normal(current.shape),
    }


def _scalars(command: Command, rng: np.random.Generator) -> dict[str, Floats]:
    speed = np.hypot(command.velocity_mm_s[0], command.velocity_mm_s[1])
    return {
        "CoordinatedSpeedTargetActual": speed,
        "MFO": np.full(len(speed), 100.0),
        "AnalogInput0": _SPINDLE_V + 0.001 * rng.standard_normal(len(speed)),
    }


def _sensors(command: Command, error_um: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return table and frame in g: what moves, above the corner of the sensors, and their noise."""
    shaken = np.gradient(np.gradient(error_um / UM_PER_MM, STEP_S, axis=1), STEP_S, axis=1)
    keep = np.exp(-2.0 * np.pi * _SENSOR_CORNER_HZ * STEP_S)
    moved = _high_passed((command.acceleration_mm_s2 + shaken) / _G_MM_S2, keep)
    noise = SENSOR_NOISE_G * rng.standard_normal((2, *moved.shape))
    return moved + noise[0], 0.03 * moved + noise[1]


def _high_passed(signal: Floats, keep: float) -> Floats:
    from scipy.signal import lfilter

    return np.asarray(lfilter([keep, -keep], [1.0, -keep], signal, axis=1))
