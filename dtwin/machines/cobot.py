"""The virtual cobot: a mechanism with known truth and a seed."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from dtwin.kinematics import UR10E, normal_unit, plane_axes
from dtwin.links import layout
from dtwin.machines import mechanism as m_
from dtwin.machines._instrument_record import CobotRecording, RunTicks, Setup, record
from dtwin.machines._joints import gravity_torque_kernel, transmission_table, wind_up_kernel
from dtwin.machines._sensors import sensor_matrix
from dtwin.machines.controller import CircleController
from dtwin.machines.mechanism import Mechanism, build_mechanism, run_kernel, start_memory
from dtwin.machines.motion import ANGLE0, KIND, LINE, LINE_FROM, RADIUS0, CircleCondition, MotionPlan, plan_motion
from dtwin.machines.parameters import CobotParameters, load_parameters
from dtwin.schema import Floats

__all__ = ["CircleCondition", "CobotRecording", "RunTicks", "VirtualCobot"]

TOOL_DOWN = np.diag([-1.0, 1.0, -1.0])
"""Rotation of the tool in the base frame: pointing down, turned with the work frame."""

ELBOW_UP_RAD = np.radians([-18.5, -86.3, 137.0, -140.7, -90.0, -108.5])
"""Joint branch: shoulder in front, elbow up, wrist away from its singular pose."""

# As many as a set-up of the training plan has: three feeds, two directions.
_PROGRAMS_KEPT = 6


class VirtualCobot:
    """A UR10e with a ball bar and accelerometers, whose errors are known.

    Everything is a function of seed, set-up, repeat and condition; the seed says which of the machines that share
    these parameters it is.
    """

    def __init__(self, parameters: CobotParameters | None = None, seed: int = 0) -> None:
        self.parameters = parameters or load_parameters()
        self.seed = seed
        rng = np.random.default_rng([seed, 1])
        joints = self.parameters.joints
        self._transmission = transmission_table(joints, rng)
        self._true_dh = UR10E.dh.copy()
        self._true_dh[:, :2] += joints.length_error_mm * rng.standard_normal((6, 2))
        self._true_dh[:, 3] += 1e-6 * joints.zero_error_urad * rng.standard_normal(6)
        sensors = self.parameters.accelerometers
        self._prepared: dict[CircleCondition, tuple[MotionPlan, Mechanism, Floats]] = {}
        # Of the latest programs: a run without correction is the same in every mounting and repeat.
        self._ran: dict[CircleCondition, RunTicks] = {}
        self._matrices = (sensor_matrix(sensors, rng), sensor_matrix(sensors, rng))

    def measure(self, condition: CircleCondition, *, setup: str, repeat: int) -> CobotRecording:
        """Return the recording of one run, on the machine's clock, without waiting for it.

        ``setup``: mounting of the bar; runs of one set-up share eccentricity and length error.
        Raises ``InputError`` when the condition makes no sense or is out of reach.
        """
        condition = condition.standard()
        plan = self.plan(condition)
        if condition not in self._ran:
            if len(self._ran) == _PROGRAMS_KEPT:
                del self._ran[next(iter(self._ran))]
            self._ran[condition] = self.run(plan)
        return self.recording_of(condition, plan, self._ran[condition], setup, repeat)

    def controller(self, condition: CircleCondition, *, setup: str, repeat: int) -> CircleController:
        """Return the machine's controller about to run a condition, for a closed loop."""
        condition = condition.standard()
        if condition not in self._prepared:
            plan = self.plan(condition)
            self._prepared[condition] = (plan, *self._machine(plan))
        plan, mechanism, memory = self._prepared[condition]
        return CircleController(
            condition,
            plan,
            mechanism,
            memory.copy(),
            lambda ticks: self.recording_of(condition, plan, ticks, setup, repeat),
        )

    def centre_mm(self, radius_mm: float) -> Floats:
        """Return the nominal centre of the bar's table end in the base frame, shape (3,)."""
        motion = self.parameters.motion
        large = radius_mm >= motion.large_radius_from_mm
        x_mm = motion.centre_x_large_mm if large else motion.centre_x_small_mm
        return np.array([x_mm, motion.centre_y_mm, motion.centre_z_mm])

    def plan(self, condition: CircleCondition) -> MotionPlan:
        """Return the timed motion of a condition in standard form."""
        parameters = self.parameters
        tick_s = 1.0 / parameters.controller.rate_hz
        return plan_motion(condition, self.centre_mm(condition.radius_mm), parameters.motion, tick_s)

    def setup(self, name: str, plane: str) -> Setup:
        """Return the mounting of a given name."""
        rng = np.random.default_rng([self.seed, 2, zlib.crc32(name.encode())])
        errors = self.parameters.disturbance
        size = rng.uniform(errors.eccentricity_low_um, errors.eccentricity_high_um)
        towards = rng.uniform(0.0, 2.0 * np.pi)
        first, second = plane_axes(plane)
        in_plane = size * (np.cos(towards) * first + np.sin(towards) * second)
        normal = errors.eccentricity_normal_um * rng.uniform(-1, 1) * normal_unit(plane)
        return Setup(in_plane + normal, errors.bar_length_error_um * rng.uniform(-1, 1))

    def recording_of(
        self, condition: CircleCondition, plan: MotionPlan, ticks: RunTicks, setup: str, repeat: int
    ) -> CobotRecording:
        """Return what the instruments made of a finished run."""
        text = f"{condition.plane} {condition.radius_mm} {condition.feed_mm_min}"
        key = zlib.crc32(f"{text} {condition.direction} {setup}".encode())
        rng = np.random.default_rng([self.seed, 3, key, repeat])
        mounting = (setup, repeat, self.setup(setup, condition.plane))
        return record(self.parameters, condition, plan, ticks, mounting, self._matrices, rng)

    def run(self, plan: MotionPlan) -> RunTicks:
        """Return every tick of a program without correction, on the machine's clock."""
        mechanism, memory = self._machine(plan)
        n = round(plan.duration_s * self.parameters.controller.rate_hz)
        states, truths = np.zeros((n, layout.N)), np.zeros((n, m_.TRUTH_N))
        run_kernel(mechanism, plan.segments, plan.frame, np.zeros((1, 4)), memory, states, truths)
        return RunTicks(states, truths)

    def at_rest(self, plan: MotionPlan) -> tuple[Mechanism, Floats]:
        """Return the mechanism and its memory, at rest where a program begins."""
        return self._machine(plan)

    def _machine(self, plan: MotionPlan) -> tuple[Mechanism, Floats]:
        """Return the mechanism, zeroed at the circle's centre, and its memory at the start."""
        mechanism = build_mechanism(self.parameters, self._transmission, self._true_dh, TOOL_DOWN)
        centre = plan.frame[2]
        tcp = mechanism.geometry[0]
        at_centre = UR10E.inverse(centre, TOOL_DOWN, tcp, ELBOW_UP_RAD)
        mechanism.geometry[1] = self._static_position_mm(mechanism, at_centre) - centre
        first = plan.segments[0]
        outward = np.cos(first[ANGLE0]) * plan.frame[0] + np.sin(first[ANGLE0]) * plan.frame[1]
        start = centre + first[RADIUS0] * outward
        if first[KIND] == LINE:
            start = first[LINE_FROM : LINE_FROM + 3]
        way = np.linspace(centre, start, 50)
        return mechanism, start_memory(UR10E.inverse_many(way, TOOL_DOWN, tcp, at_centre)[-1])

    def _static_position_mm(self, mechanism: Mechanism, q_rad: Floats) -> Floats:
        torque = np.zeros(6)
        gravity_torque_kernel(q_rad, UR10E.dh, mechanism.masses_kg, torque)
        wound = [wind_up_kernel(t, row) for t, row in zip(torque, mechanism.joints, strict=True)]
        link = q_rad + np.array(wound)
        chain = replace(UR10E, name="true UR10e", dh=self._true_dh)
        return chain.forward(link, mechanism.geometry[0])[0]
