"""The oracle knows the truth: it leaves little, and never more than no correction."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from dtwin.machines.cobot import CircleCondition, VirtualCobot
from dtwin.serve.interface import SafetyLimits
from dtwin.train.oracle import best_offsets, follow

CIRCLE = CircleCondition("YZ", 100.0, 6000.0, "CCW")


def rms_um(cobot: VirtualCobot, offsets_um: np.ndarray, safety: SafetyLimits) -> float:
    """RMS of the true radial error on the arc, about one centre and one radius."""
    made, _ = follow(cobot.controller(CIRCLE, setup="s", repeat=1), offsets_um, safety)
    parts = made.recording().truth.parts_um
    angle = made.recording().truth.angle_rad
    # Inside the arc, away from the in-feed and the stop.
    inside = (angle > angle.min() + 0.2) & (angle < angle.max() - 0.2)
    basis = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])[inside]
    error = (parts["joints"] + parts["structure"] + parts["correction"])[inside]
    return float(np.std(error - basis @ np.linalg.lstsq(basis, error, rcond=None)[0]))


@pytest.mark.parametrize(
    ("safety", "share"), [(SafetyLimits(clamp_um=300.0, slew_um_s=20_000.0), 0.3), (SafetyLimits(clamp_um=1e-3), 1.001)]
)
def test_little_is_left_and_never_more_than_without(safety: SafetyLimits, share: float) -> None:
    cobot = VirtualCobot(seed=5)
    begun = [partial(cobot.controller, CIRCLE, setup="o", repeat=1)]
    centre = cobot.centre_mm(CIRCLE.radius_mm)
    (found,) = best_offsets(begun, centre, cobot.parameters.controller, safety)
    assert rms_um(cobot, found, safety) <= share * rms_um(cobot, np.zeros((1, 3)), safety)
