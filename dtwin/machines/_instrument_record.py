"""From the ticks of one run to what its instruments recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dtwin.kinematics import radial_unit
from dtwin.links import layout
from dtwin.machines import mechanism as m_
from dtwin.machines._sensors import accelerometer_group, drift_kernel, read_ballbar
from dtwin.machines.motion import ANGLE0, START_S, CircleCondition, MotionPlan
from dtwin.machines.parameters import CobotParameters
from dtwin.schema import Floats, SignalGroup
from dtwin.units import UM_PER_MM


@dataclass(frozen=True)
class Setup:
    """One mounting of the ball bar.

    ``eccentricity_um``, (3,): how far the table's ball is from where the robot believes the centre to be.
    """

    eccentricity_um: Floats
    length_error_um: float


@dataclass(frozen=True)
class _CobotTruth:
    """What no instrument knows.

    ``bar_start_s``, ``bar_ppm``: machine time of the first ball-bar sample; error of the bar's clock.
    ``t_s``, (ticks,): machine time of the parts.
    ``angle_rad``, (ticks,): commanded path angle, unwrapped.
    ``parts_um``, (ticks,): radial error by cause: ``joints``, ``structure``, ``drift``, ``setup``, ``correction``.
    """

    bar_start_s: float
    bar_ppm: float
    accelerometer_start_s: float
    accelerometer_ppm: float
    setup: Setup
    t_s: Floats
    angle_rad: Floats
    parts_um: Mapping[str, Floats]


@dataclass(frozen=True)
class CobotRecording:
    """What the instruments recorded during one run.

    ``condition``: plane in standard form.
    ``sample_rate_hz``: rate of the ball bar by its own clock.
    ``deviation_mm``, (n,): ball bar: length minus nominal radius.
    ``window``: first and one-past-last sample of the test, where the commanded path angle crosses the nominal start and
    end.
    ``groups``: ``accelerometers`` and ``controller``, each on its own clock.
    ``duration_s``: length of the program by the machine's clock.
    """

    condition: CircleCondition
    setup: str
    repeat: int
    sample_rate_hz: float
    deviation_mm: Floats
    window: tuple[int, int]
    groups: tuple[SignalGroup, ...]
    truth: _CobotTruth
    duration_s: float


@dataclass(frozen=True)
class RunTicks:
    """Every tick of one finished run.

    ``states``, ``truths`` (ticks, layout.N) or (ticks, TRUTH_N): what the controller reported, and what really
    happened.
    """

    states: Floats
    truths: Floats


def _path_geometry(plan: MotionPlan, plane: str, path_mm: Floats) -> tuple[Floats, Floats, Floats]:
    """Return path angle (unwrapped), distance from the centre in mm, and radial unit vector."""
    spoke = path_mm - plan.frame[2]
    first, second = spoke @ plan.frame[0], spoke @ plan.frame[1]
    angle = np.unwrap(np.arctan2(second, first))
    start = plan.segments[0, ANGLE0]
    angle += 2.0 * np.pi * np.round((start - angle[0]) / (2.0 * np.pi))
    return angle, np.hypot(first, second), radial_unit(plane, angle)


def record(
    parameters: CobotParameters,
    condition: CircleCondition,
    plan: MotionPlan,
    ticks: RunTicks,
    mounting: tuple[str, int, Setup],
    matrices: tuple[Floats, Floats],
    rng: np.random.Generator,
) -> CobotRecording:
    """Return the recording of a finished run.

    ``mounting``: name of the set-up, repeat, and the mounting itself.
    ``matrices``: wrist and base accelerometer.
    ``rng``: source of everything that differs from run to run.
    """
    setup_name, repeat, setup = mounting
    rate_hz, bar = parameters.controller.rate_hz, parameters.ballbar
    truths = ticks.truths
    angle, distance_mm, radial = _path_geometry(plan, condition.plane, truths[:, :3])
    drift_um = rng.standard_normal((len(truths), 3))
    disturbance = parameters.disturbance
    drift_kernel(drift_um, disturbance.drift_rms_um, disturbance.drift_time_s, 1.0 / rate_hz)
    tool_mm = truths[:, m_.TCP : m_.TCP + 3] + drift_um / UM_PER_MM
    centre_mm = plan.frame[2] + setup.eccentricity_um / UM_PER_MM
    near = np.flatnonzero(np.abs(distance_mm - condition.radius_mm) < bar.trigger_mm)
    arc_start_s = plan.segments[1, START_S]
    latest_s = min(bar.clock_offset_s, arc_start_s - near[0] / rate_hz)
    bar_start_s = arc_start_s - rng.uniform(0.0, latest_s)
    bar_ppm = bar.clock_error_ppm * rng.uniform(-1, 1)
    samples = int((near[-1] / rate_hz - bar_start_s) * bar.rate_hz)
    noise_um = setup.length_error_um + bar.noise_um * rng.standard_normal(samples)
    clock = (bar_start_s, bar_ppm, samples)
    deviation_mm = read_ballbar(bar, tool_mm, rate_hz, centre_mm, condition.radius_mm, clock, noise_um)
    sensors = parameters.accelerometers
    sensor_start_s = rng.uniform(0.0, sensors.clock_offset_s)
    sensor_ppm = sensors.clock_error_ppm * rng.uniform(-1, 1)
    motion = (truths[:, m_.FLANGE : m_.FLANGE + 3], truths[:, m_.ROTATION :], rate_hz)
    accelerometers = accelerometer_group(
        sensors, matrices, parameters.structure.base_share, motion, sensor_start_s, sensor_ppm, rng
    )
    truth = _CobotTruth(
        bar_start_s,
        bar_ppm,
        sensor_start_s,
        sensor_ppm,
        setup,
        np.arange(len(truths)) / rate_hz,
        angle,
        _parts_um(ticks, radial, drift_um, setup),
    )
    return CobotRecording(
        condition,
        setup_name,
        repeat,
        bar.rate_hz,
        deviation_mm,
        _window(plan, condition.sign * angle, clock, parameters),
        (accelerometers, _controller_group(parameters, ticks.states)),
        truth,
        plan.duration_s,
    )


def _parts_um(ticks: RunTicks, radial: Floats, drift_um: Floats, setup: Setup) -> dict[str, Floats]:
    truths = ticks.truths
    rigid, path = truths[:, m_.RIGID : m_.RIGID + 3], truths[:, :3]
    applied_um = ticks.states[:, layout.APPLIED : layout.APPLIED + 3]
    vectors = {
        "joints": UM_PER_MM * (rigid - path) - applied_um,
        "structure": UM_PER_MM * (truths[:, m_.TCP : m_.TCP + 3] - rigid),
        "drift": drift_um,
        "setup": np.broadcast_to(-setup.eccentricity_um, radial.shape),
        "correction": applied_um,
    }
    parts = {name: np.sum(vector * radial, axis=1) for name, vector in vectors.items()}
    parts["setup"] = parts["setup"] + setup.length_error_um
    return parts


def _window(
    plan: MotionPlan, forward_rad: Floats, clock: tuple[float, float, int], parameters: CobotParameters
) -> tuple[int, int]:
    """Return the bar's samples between the nominal angles of the commanded path."""
    start_s, ppm, samples = clock
    rate_hz = parameters.controller.rate_hz
    bounds = [abs(end - plan.segments[0, ANGLE0]) for end in plan.window_rad]
    since = forward_rad - forward_rad[0]
    places = []
    for bound in bounds:
        time_s = int(np.searchsorted(since, bound - 1e-9)) / rate_hz
        place = round((time_s - start_s) * parameters.ballbar.rate_hz * (1.0 + 1e-6 * ppm))
        places.append(min(max(place, 0), samples))
    return places[0], places[1]


def _controller_group(parameters: CobotParameters, states: Floats) -> SignalGroup:
    rate_hz = parameters.controller.log_rate_hz
    every = max(1, round(parameters.controller.rate_hz / rate_hz))
    rows = states[::every]
    kept = [name for name in layout.NAMES if name.startswith(("target", "actual", "applied"))]
    columns = {name: np.ascontiguousarray(rows[:, layout.INDEX[name]]) for name in kept}
    columns["segment_time_s"] = np.ascontiguousarray(rows[:, layout.SEGMENT_TIME])
    whole = {
        "segment_id": rows[:, layout.SEGMENT_ID].astype(np.int64),
        "applied_sequence": columns.pop("applied_sequence").astype(np.int64),
    }
    return SignalGroup("controller", parameters.controller.rate_hz / every, {**columns, **whole}, 0.0)
