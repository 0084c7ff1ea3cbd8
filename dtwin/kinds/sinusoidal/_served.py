"""The virtual slow tool servo under a program of tones, for corrections that come while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dtwin.features.tone_window import COMMAND_AMPLITUDE, COMMAND_PHASE, COMMANDED, SENT
from dtwin.kinds.sinusoidal._plan import TonePlan
from dtwin.kinds.sinusoidal._simulate import (
    EVERY,
    SAMPLE_HZ,
    Room,
    require_own_axis,
    tone_run,
    virtual_slide,
    write_tone_campaign,
)
from dtwin.machines.turning import MM_PER_UM, SERVO_HZ, AccelerationChannel, AnaloguePath, Instruments, TurningSlide
from dtwin.schema import Floats, Run, SignalGroup

_ACCELERATION = "tool_z_g"
# Before a group is recorded: five seconds for a window, and some to settle.
_AIR_S = 7.0
_SWELL_S = 1.0


def tone_check(*, quick: bool) -> TonePlan:
    """Return a few tones that take a minute or two to correct one after the other."""
    frequencies = (30.0,) if quick else (10.0, 20.0, 30.0, 40.0)
    return TonePlan("tones", "virtual-turning", frequencies, (5.0,), seconds=6.0)


class ServedSlide:
    """The slide at 8 kHz; probe, encoder and accelerometer look on.

    ``plan``: tones, one after the other; each swings for seven seconds before it is recorded.
    ``truth``: as for :func:`dtwin.kinds.sinusoidal._simulate.virtual_slide`.
    """

    name = "virtual slow tool servo, axis Z"
    period_s = 1.0 / SERVO_HZ
    axes = ("z",)
    provides = (COMMAND_PHASE, COMMAND_AMPLITUDE, COMMANDED, SENT, _ACCELERATION)
    channels_hz = SAMPLE_HZ

    def __init__(self, plan: TonePlan, truth: str, seed: int) -> None:
        require_own_axis(plan)
        self._plan, self._truth, self._seed = plan, truth, seed
        self._slide, self._instruments = virtual_slide(truth), Instruments()
        self._room = Room(plan, self._slide, seed)
        self._group_ticks = round((_AIR_S + plan.seconds) * SERVO_HZ)
        self._path = AnaloguePath()
        self._arriving = np.zeros(self._path.delay_ticks)
        self._rng = np.random.default_rng(seed * 10_007)
        self._machine = TurningSlide(self._slide)
        self._channel = AccelerationChannel(self._instruments.accelerometer, self._rng)
        self._asked, self._sample = np.zeros(EVERY), {COMMANDED: 0.0, SENT: 0.0, _ACCELERATION: 0.0}
        self._kept: list[tuple[float, float, float, float, float]] = []
        self._runs: list[Run] = []
        self._corrected = False

    @property
    def ticks(self) -> int:
        """Length of the program."""
        return self._plan.count * self._group_ticks

    def state(self, tick: int) -> Mapping[str, float]:
        """Return the commanded tone for the instant at which a correction arrives, and new samples."""
        number, within = divmod(tick, self._group_ticks)
        frequency, amplitude = self._tone(number, within + self._path.delay_ticks)
        ahead_s = within / SERVO_HZ + self._path.delay_s
        values = {
            "segment_id": number + 1.0,
            COMMAND_PHASE: math.fmod(2.0 * math.pi * frequency * ahead_s, 2.0 * math.pi),
            COMMAND_AMPLITUDE: amplitude,
        }
        return values | self._sample if within % EVERY == 0 and within > 0 else values

    def advance(self, tick: int, offset_um: Floats) -> None:
        """Take a correction; the slide moves when those of one sample are together."""
        place = tick % EVERY
        self._asked[place] = offset_um[2]
        self._corrected = self._corrected or bool(offset_um[2])
        if place + 1 == EVERY:
            number, within = divmod(tick, self._group_ticks)
            self._move(number, within + 1 - EVERY)
            if within + 1 == self._group_ticks:
                self._close_group(number)

    def write(self, folder: Path) -> str:
        """Write the recorded tones as a campaign folder; return what was written."""
        told = {"truth": self._truth, "seed": self._seed}
        write_tone_campaign(
            folder, self._runs, told, self._truth, folder.name, self._plan.machine, corrected=self._corrected
        )
        return f"{len(self._runs)} tones"

    def _tone(self, number: int, within: int) -> tuple[float, float]:
        group = self._plan.groups[number]
        return group.frequency_hz, group.amplitude_um * min(within / SERVO_HZ / _SWELL_S, 1.0)

    def _move(self, number: int, first: int) -> None:
        if first == 0:
            self._machine.slide = self._room.slide(number)
        t_s = np.arange(first, first + EVERY) / SERVO_HZ
        frequency, _ = self._tone(number, first)
        sizes = np.array([self._tone(number, first + k)[1] for k in range(EVERY)])
        wave = sizes * np.sin(2.0 * np.pi * frequency * t_s)
        arrived, self._arriving, _ = self._path.arrived_um(self._asked, self._arriving)
        motion = self._machine.run(wave + arrived)
        felt = float(self._channel.sampled_g(motion, EVERY)[0])
        self._sample = {COMMANDED: float(wave[0]), SENT: float(wave[0] + arrived[0]), _ACCELERATION: felt}
        if t_s[0] >= _AIR_S:
            self._kept.append((t_s[0] - _AIR_S, wave[0], motion.encoder_um[0], motion.tool_um[0], felt))

    def _close_group(self, number: int) -> None:
        t_s, wave, encoder, tool, felt = np.array(self._kept).T
        self._kept = []
        step = self._instruments.encoder_um
        tool = tool + self._instruments.probe_um * self._rng.normal(size=len(tool))
        samples = {
            "t_s": t_s,
            "cmd_z_mm": wave * MM_PER_UM,
            "act_z_mm": np.round(encoder / step) * step * MM_PER_UM,
            "tool_z_mm": tool * MM_PER_UM,
        }
        signal = SignalGroup("accelerometers", SAMPLE_HZ, {_ACCELERATION: felt})
        group = self._plan.groups[number]
        self._runs.append(
            tone_run(
                number + 1,
                group.frequency_hz,
                group.amplitude_um,
                (samples, signal),
                group.repeat,
                self._room.covariates(number),
            )
        )
