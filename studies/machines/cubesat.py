"""A demonstration part: an end cap of a small satellite that is loaded, milled and unloaded.

Targets are the published ones. The part is 2 mm of wall with 1 mm of stock on its inner faces,
milled in four quarters with a turn of the table between them; the program itself is not published,
so the path of one quarter is ours.

Source: the thesis from which this project starts.
"""

from __future__ import annotations

import numpy as np

LOAD_SAFE_MM = np.array([-642.966, 164.140, 199.253])
LOAD_MM = np.array([-664.047, 163.062, 89.076])
PLACE_SAFE_MM = np.array([-676.419, -0.746, 184.281])
PLACE_MM = np.array([-680.035, -0.756, 147.350])
CLEAR_MILL_MM = np.array([-293.299, -11.747, 236.222])
HOLD_S = 25.0
LOAD_POSITION_MM = np.array([-114.65, 0.0])
"""X and Y of the mill for loading and unloading."""
ROBOT_FEED_MM_MIN, MILL_FEED_MM_MIN = 3000.0, 500.0
QUARTER_MM = np.array([[0.0, 47.0], [47.0, 47.0], [47.0, 0.0]])
"""Inner corner of one quarter, from the middle of the cap."""
C_DEG = (0.0, 90.0, 180.0, 270.0)
