"""Tones of the virtual slide with and without a correction, by turns: a bundle in its loop, 8 kHz on the machine clock."""

from __future__ import annotations

import cmath
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta

import numpy as np

from dtwin.acquire.virtual import EPOCH
from dtwin.errors import InputError
from dtwin.features.sine import fit_tone
from dtwin.features.windows import StreamingWindow
from dtwin.kinds.sinusoidal._bundle import AMPLITUDE, PHASE, is_tone_bundle
from dtwin.kinds.sinusoidal._simulate import SAMPLE_HZ, virtual_slide
from dtwin.machines.turning import (
    MM_PER_UM,
    SERVO_HZ,
    AccelerationChannel,
    AnaloguePath,
    Instruments,
    Slide,
    TurningSlide,
)
from dtwin.progress import Progress, silent
from dtwin.schema import Floats, Run, RunMeta
from dtwin.serve.bundle import Bundle
from dtwin.serve.divergence import DivergenceWatch
from dtwin.serve.runtime import CompiledBundle
from dtwin.serve.safety import Guard
from dtwin.train.oracle import MeasuredWays, guard_shares, numbered
from dtwin.train.results import condition_name

# z = 0.006 x sin 2C - 0.006 x, x and z in mm.
SLOPE_UM_PER_MM = 6.0
RIM_MM = 0.5
TRIAL_HZ = (5.0, 10.0, 20.0, 30.0, 40.0)
# Before the cut the tool swings in the air: five seconds for a window, and some to settle.
AIR_S = 9.0
_REPEATS = 3
_RECORDED_S = 4.0
_AMPLITUDE_UM = SLOPE_UM_PER_MM * RIM_MM


def measured_tones(bundle: Bundle, truth: str, *, seed: int, progress: Progress = silent) -> MeasuredWays:
    """Swing the tool at each frequency several times with and without a bundle, by turns."""
    slide = virtual_slide(truth)
    runs: list[Run] = []
    counts: dict[str, list[Mapping[str, int]]] = defaultdict(list)
    for repeat in range(_REPEATS):
        for number, frequency in enumerate(TRIAL_HZ):
            command = ToneCommand(frequency, _swelling, np.zeros_like, AIR_S + _RECORDED_S)
            for way in (None, bundle):
                drawn = 1000 * (seed + 1) + 10 * (_REPEATS * number + repeat) + (way is not None)
                record = run_loop(slide, command, way, seed=drawn)
                run = _run(record, frequency, drawn, len(runs), bundle.model_sha256 if way else "")
                if way:
                    counts[condition_name(run.meta.condition)].append(record.guard)
                runs.append(run)
        progress(repeat + 1, _REPEATS, "tones")
    return MeasuredWays(
        numbered(runs),
        CLOCK,
        {"analogue path": AnaloguePath().delay_s},
        acted={name: guard_shares(counted) for name, counted in counts.items()},
    )


def _swelling(t_s: Floats) -> Floats:
    return np.asarray(_AMPLITUDE_UM * np.minimum(t_s, 1.0))


def _run(record: LoopRecord, frequency: float, seed: int, number: int, correction: str) -> Run:
    """Return what command and probe say after the tool has swung in."""
    kept = np.flatnonzero(record.t_s >= AIR_S)[:: round(SERVO_HZ / SAMPLE_HZ)]
    seen = Instruments().probe_um * np.random.default_rng(seed).normal(size=len(kept))
    samples = {
        "t_s": record.t_s[kept] - AIR_S,
        "cmd_z_mm": record.command_um[kept] * MM_PER_UM,
        "tool_z_mm": (record.tool_um[kept] + seen) * MM_PER_UM,
    }
    meta = RunMeta(
        "e",
        kind="sinusoidal",
        sample_rate_hz=SAMPLE_HZ,
        correction=correction,
        condition={"axis": "Z", "frequency_hz": frequency, "amplitude_um": _AMPLITUDE_UM},
        started=(EPOCH + timedelta(minutes=number)).isoformat(),
    )
    return Run(meta, samples, source="virtual slide")


CLOCK = "machine clock, 8 kHz"


@dataclass(frozen=True)
class ToneCommand:
    """What the slide shall do: a sine of slowly changing size about a slow path.

    ``amplitude_um``: size over time in s, arrays in and out.
    ``middle_um``: what the sine is about, over time.
    """

    frequency_hz: float
    amplitude_um: Callable[[Floats], Floats]
    middle_um: Callable[[Floats], Floats]
    duration_s: float


@dataclass(frozen=True)
class LoopRecord:
    """One run of the loop.

    ``t_s``, ``command_um``, ``tool_um``, ``correction_um``, (ticks,): command, tool and what arrived of the correction.
    ``gains``, ``left_um``, (windows,): what each window told, and the error that it foretold of the
    corrected motion.
    ``saturated``: ticks at which the analogue output was at its limit.
    ``alarm``: why the correction was released; empty when it was not.
    """

    t_s: Floats
    command_um: Floats
    tool_um: Floats
    correction_um: Floats
    gains: Floats
    left_um: Floats
    guard: dict[str, int]
    saturated: int
    alarm: str


def run_loop(slide: Slide, command: ToneCommand, bundle: Bundle | None, *, seed: int) -> LoopRecord:
    """Run the slide, corrected by a bundle through guard and analogue path, or as it is.

    Each second the features of the last five seconds are taken, by the code that trained; each tick the
    sine is evaluated for the instant at which it will arrive. Until the first window there is no
    correction. When the divergence watch speaks, the correction goes to zero and stays there.

    ``bundle``: corrects tones; None for the motion without.
    """
    if bundle is not None and (not is_tone_bundle(bundle) or bundle.window is None):
        raise InputError(
            "the bundle does not correct tones",
            code="turning.bundle",
            got=", ".join(bundle.tick_inputs)[:120],
            allowed=f"{PHASE}, {AMPLITUDE}",
            hint="dtwin train CAMPAIGN, of a sinusoidal campaign",
        )
    return _Loop(slide, command, bundle, seed).run()


class _Loop:
    def __init__(self, slide: Slide, command: ToneCommand, bundle: Bundle | None, seed: int) -> None:
        self.machine, self.command, self.bundle = TurningSlide(slide), command, bundle
        rng = np.random.default_rng(seed)
        self.channel = AccelerationChannel(Instruments().accelerometer, rng)
        self.path = AnaloguePath()
        self.held = np.zeros(self.path.delay_ticks)
        self.watch = DivergenceWatch()
        self.told: list[tuple[float, float]] = []
        self.saturated = 0
        self.brain = _Brain(bundle) if bundle is not None else None

    def run(self) -> LoopRecord:
        window = self.bundle.window if self.bundle is not None else None
        hop = round((window.hop / window.rate_hz if window is not None else 1.0) * SERVO_HZ)
        starts = range(0, round(self.command.duration_s * SERVO_HZ), hop)
        parts = [self._hop(np.arange(first, first + hop) / SERVO_HZ) for first in starts]
        t, command, tool, arrived = (np.concatenate(column) for column in zip(*parts, strict=True))
        told = np.array(self.told).reshape(-1, 2)
        return LoopRecord(
            t,
            command,
            tool,
            arrived,
            told[:, 0],
            told[:, 1],
            guard=self.brain.guard.counted() if self.brain else {},
            saturated=self.saturated,
            alarm=self.watch.alarm,
        )

    def _commanded(self, t: Floats) -> Floats:
        angle = 2.0 * np.pi * self.command.frequency_hz * t
        return self.command.middle_um(t) + self.command.amplitude_um(t) * np.sin(angle)

    def _hop(self, t: Floats) -> tuple[Floats, ...]:
        wanted = np.zeros(len(t))
        if self.brain is not None and self.brain.ready:
            ahead = t + self.path.delay_s
            angle = np.mod(2.0 * np.pi * self.command.frequency_hz * ahead, 2.0 * np.pi)
            wanted = self.brain.corrections(angle, self.command.amplitude_um(ahead), released=bool(self.watch.alarm))
        arrived, self.held, clipped = self.path.arrived_um(wanted, self.held)
        self.saturated += clipped
        command = self._commanded(t)
        sent = command + arrived
        motion = self.machine.run(sent)
        if self.brain is not None:
            every = round(SERVO_HZ / self.brain.rate_hz)
            # The machine knows its slow path; the window is of the sine.
            wave = (sent - self.command.middle_um(t))[::every]
            if self.brain.sensed(wave, self.channel.sampled_g(motion, every)):
                self._judge(t, command, sent)
        return t, command, motion.tool_um, arrived

    def _judge(self, t: Floats, command: Floats, sent: Floats) -> None:
        assert self.brain is not None
        gain, lag = self.brain.gain, self.brain.lag_rad
        frequency = self.command.frequency_hz
        every = round(SERVO_HZ / self.brain.rate_hz)
        wanted, given = (fit_tone(t[::every], v[::every], frequency) for v in (command, sent))
        left = abs(given.phasor * gain * cmath.exp(-1j * lag) - wanted.phasor)
        self.watch.window(left, inside=self.brain.inside)
        self.told.append((gain, left))


class _Brain:
    """Window, bundle and guard of the loop."""

    def __init__(self, bundle: Bundle) -> None:
        assert bundle.window is not None
        self.rate_hz = bundle.window.rate_hz
        self.ready = self.inside = False
        self.gain, self.lag_rad = 1.0, 0.0
        self._bundle, self._compiled = bundle, CompiledBundle(bundle)
        self._stream = StreamingWindow(bundle.window)
        columns = bundle.window.columns
        self._places = [columns.index(name) for name in bundle.feature_inputs]
        self.guard = Guard(bundle.safety, *bundle.box)
        self._features = np.zeros(len(self._places))

    def sensed(self, sent_um: Floats, acceleration_g: Floats) -> bool:
        """Take samples; return whether they completed a window."""
        features = self._stream.push(np.stack([sent_um, acceleration_g]))
        if not len(features.values):
            return False
        self._features = features.values[-1].reshape(-1)[self._places]
        self._compiled.window(self._features)
        named = dict(zip(self._bundle.feature_inputs, self._features.tolist(), strict=True))
        graph = self._bundle.window_graph
        assert graph is not None
        told, _ = graph.evaluate(named, {})
        self.gain, self.lag_rad = told["gain_1"], told["phase_error_rad"]
        boxed = [(i.low, i.high) for i in self._bundle.inputs if i.source == "feature"]
        self.inside = all(
            low <= value <= high for value, (low, high) in zip(self._features.tolist(), boxed, strict=True)
        )
        self.ready = True
        return True

    def corrections(self, angle: Floats, amplitude_um: Floats, *, released: bool) -> Floats:
        """Return what the guard lets through at successive ticks, shape (n,)."""
        given = {PHASE: angle, AMPLITUDE: amplitude_um}
        rows = np.column_stack([given[name] for name in self._bundle.tick_inputs])
        wanted = np.zeros((len(angle), 3))
        if not released:
            wanted[:, 2] = self._compiled.run(rows)[:, 0]
        named = given | dict(zip(self._bundle.feature_inputs, self._features, strict=True))
        box = np.column_stack([np.broadcast_to(named[i.name], len(angle)) for i in self._bundle.inputs])
        return self.guard.run(wanted, box, elapsed_s=1.0 / SERVO_HZ)[:, 2]
