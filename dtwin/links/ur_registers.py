"""Which RTDE registers carry what between the host and the robot's program.

The input registers are those that ``ur_rtde``'s IO interface can write (18 to 22), the output
registers those that its receive interface can read (12 to 19).
"""

from __future__ import annotations

from dtwin.links import layout

INPUT_OFFSET_X = 18
"""First of three input double registers: offset in um along base x, y, z."""

INPUT_SEQUENCE = 18
"""Input int register: changes after all three offsets have been written."""

OUTPUT_INTS: dict[int, int] = {
    12: layout.SEGMENT_ID,
    13: layout.PLANE_ID,
    14: layout.DIRECTION_SIGN,
    15: layout.APPLIED_SEQUENCE,
}
"""Output int register -> place in the robot state."""

OUTPUT_FEED = 16
"""Output int register: programmed feed in thousandths of a mm/min."""

FEED_SCALE = 1000.0

OUTPUT_DOUBLES: dict[int, int] = {
    12: layout.SEGMENT_TIME,
    13: layout.CENTRE,
    14: layout.CENTRE + 1,
    15: layout.CENTRE + 2,
    16: layout.RADIUS,
    17: layout.APPLIED,
    18: layout.APPLIED + 1,
    19: layout.APPLIED + 2,
}
"""Output double register -> place in the robot state."""

RUNTIME_STATES: dict[float, int] = {layout.RUNNING: 2, layout.STOPPED: 1, layout.PAUSED: 4}
"""``runtime_running`` -> the controller's ``runtime_state``."""

SAFETY_BITS: dict[float, int] = {
    layout.SAFE: 0b1,
    layout.PROTECTIVE_STOP: 0b100_0000_0100,
    layout.EMERGENCY: 0b100_1100_0000,
}
"""``safety_ok`` -> ``safety_status_bits`` of a controller that reports just that."""

SAFETY_MODES: dict[float, int] = {layout.SAFE: 1, layout.PROTECTIVE_STOP: 3, layout.EMERGENCY: 7}
"""``safety_ok`` -> ``safety_mode``."""

_PLAYING = 2
_PAUSING_PAUSED_RESUMING = (3, 4, 5)
_NORMAL_OR_REDUCED_BITS = 0b11
_STOPPED_BITS = 0b1111_1111_1100
_EMERGENCY_BITS = 0b0011_1110_0000


def runtime_running(runtime_state: int) -> float:
    """Return what a controller's ``runtime_state`` means: RUNNING, STOPPED or PAUSED."""
    if runtime_state == _PLAYING:
        return layout.RUNNING
    return layout.PAUSED if runtime_state in _PAUSING_PAUSED_RESUMING else layout.STOPPED


def safety_ok(status_bits: int) -> float:
    """Return what ``safety_status_bits`` mean: SAFE, PROTECTIVE_STOP or EMERGENCY.

    Recovery mode and safeguard stop count as protective stops, and so does a controller that says of
    no mode that it is in it; emergency stops of robot or system, violations and faults as emergencies.
    """
    if status_bits & _NORMAL_OR_REDUCED_BITS and not status_bits & _STOPPED_BITS:
        return layout.SAFE
    return layout.EMERGENCY if status_bits & _EMERGENCY_BITS else layout.PROTECTIVE_STOP
