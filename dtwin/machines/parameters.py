"""Parameters of the virtual cobot, read from the committed ``cobot.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any, get_type_hints

from dtwin.errors import InputError


@dataclass(frozen=True)
class MotionParameters:
    """How the controller moves along a program."""

    acceleration_mm_s2: float
    jerk_mm_s3: float
    dwell_s: float
    rest_s: float
    infeed_mm: float
    infeed_speed_mm_s: float
    overshoot_xy_deg: float
    arc_overlap_deg: float
    start_angle_xy_deg: float
    tcp_z_mm: float
    centre_y_mm: float
    centre_z_mm: float
    centre_x_small_mm: float
    centre_x_large_mm: float
    large_radius_from_mm: float


@dataclass(frozen=True)
class JointParameters:
    """What the gears, bearings and drives of the six joints do wrong.

    ``orders_per_turn``, ``order_amplitude_urad``: transmission error: periods per turn of the joint, amplitudes by
    joint.
    ``flank_orders_from``: from this order on it belongs to the gear: a phase for each tooth flank, an amplitude that
    the next three modulate.
    ``flexspline_1``: share by which the gear's amplitude swells and shrinks once a turn: the flexspline is not round.
    ``load_1``, ``load_nm``: share by which the load raises the gear's amplitude in the end, and where that saturates.
    ``play_width_urad``, ``friction_urad``, ``friction_width_urad``, ``friction_recovery_s``: lost motion; disturbance
    of the position loop at reversals.
    ``compliance_urad_nm``: wind-up under a large torque.
    ``soft_1``: additional compliance about zero torque, as a share; it saturates at ``load_nm``.
    ``hysteresis_nm``: width of the play between torque and wind-up.
    ``length_error_mm``, ``zero_error_urad``: standard deviations of the kinematics.
    ``mass_kg``: upper arm, forearm, and everything beyond the wrist.
    """

    orders_per_turn: tuple[float, ...]
    order_amplitude_urad: tuple[tuple[float, ...], ...]
    flank_orders_from: float
    flexspline_1: float
    load_1: float
    load_nm: float
    play_width_urad: tuple[float, ...]
    friction_urad: tuple[float, ...]
    friction_width_urad: float
    friction_recovery_s: float
    compliance_urad_nm: tuple[float, ...]
    soft_1: float
    hysteresis_nm: float
    length_error_mm: float
    zero_error_urad: float
    mass_kg: tuple[float, ...]


@dataclass(frozen=True)
class StructureParameters:
    """Lightly damped modes of arm and base.

    ``frequency_hz`` holds at a reach of ``posture_reach_mm`` from the axis of joint 1; elsewhere it is
    multiplied by (reference / reach) to the power ``posture_1``: a long arm swings slowly.
    """

    frequency_hz: tuple[float, ...]
    damping_ratio: tuple[float, ...]
    shape: tuple[tuple[float, float, float], ...]
    participation: tuple[float, ...]
    jolt_participation: tuple[float, ...]
    jolt_speed_share: float
    restart_share: float
    jolt_s: float
    flange_share: tuple[float, ...]
    base_share: float
    posture_1: float = 0.0
    posture_reach_mm: float = 550.0


@dataclass(frozen=True)
class _DisturbanceParameters:
    """What does not repeat."""

    drift_rms_um: float
    drift_time_s: float
    eccentricity_low_um: float
    eccentricity_high_um: float
    eccentricity_normal_um: float
    bar_length_error_um: float


@dataclass(frozen=True)
class BallbarParameters:
    """Telescoping ball bar."""

    rate_hz: float
    quantum_um: float
    noise_um: float
    clock_offset_s: float
    clock_error_ppm: float
    trigger_mm: float


@dataclass(frozen=True)
class AccelerometerParameters:
    """Two triaxial IEPE accelerometers and their digitiser."""

    rate_hz: float
    corner_hz: float
    noise_rms_ug: float
    range_g: float
    gain_error: float
    cross_axis: float
    misalignment_deg: float
    clock_offset_s: float
    clock_error_ppm: float
    base_floor_ug: float
    base_line_hz: float
    base_line_ug: float


@dataclass(frozen=True)
class ControllerParameters:
    """Robot controller and its path-offset input."""

    rate_hz: float
    log_rate_hz: float
    offset_limit_um: float
    offset_rate_um_s: float
    actuator_delay_s: float
    actuator_lag_s: float
    watchdog_s: float


@dataclass(frozen=True)
class CobotParameters:
    """All parameters of the virtual cobot, one section per mechanism."""

    motion: MotionParameters
    joints: JointParameters
    structure: StructureParameters
    disturbance: _DisturbanceParameters
    ballbar: BallbarParameters
    accelerometers: AccelerometerParameters
    controller: ControllerParameters


def load_parameters(path: Path | None = None) -> CobotParameters:
    """Return the parameters of a TOML file; without one, the committed ones.

    Raises ``InputError`` when a section or a parameter is missing or unknown.
    """
    if path is None:
        text = resources.files("dtwin.machines").joinpath("cobot.toml").read_text("utf-8")
    else:
        text = path.read_text("utf-8")
    table = tomllib.loads(text)
    sections = {
        name: _section(kind, table.get(name, {}), f"{path or 'cobot.toml'} [{name}]")
        for name, kind in get_type_hints(CobotParameters).items()
    }
    return CobotParameters(**sections)


def _section(kind: type, table: Mapping[str, Any], where: str) -> Any:
    wanted = {field.name for field in fields(kind)}
    if set(table) != wanted:
        raise InputError(
            "machine parameters are incomplete or unknown",
            code="machine.parameters",
            where=where,
            got=", ".join(sorted(set(table) ^ wanted)),
            allowed=", ".join(sorted(wanted)),
        )
    return kind(**{name: _frozen(value) for name, value in table.items()})


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value
