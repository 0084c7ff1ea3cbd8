"""A virtual three-axis mill that is measured with a ball bar: mechanisms in time, exact lengths.

Nothing here is a formula for what an error looks like round a circle. Axes are driven, stick,
ring and warm up; the bar measures the distance between two balls.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np

from dtwin.machines import mill_drive
from dtwin.machines.mill_drive import Command, Driven
from dtwin.machines.mill_parameters import AXES, CircularTest, HeatParameters, MillParameters, NoiseParameters, noise_um
from dtwin.schema import Campaign, Floats, Run, RunMeta
from dtwin.units import UM_PER_MM

_ROOM_C = 20.0
_HANDLING_S = 60.0
_CENTRE_ON_SCREW_MM = (213.7, 187.3, 154.9)
_BEGIN = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)


@dataclass(frozen=True)
class Moment:
    """What else could act during a test.

    ``number``: position of the test in the session, from 0.
    ``angle_rad``, shape (n,): path angle of the samples.
    ``rise_c``: temperature of the machine above the room.
    """

    number: int
    test: CircularTest
    angle_rad: Floats
    time_h: float
    rise_c: float


Disturbance = Callable[[Moment], Floats]
Correction = Callable[[CircularTest, Command], Floats]


@dataclass(frozen=True)
class SetupErrors:
    """Mounting of the bar and its electronics.

    ``centre_mm``: largest offset of the centre along each axis.
    ``radius_um``: standard deviation of the zero of the bar.
    ``trigger_samples``: range of the random phase between trigger and first sample.
    """

    centre_mm: float = 0.1
    radius_um: float = 5.0
    jitter_us: float = 200.0
    trigger_samples: float = 1.0


@dataclass
class VirtualMill:
    """The mill.

    ``seed``: of set-up errors, sampling and noise. Two mills of one seed differ only in parameters.
    ``disturbance``: anything else that changes the measured length: ``disturbance(moment)`` returns um.
    ``samples_per_turn``: how often the bar is read in a turn, at any feed.
    ``corrections``: what is added to the position of tests that name it: ``correction(test, command)`` returns mm along
    the two axes of the plane, one column for each step.
    """

    parameters: MillParameters
    seed: int = 0
    noise: NoiseParameters = field(default_factory=NoiseParameters)
    setup_errors: SetupErrors = field(default_factory=SetupErrors)
    disturbance: Disturbance | None = None
    samples_per_turn: int = 1080
    corrections: Mapping[str, Correction] = field(default_factory=dict)

    def measure(self, tests: Sequence[CircularTest]) -> list[Run]:
        """Measure circles one after the other.

        Returns samples ``t_s``, ``angle_deg``, ``deviation_um`` over one turn, with the control's command and its motor
        encoders, ``cmd_x_mm`` ... ``act_z_mm``, of the axes that move; the body's temperature as covariate
        ``temperature_c``.
        """
        motions: dict[tuple[object, ...], tuple[Command, Driven, Driven]] = {}
        setups = self._setups(tests)
        clock = _Clock(self.parameters.heat)
        odd = int(np.random.default_rng([self.seed, 3]).integers(max(len(tests), 1)))
        out = []
        for number, test in enumerate(tests):
            where = (test.plane, test.direction, test.radius_mm, test.feed_mm_min)
            key = (*where, test.correction)
            if key not in motions:
                motions[key] = self._motion(test)
            clock.wait(test.pause_s)
            run = self._run(number, test, motions[key], setups[test.setup], clock, number == odd)
            out.append(run)
            clock.work(_duration_s(test) + _HANDLING_S, test.feed_mm_min)
        return out

    def campaign(self, name: str = "virtual-mill") -> Campaign:
        """Return the campaign that the runs belong to."""
        return Campaign(name=name, machine="virtual-mill", started=_BEGIN.isoformat())

    def _motion(self, test: CircularTest) -> tuple[Command, Driven, Driven]:
        command = mill_drive.circle(
            test.radius_mm, test.feed_mm_min / 60.0, _sense(test), self.parameters.changeover_um / UM_PER_MM
        )
        added = np.zeros_like(command.position_mm)
        if test.correction:
            added = self.corrections[test.correction](test, command)
        a, b = (
            mill_drive.drive(
                command, i, self.parameters.axis(letter), _CENTRE_ON_SCREW_MM[AXES.index(letter)], added[i]
            )
            for i, letter in enumerate(test.plane)
        )
        return command, a, b

    def _setups(self, tests: Sequence[CircularTest]) -> dict[str, Floats]:
        """Return centre offset (2 values, mm) and error of the bar's zero (um) by set-up."""
        rng = np.random.default_rng([self.seed, 1])
        limit = self.setup_errors.centre_mm
        out = {}
        for name in sorted({test.setup for test in tests}):
            centre = rng.uniform(-limit, limit, 2)
            out[name] = np.append(centre, self.setup_errors.radius_um * rng.standard_normal())
        return out

    def _run(
        self,
        number: int,
        test: CircularTest,
        motion: tuple[Command, Driven, Driven],
        setup: Floats,
        clock: _Clock,
        bad: bool,
    ) -> Run:
        rng = np.random.default_rng([self.seed, 2, number])
        command, first, second = motion
        n = self.samples_per_turn
        period_s = _duration_s(test) / n
        phase_s = self.setup_errors.trigger_samples * period_s * (rng.random() - 0.5)
        jitter_s = 1e-6 * self.setup_errors.jitter_us * rng.standard_normal(n)
        t_s = np.arange(n) * period_s
        # The first sample lies half a period behind the trigger.
        due_s: Floats = np.asarray(t_s + 0.5 * period_s, dtype=np.float64)
        written: Floats = _sense(test) * 2.0 * np.pi * (due_s / _duration_s(test))
        seen_s = due_s + phase_s + jitter_s - self.parameters.delay_ms / 1000.0
        angle = _sense(test) * 2.0 * np.pi * seen_s / _duration_s(test)
        at_s = command.start_s + seen_s
        table = self._table_mm(test, angle, at_s, (command, first, second), clock, rng)
        time_h = clock.time_s / 3600.0
        length_mm = np.hypot(*(table - self._ball_mm(test, setup[:2], time_h)[:, None]))
        rise_c = clock.rise_c
        deviation = UM_PER_MM * (length_mm - test.radius_mm) + setup[2]
        deviation += self.parameters.bar_growth_um_h * time_h
        deviation += self.parameters.cup_lobe_um * np.cos(3.0 * angle + self.parameters.cup_phase_rad)
        if self.disturbance is not None:
            deviation += self.disturbance(Moment(number, test, angle, time_h, rise_c))
        noise = noise_um(self.noise, angle, test.feed_mm_min, rng, bad=bad)
        if self.noise.rms_um > 0.0:
            deviation += noise
        shown_c = rise_c + self.parameters.heat.sensor_noise_c * rng.standard_normal()
        covariates = {"temperature_c": float(_ROOM_C + clock.room_rise_c + shown_c)}
        if test.abbe_offset_mm is not None:
            covariates["abbe_offset_mm"] = test.abbe_offset_mm
        meta = RunMeta(
            run_id=f"r{number + 1:03d}",
            plane=test.plane,
            direction=test.direction,
            radius_mm=test.radius_mm,
            feed_mm_min=test.feed_mm_min,
            repeat=test.repeat,
            setup=test.setup,
            started=(_BEGIN + timedelta(seconds=clock.time_s)).isoformat(),
            sample_rate_hz=1.0 / period_s,
            covariates=covariates,
        )
        samples = {"t_s": t_s, "angle_deg": np.degrees(written), "deviation_um": deviation}
        logged = _logged_mm(test, written, command, due_s, (first, second))
        return Run(meta=meta, samples=samples | logged)

    def _table_mm(
        self,
        test: CircularTest,
        angle: Floats,
        at_s: Floats,
        motion: tuple[Command, Driven, Driven],
        clock: _Clock,
        rng: np.random.Generator,
    ) -> Floats:
        """Return the tool's ball in the plane of the test, shape (2, n), by rigid motions."""
        command, first, second = motion
        grid_s = np.arange(len(command.phase_rad)) * mill_drive.STEP_S
        base = test.radius_mm * np.stack([np.cos(angle), np.sin(angle)])
        moved = np.stack(
            [
                np.interp(at_s, grid_s, d.along_mm + command.position_mm[i])
                - np.interp(at_s, grid_s, command.position_mm[i])
                for i, d in enumerate((first, second))
            ]
        )
        aside = np.stack([np.interp(at_s, grid_s, d.sideways_mm) for d in (second, first)])
        if self.parameters.changeover_um:
            step = 0.5e-3 * self.parameters.changeover_um
            leads = np.abs(base[0]) > np.abs(base[1])
            base = base * (1.0 + np.where(leads, -step, step) / test.radius_mm)
        reading = base + moved
        for i, letter in enumerate(test.plane):
            a = self.parameters.axis(letter)
            speed = test.feed_mm_min / 60.0 * base[1 - i] / test.radius_mm
            reading[i] += _slips_mm(a.slip_um, a.slip_mm_s, speed, reading[i], rng)
            reading[i] += _scale_error_mm(reading[i], a.scale_ppm, a.scale_cubic_um)
            reading[i] += reading[i] * 1e-6 * a.growth_um_m_k * clock.growth_rise_c
            height = test.abbe_offset_mm or 0.0
            reading[i] += height * np.sin(1e-6 * a.tilt_urad * base[i] / 100.0)
        reading += aside
        lean = 1e-6 * self.parameters.squareness_um_m.get(test.plane, 0.0)
        out = reading.copy()
        out[0] = reading[0] - np.sin(lean) * reading[1]
        out[1] = np.cos(lean) * reading[1]
        return out

    def _ball_mm(self, test: CircularTest, centre_mm: Floats, time_h: float) -> Floats:
        shift = [self.parameters.shift_um_h[AXES.index(letter)] for letter in test.plane]
        return np.asarray(centre_mm + np.array(shift) * time_h / UM_PER_MM)


class _Clock:
    """Session time and the temperature of the machine."""

    def __init__(self, heat: HeatParameters) -> None:
        self.heat = heat
        self.time_s = 0.0
        self.rise_c = 0.0
        self.deep_c = 0.0

    @property
    def growth_rise_c(self) -> float:
        """Rise that the lengths follow: of the machine, and of the room that it stands in."""
        share = self.heat.lag_share
        return (1.0 - share) * self.rise_c + share * self.deep_c + self.room_rise_c

    @property
    def room_rise_c(self) -> float:
        """Room above the temperature at which lengths are right."""
        return self.heat.room_at_c(self.time_s / 3600.0) - _ROOM_C

    def work(self, spent_s: float, feed_mm_min: float) -> None:
        """Let the machine work."""
        share = self.heat.feed_share
        power = 1.0 - share + share * feed_mm_min / self.heat.feed_mm_min
        self._pass(spent_s, self.heat.rise_c * power)

    def wait(self, spent_s: float) -> None:
        """Let the machine stand."""
        self._pass(spent_s, 0.0)

    def _pass(self, spent_s: float, target_c: float) -> None:
        tau_s = 60.0 * self.heat.time_constant_min
        self.deep_c += (target_c - self.deep_c) * (1.0 - np.exp(-spent_s / (3.0 * tau_s)))
        self.rise_c += (target_c - self.rise_c) * (1.0 - np.exp(-spent_s / tau_s))
        self.time_s += spent_s


def _logged_mm(
    test: CircularTest, angle: Floats, command: Command, due_s: Floats, driven: tuple[Driven, Driven]
) -> dict[str, Floats]:
    """Return what the control logs on its own clock, from the middle of the circle."""
    grid_s = np.arange(len(command.phase_rad)) * mill_drive.STEP_S
    nominal = test.radius_mm * np.stack([np.cos(angle), np.sin(angle)])
    out = {}
    for i, letter in enumerate(test.plane.lower()):
        followed = np.interp(command.start_s + due_s, grid_s, driven[i].encoder_mm)
        out[f"cmd_{letter}_mm"] = nominal[i]
        out[f"act_{letter}_mm"] = nominal[i] + followed
    return out


def _sense(test: CircularTest) -> float:
    return 1.0 if test.direction == "CCW" else -1.0


def _duration_s(test: CircularTest) -> float:
    """Return the time of one turn."""
    return 2.0 * np.pi * test.radius_mm / (test.feed_mm_min / 60.0)


def _scale_error_mm(position_mm: Floats, ppm: float, cubic_um: float) -> Floats:
    return np.asarray(1e-6 * ppm * position_mm + cubic_um / UM_PER_MM * (position_mm / 100.0) ** 3)


def _slips_mm(slip_um: float, fading_mm_s: float, speed: Floats, position: Floats, rng: np.random.Generator) -> Floats:
    """Return saw teeth of random length: an axis that creeps sticks and jumps."""
    if slip_um == 0.0:
        return np.zeros_like(position)
    tooth_mm = rng.uniform(0.05, 0.2)
    tooth = (position / tooth_mm + rng.random()) % 1.0 - 0.5
    creeping = np.abs(speed) < fading_mm_s
    return np.asarray(np.where(creeping, slip_um / UM_PER_MM * tooth, 0.0))
