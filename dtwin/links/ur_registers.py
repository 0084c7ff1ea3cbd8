"""Which RTDE registers carry what between the host and the robot's program.

The input registers are those that ``ur_rtde``'s IO interface can write (18 to 22), the output
registers those that its receive interface can read (12 to 19).
"""

from __future__ import annotations

from dtwin.links import state as layout

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

RUNTIME_PLAYING = 2
RUNTIME_STOPPED = 1
SAFETY_BITS_STOPPED = 0b1111_1111_1100
"""Any of these bits of ``safety_status_bits`` means that the robot is not in normal mode."""
