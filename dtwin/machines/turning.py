"""The Z slide of a diamond turning machine: a servo loop, and a structure that the loop does not see.

The encoder sits on the slide; the tool stands on a structure that bends and rings. What the tool does
beyond the encoder is outside of the loop: no controller gain can take it away.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from dtwin.machines._wandering import wandering
from dtwin.schema import Floats

SERVO_HZ = 8000.0
_UM_S2_PER_G = 9.80665e6
MM_PER_UM = 1e-3
# Below this deflection a hardening joint is a spring: no joint is infinitely soft.
_SOFTEST_UM = 0.02


@dataclass(frozen=True)
class Slide:
    """Servo and structure. The defaults come closest to the printed figures of a real slide.

    ``servo_hz``, ``servo_damping``: natural frequency and damping ratio of the closed position loop.
    ``velocity_feedforward``: share of the commanded velocity that the loop is told beforehand; 1 is perfect.
    ``structure_hz``, ``structure_damping``: mode of the tool on its structure, damped against the frame; its frequency
    holds at the deflection ``hardening_um``.
    ``hardening``: exponent of force over deflection of the joint in the structure: 1 is a spring, more is a joint of
    rough faces, which grows stiffer under load.
    ``hardening_um``: deflection at which the joint is as stiff as the spring.
    ``friction_um``, ``friction_reach_um``: guideway friction as the deflection of the servo that it causes, and the
    travel over which it turns round; none by default.
    """

    servo_hz: float = 81.78
    servo_damping: float = 0.266
    velocity_feedforward: float = 1.056
    structure_hz: float = 70.73
    structure_damping: float = 0.0516
    hardening: float = 1.0
    hardening_um: float = 1.3
    friction_um: float = 0.0
    friction_reach_um: float = 0.4


@dataclass(frozen=True)
class _Accelerometer:
    """What stands near the tool.

    ``gain_1``: sensitivity over its nominal value, with what its place off the tool adds.
    ``drift_g``, ``drift_s``: slow wander of its zero: standard deviation and how long it remembers.
    ``bandwidth_hz``: low-pass before sampling.
    ``range_g``: beyond this it clips.
    """

    gain_1: float = 1.015
    noise_g_per_root_hz: float = 8e-6
    drift_g: float = 4e-5
    drift_s: float = 5.0
    bandwidth_hz: float = 200.0
    range_g: float = 5.0


@dataclass(frozen=True)
class AnaloguePath:
    """How a correction comes into the loop: volts out, volts in, pulses.

    ``um_per_v``, ``offset_v``: scale of the output, and the voltage that stands for no correction.
    ``pulses_per_v``, ``um_per_pulse``: what the controller makes of a volt.
    ``delay_ticks``: servo ticks from the output to the motion command.
    """

    um_per_v: float = 2.0
    offset_v: float = 0.5
    range_v: float = 10.0
    bits: int = 16
    pulses_per_v: float = 2000.0
    um_per_pulse: float = 0.001
    delay_ticks: int = 2

    @property
    def delay_s(self) -> float:
        """Seconds from the output to the motion command."""
        return self.delay_ticks / SERVO_HZ

    def arrived_um(self, wanted_um: Floats, held: Floats) -> tuple[Floats, Floats, int]:
        """Return what reaches the motion command.

        ``wanted_um``, shape (n,): correction at successive ticks.
        ``held``, shape (delay_ticks,): what was on its way before.
        Returns ``arrived``, ``held``, ``saturated``: correction in um, shape (n,); what is on its way afterwards; ticks
        that clipped.
        """
        step = 2.0 * self.range_v / 2.0**self.bits
        volts = wanted_um / self.um_per_v + self.offset_v
        limited = np.clip(np.round(volts / step) * step, -self.range_v, self.range_v - step)
        pulses = np.round((limited - self.offset_v) * self.pulses_per_v)
        line = np.concatenate([held, pulses * self.um_per_pulse])
        n = len(wanted_um)
        return line[:n], line[n:], int(np.count_nonzero(np.abs(volts) > self.range_v))


@dataclass(frozen=True)
class _Motion:
    """What the slide did, tick by tick at 8 kHz.

    ``encoder_um``, ``tool_um``, (n,): slide as its encoder sees it, and tool.
    ``acceleration_um_s2``, (n,): of the tool.
    """

    encoder_um: Floats
    tool_um: Floats
    acceleration_um_s2: Floats


class TurningSlide:
    """The slide in time; it goes on from where it is."""

    def __init__(self, slide: Slide | None = None) -> None:
        self.slide = slide or Slide()
        self._state = np.zeros(6)

    def run(self, command_um: Floats) -> _Motion:
        """Follow a command, shape (n,), with everything that was added to it; one value for each servo tick."""
        s = self.slide
        constants = np.array(
            [
                2 * np.pi * s.servo_hz,
                s.servo_damping,
                s.velocity_feedforward,
                2 * np.pi * s.structure_hz,
                s.structure_damping,
                s.hardening,
                s.hardening_um,
                s.friction_um,
                s.friction_reach_um,
                _SOFTEST_UM,
                1.0 / SERVO_HZ,
            ]
        )
        out = np.empty((3, len(command_um)))
        _follow(np.ascontiguousarray(command_um, dtype=np.float64), constants, self._state, out)
        return _Motion(out[0], out[1], out[2])


@dataclass(frozen=True)
class Instruments:
    """Capacitance probe at the tool, encoder, accelerometer.

    ``probe_um``, ``encoder_um``: noise of a reading of the probe; step of the encoder.
    """

    probe_um: float = 0.005
    encoder_um: float = 0.001
    accelerometer: _Accelerometer = field(default_factory=_Accelerometer)


class AccelerationChannel:
    """The accelerometer with its amplifier; filter and wander go on from call to call."""

    def __init__(self, sensor: _Accelerometer, rng: np.random.Generator) -> None:
        from scipy.signal import butter

        self.sensor, self._rng = sensor, rng
        self._b, self._a = butter(2, sensor.bandwidth_hz / (SERVO_HZ / 2.0))
        self._memory = np.zeros(2)
        self._keep = np.exp(-1.0 / (sensor.drift_s * SERVO_HZ))
        self._wander = np.array([self._keep * sensor.drift_g * rng.normal()])

    def sampled_g(self, motion: _Motion, every: int) -> Floats:
        """Return what is sampled at every ``every``-th servo tick in g, shape (n // every,)."""
        from scipy.signal import lfilter

        sensor, n = self.sensor, len(motion.tool_um)
        noise = sensor.noise_g_per_root_hz * np.sqrt(SERVO_HZ / 2.0) * self._rng.normal(size=n)
        felt = motion.acceleration_um_s2 / _UM_S2_PER_G * sensor.gain_1 + noise
        passed, self._memory = lfilter(self._b, self._a, felt, zi=self._memory)
        pushes = sensor.drift_g * np.sqrt(1.0 - self._keep**2) * self._rng.normal(size=n)
        wander, self._wander = lfilter([1.0], [1.0, -self._keep], pushes, zi=self._wander)
        return np.clip((passed + wander)[::every], -sensor.range_g, sensor.range_g)


@njit(cache=True, error_model="numpy")
def _follow(command: Floats, c: Floats, state: Floats, out: Floats) -> None:
    """Step servo and structure: classical Runge-Kutta between ticks, force held over a tick.

    ``state`` is slide, its velocity, tool, its velocity, presliding friction, last command.
    """
    servo, damping, forward, mode, loss, power, scale = c[0], c[1], c[2], c[3], c[4], c[5], c[6]
    friction, reach, softest, dt = servo * servo * c[7], c[8], c[9], c[10]
    e, v, x, w, z, last = state[0], state[1], state[2], state[3], state[4], state[5]
    for i in range(command.shape[0]):
        told = (command[i] - last) / dt
        last = command[i]
        pull = servo * servo * (last - e) + 2.0 * damping * servo * (forward * told - v)
        if friction > 0.0:
            way = 1.0 if v > 0.0 else -1.0
            z = way + (z - way) * np.exp(-abs(v) * dt / reach)
            pull -= friction * z
        # The slide under a held force moves along a parabola.
        half_e, next_e = (e + 0.5 * dt * v + 0.125 * dt * dt * pull, e + dt * v + 0.5 * dt * dt * pull)
        k1 = _tool(x, w, e, mode, loss, power, scale, softest)
        k2 = _tool(x + 0.5 * dt * w, w + 0.5 * dt * k1, half_e, mode, loss, power, scale, softest)
        k3 = _tool(x + 0.5 * dt * w + 0.25 * dt * dt * k1, w + 0.5 * dt * k2, half_e, mode, loss, power, scale, softest)
        k4 = _tool(x + dt * w + 0.5 * dt * dt * k2, w + dt * k3, next_e, mode, loss, power, scale, softest)
        out[0, i], out[1, i], out[2, i] = e, x, k1
        x += dt * w + dt * dt / 6.0 * (k1 + k2 + k3)
        w += dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        e, v = next_e, v + dt * pull
    state[0], state[1], state[2], state[3], state[4], state[5] = e, v, x, w, z, last


@njit(cache=True, error_model="numpy")
def _tool(x: float, w: float, e: float, mode: float, loss: float, power: float, scale: float, softest: float) -> float:
    """Return the tool's acceleration: a joint between slide and tool, damping against the frame."""
    bent = x - e
    force = mode * mode * bent
    if power != 1.0:
        force *= ((bent * bent + softest * softest) / (scale * scale)) ** (0.5 * (power - 1.0))
    return -force - 2.0 * loss * mode * w


@dataclass(frozen=True)
class RoomDrift:
    """A room whose temperature wanders, and a slide that follows it.

    ``room_c``: standard deviation of the room's temperature about its mean.
    ``oil_per_c``: share of the servo's damping that a warmer, thinner guideway oil takes away.
    ``softening_per_c``: share of its stiffness that the warmer structure loses.
    """

    room_c: float = 0.8
    time_constant_s: float = 1800.0
    oil_per_c: float = 0.03
    softening_per_c: float = 0.002

    def rises_c(self, t_s: Floats, seed: int) -> Floats:
        """Return the room's temperature over its mean at ascending times, shape (n,)."""
        rng = np.random.default_rng([seed, 31])
        return self.room_c * wandering(rng, t_s, self.time_constant_s)

    def slide_at(self, slide: Slide, rise_c: float) -> Slide:
        """Return the slide in a room that is warmer by ``rise_c``."""
        return replace(
            slide,
            servo_damping=slide.servo_damping * (1.0 - self.oil_per_c * rise_c),
            structure_hz=slide.structure_hz * (1.0 - self.softening_per_c * rise_c) ** 0.5,
        )
