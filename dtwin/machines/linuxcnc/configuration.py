"""What LinuxCNC is given: its ini file, the faults of its machine, compensation tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from dtwin.atomic import read_toml
from dtwin.errors import InputError
from dtwin.units import is_number

AXES = "XYZ"
TRAVEL_MM = 150.0
_MAX_COMP_BYTES = 100_000
_MOST_TRIPLETS = 256
_RANGES = {
    "position_gain": (1.0, 900.0),
    "noise": (0.0, 100.0),
    "feed_forward_x": (0.0, 2.0),
    "feed_forward_y": (0.0, 2.0),
}


@dataclass(frozen=True)
class MillFaults:
    """What is wrong with the simulated machine; the names are those of the component's parameters.

    ``position_gain``: of the position loops, 1/s.
    ``feed_forward_x``, ``feed_forward_y``: share of the commanded speed that is fed forward.
    ``play_x``, ``play_y``: play between encoder and carriage, mm.
    ``scale_x``, ``scale_y``: relative error of the screws.
    ``wave_x``: amplitude once per turn of the screw, mm.
    ``lean_xy``: lean of the Y axis towards X, rad.
    ``mounting_x``, ``mounting_y``: centre ball from the programmed centre, mm.
    ``noise``: of the bar, um.
    """

    position_gain: float = 300.0
    feed_forward_x: float = 0.994
    feed_forward_y: float = 1.006
    play_x: float = 0.006
    play_y: float = 0.0
    scale_x: float = 60e-6
    scale_y: float = 0.0
    wave_x: float = 0.0
    lean_xy: float = 80e-6
    mounting_x: float = 0.012
    mounting_y: float = -0.007
    noise: float = 0.2

    def hal_lines(self, seed: int) -> list[str]:
        """Return HAL commands that give the machine its faults."""
        lines = [f"setp plant.{f.name.replace('_', '-')} {getattr(self, f.name):.9g}" for f in fields(self)]
        # Neighbouring seeds must not begin alike.
        return [*lines, f"setp plant.noise-state {1 + (seed * 2654435761) % (2**32 - 2)}"]

    @property
    def delay_s(self) -> float:
        """Mean lag of the two axes behind their commands."""
        return (1.0 - 0.5 * (self.feed_forward_x + self.feed_forward_y)) / self.position_gain


def read_faults(path: Path) -> MillFaults:
    """Return faults from a TOML file, such as the ``truth.toml`` of a campaign.

    ``path``: attributes of ``MillFaults``; those that it does not name keep their value.
    Raises ``InputError`` when it cannot be read, names something else, or a value is no sensible number.
    """
    names = [f.name for f in fields(MillFaults)]
    try:
        given = read_toml(path, _MAX_COMP_BYTES)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            "the faults cannot be read", code="linuxcnc.faults", where=str(path), got=str(error)[:120]
        ) from error
    for name, value in given.items():
        low, high = _RANGES.get(name, (-1.0, 1.0))
        if name not in names or not is_number(value) or not low <= value <= high:
            raise InputError(
                "this is no fault of the simulated mill",
                code="linuxcnc.faults",
                where=str(path),
                got=f"{name[:40]} = {str(value)[:40]}",
                allowed=f"{low:g} to {high:g}" if name in names else ", ".join(names),
            )
    return MillFaults(**{name: float(value) for name, value in given.items()})


def ini_text(compensation: Mapping[str, str]) -> str:
    """Return LinuxCNC's ini file. ``compensation``: name of a compensation file in the same folder, by axis."""
    lines = [
        "[EMC]",
        "VERSION = 1.1",
        "MACHINE = dtwin-mill",
        "DEBUG = 0",
        "[DISPLAY]",
        "DISPLAY = ./no_display.sh",
        "[TASK]",
        "TASK = milltask",
        "CYCLE_TIME = 0.001",
        "[RS274NGC]",
        "PARAMETER_FILE = mill.var",
        "[EMCMOT]",
        "EMCMOT = motmod",
        "COMM_TIMEOUT = 4.0",
        "SERVO_PERIOD = 1000000",
        "[EMCIO]",
        "EMCIO = io",
        "CYCLE_TIME = 0.1",
        "TOOL_TABLE = mill.tbl",
        "[HAL]",
        "HALFILE = mill.hal",
        "HALFILE = faults.hal",
        "[TRAJ]",
        "COORDINATES = X Y Z",
        "LINEAR_UNITS = mm",
        "ANGULAR_UNITS = degree",
        "DEFAULT_LINEAR_VELOCITY = 50",
        "MAX_LINEAR_VELOCITY = 200",
        "DEFAULT_LINEAR_ACCELERATION = 1000",
        "MAX_LINEAR_ACCELERATION = 1000",
        "[KINS]",
        "KINEMATICS = trivkins coordinates=XYZ",
        "JOINTS = 3",
    ]
    limits = [f"MIN_LIMIT = {-TRAVEL_MM:g}", f"MAX_LIMIT = {TRAVEL_MM:g}"]
    for number, axis in enumerate(AXES):
        lines += [f"[AXIS_{axis}]", *limits, "MAX_VELOCITY = 200", "MAX_ACCELERATION = 1200"]
        # A fifth of speed and acceleration is kept for external offsets.
        lines += ["OFFSET_AV_RATIO = 0.2"]
        lines += [f"[JOINT_{number}]", "TYPE = LINEAR", *limits]
        lines += ["MAX_VELOCITY = 250", "MAX_ACCELERATION = 1800", "FERROR = 2", "MIN_FERROR = 1"]
        lines += ["HOME = 0", "HOME_SEARCH_VEL = 0", "HOME_LATCH_VEL = 0", "HOME_SEQUENCE = 0"]
        if axis in compensation:
            lines += [f"COMP_FILE = {compensation[axis]}", "COMP_FILE_TYPE = 1", "BACKLASH = 0"]
    return "\n".join(lines) + "\n"


def compensation_text(path: Path) -> str:
    """Return a compensation file that LinuxCNC would load as a whole.

    LinuxCNC drops what it does not understand without a word that reaches a user.

    ``path``: lines of nominal position, forward and reverse trim, in mm; comments (``#``) below them, where LinuxCNC
    has stopped.
    Raises ``InputError`` when a line is no triplet, the positions do not rise, or there are more than 256.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_COMP_BYTES + 1).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "the compensation file cannot be read", code="linuxcnc.comp", where=str(path), got=str(error)[:120]
        ) from error
    last = -float("inf")
    rows = [line for line in text.splitlines() if line.strip()]
    while rows and rows[-1].startswith("#"):
        rows.pop()
    for number, line in enumerate(rows, start=1):
        nominal = _triplet(line)
        if not last < nominal < 1e6:
            raise InputError(
                "this is no row of a compensation file",
                code="linuxcnc.comp",
                where=f"{path}, row {number}",
                got=line[:60],
                allowed="nominal forward reverse, in mm, nominal rising",
            )
        last = nominal
    if not 2 <= len(rows) <= _MOST_TRIPLETS or len(text) > _MAX_COMP_BYTES:
        raise InputError(
            "a compensation file has too few or too many rows",
            code="linuxcnc.comp",
            where=str(path),
            got=str(len(rows)),
            allowed=f"2 to {_MOST_TRIPLETS}",
        )
    return "\n".join(rows) + "\n"


def _triplet(line: str) -> float:
    try:
        nominal, forward, reverse = (float(part) for part in line.split())
    except ValueError:
        return float("nan")
    # A trim beyond a millimetre is a wrong unit.
    return nominal if max(abs(forward), abs(reverse)) <= 1.0 else float("nan")
