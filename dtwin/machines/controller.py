"""The virtual cobot's controller, one tick at a time, for closed loops."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from dtwin.links import layout
from dtwin.machines import mechanism as m_
from dtwin.machines._instrument_record import CobotRecording, RunTicks
from dtwin.machines.mechanism import Mechanism, run_kernel, set_speed_factor, tick_kernel
from dtwin.machines.motion import CircleCondition, MotionPlan
from dtwin.schema import Floats

_GROWTH = 4096


class CobotController:
    """Runs one program tick by tick and applies the correction in its input registers.

    The offset acts as a path offset of the robot's program would: latched when its sequence
    number changes, limited in size and rate, delayed and lagged by the drives, and led back to
    zero when the sequence number stands still; from then on it takes nothing before a zero offset.

    ``mechanism``, ``memory``: the machine at rest at the start of the program.
    """

    def __init__(self, condition: CircleCondition, plan: MotionPlan, mechanism: Mechanism, memory: Floats) -> None:
        self.condition = condition
        self.plan = plan
        self._mechanism = mechanism
        self._memory = memory
        self._tick_s = 1.0 / round(1.0 / mechanism.control[0])
        self._registers = layout.correction_registers()
        rows = round(plan.duration_s / self._tick_s) + 1
        self._states = np.zeros((rows, layout.N))
        self._truths = np.zeros((rows, m_.TRUTH_N))
        self._constants = layout.empty_state()
        self._describe_path()
        self._n = 0
        self._advance()

    def _describe_path(self) -> None:
        fixed = self._constants
        fixed[layout.PLANE_ID] = layout.PLANE_OF_ID.index(self.condition.plane)
        fixed[layout.CENTRE : layout.CENTRE + 3] = self.plan.frame[2]
        fixed[layout.RADIUS] = self.condition.radius_mm
        fixed[layout.DIRECTION_SIGN] = self.condition.sign
        fixed[layout.FEED] = self.condition.feed_mm_min
        fixed[layout.RUNTIME_RUNNING] = 1.0
        fixed[layout.SAFETY_OK] = 1.0

    @property
    def done(self) -> bool:
        """Whether the program has ended."""
        return m_.path_time_s(self._memory) >= self.plan.duration_s - 0.5 * self._tick_s

    def state(self) -> layout.RobotState:
        """Return the newest state; the array is a view that later ticks do not change."""
        return self._states[self._n - 1]

    def step(self, registers: Floats) -> None:
        """Advance by one period with these correction registers (4,) in force."""
        self._registers[:] = registers
        self._advance()

    @property
    def ticks_left(self) -> int:
        """Periods until the program ends, at its programmed speed."""
        return max(0, math.ceil((self.plan.duration_s - m_.path_time_s(self._memory)) / self._tick_s - 0.5))

    def run(self, registers: Floats) -> None:
        """Advance by one period per row of correction registers (n, 4), as :meth:`step` would."""
        first, end = self._n, self._n + len(registers)
        while end > len(self._states):
            self._grow()
        states, truths = self._states[first:end], self._truths[first:end]
        states[:] = self._constants
        run_kernel(self._mechanism, self.plan.segments, self.plan.frame, registers, self._memory, states, truths)
        states[:, layout.TIMESTAMP] = np.arange(first, end) * self._tick_s
        self._registers[:], self._n = registers[-1], end

    def adopt_sequence(self, sequence: int) -> None:
        """Take a sequence number as already seen, as a program that begins beside a client does."""
        m_.adopt_sequence(self._memory, sequence)

    def set_speed_scaling(self, factor: float) -> None:
        """Scale the speed along the path, as the robot's speed slider does; 0 to 1."""
        set_speed_factor(self._memory, min(max(factor, 0.0), 1.0))

    def protective_stop(self) -> None:
        """Stop the program and report it, as a robot does after a collision."""
        self._halt(layout.STOPPED, layout.PROTECTIVE_STOP)

    def emergency_stop(self) -> None:
        """Stop the program as the emergency button does."""
        self._halt(layout.STOPPED, layout.EMERGENCY)

    def pause(self) -> None:
        """Hold the program where it is; the thread that applies the offset goes on."""
        self._halt(layout.PAUSED, layout.SAFE)

    def resume(self, speed_factor: float = 1.0) -> None:
        """Unlock any stop and go on with the program."""
        self._halt(layout.RUNNING, layout.SAFE)
        self.set_speed_scaling(speed_factor)

    @property
    def commanded_um(self) -> Floats:
        """Offset (3,) that the program asks of the drives now, before their delay and lag."""
        return m_.commanded_offset_um(self._memory)

    def _halt(self, running: float, safety: float) -> None:
        set_speed_factor(self._memory, 0.0)
        self._constants[layout.RUNTIME_RUNNING] = running
        self._constants[layout.SAFETY_OK] = safety

    def ticks(self) -> RunTicks:
        """Return every tick so far; the arrays are views."""
        return RunTicks(self._states[: self._n], self._truths[: self._n])

    def _advance(self) -> None:
        if self._n == len(self._states):
            self._grow()
        state = self._states[self._n]
        state[:] = self._constants
        tick_kernel(
            self._mechanism,
            self.plan.segments,
            self.plan.frame,
            self._registers,
            self._memory,
            state,
            self._truths[self._n],
        )
        state[layout.TIMESTAMP] = self._n * self._tick_s
        self._n += 1

    def _grow(self) -> None:
        self._states = np.vstack([self._states, np.zeros((_GROWTH, layout.N))])
        self._truths = np.vstack([self._truths, np.zeros((_GROWTH, m_.TRUTH_N))])


class CircleController(CobotController):
    """The controller on a circle, which the instruments record.

    ``condition``, ``plan``, ``mechanism``, ``memory``: as for :class:`CobotController`.
    ``make_recording``: turns the ticks of the finished run into a recording.
    """

    def __init__(
        self,
        condition: CircleCondition,
        plan: MotionPlan,
        mechanism: Mechanism,
        memory: Floats,
        make_recording: Callable[[RunTicks], CobotRecording],
    ) -> None:
        super().__init__(condition, plan, mechanism, memory)
        self._make_recording = make_recording

    def recording(self) -> CobotRecording:
        """Return what the instruments recorded, with the correction's effect in it."""
        return self._make_recording(self.ticks())
