"""Runs averaged over degrees: what of a recording counts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dtwin.physics.gridding import rows_of
from dtwin.schema import Run, RunMeta


@pytest.mark.parametrize(
    ("overshoot_deg", "fed", "first_deg"), [(2.0, 100, -17.0), (15.0, 100, -20.0), (2.0, 0, -20.0)]
)
def test_an_arc_counts_from_where_the_machine_follows(overshoot_deg: float, fed: int, first_deg: float) -> None:
    """An arc of 220 degrees at 2000 mm/min: 0.3 s from standstill are 5.7 degrees, of which the overshoot is a part."""
    step = math.degrees(2000.0 / 60.0 / 100.0) / 250.0
    angle = np.arange(-20.0 - overshoot_deg, 200.0 + overshoot_deg, step) + 0.01
    inside = np.flatnonzero((angle >= -20.0) & (angle < 200.0))
    deviation = np.concatenate([np.full(fed, 1500.0), 5.0 * np.cos(np.radians(2.0 * angle)), np.full(fed, 1500.0)])
    angle = np.concatenate([np.full(fed, angle[0]), angle, np.full(fed, angle[-1])])
    meta = RunMeta("r", plane="YZ", direction="CCW", radius_mm=100.0, feed_mm_min=2000.0, sample_rate_hz=250.0)
    samples = {"t_s": np.arange(angle.size) / 250.0, "angle_deg": angle, "deviation_um": deviation}
    run = Run(meta, samples, window=(fed + int(inside[0]), fed + int(inside[-1]) + 1))
    (row,) = rows_of(run, 0.0)
    measured = np.flatnonzero(row.mask)
    assert np.sort((measured + 20) % 360)[0] - 20 == pytest.approx(first_deg, abs=1.0)
