"""A cable chain that no effect describes: what looks like a small part of it has no name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.machines.mill import VirtualMill
from dtwin.machines.mill_parameters import CircularTest, MillParameters, NoiseParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.schema import Floats, Run


def pulled(run: Run, um: float, at_mm: float, share: float) -> Run:
    """Return a run of a machine whose Y is pulled by a chain along X: by the place of X, and by where it goes."""
    angle = np.radians(run.samples["angle_deg"])
    x_mm, y = run.meta.radius_mm * np.cos(angle), np.sin(angle)
    going = np.tanh((4.0 if run.meta.direction == "CW" else -4.0) * y)
    aside: Floats = np.arctan((x_mm + at_mm) / 25.0) / 2.0 + share * going * np.cos(x_mm / 55.0) ** 2
    return replace(run, samples={**run.samples, "deviation_um": run.samples["deviation_um"] + um * aside * y})


@pytest.mark.long
def test_what_is_a_small_part_of_something_unknown_has_no_name() -> None:
    faults = MillParameters(squareness_um_m={"XY": 30.0}).with_axis("X", play_um=2.0)
    made = VirtualMill(faults, seed=1, noise=NoiseParameters(rms_um=0.15))
    tests = [
        CircularTest("XY", way, radius_mm, feed, repeat, "one")
        for radius_mm in (50.0, 100.0, 150.0)
        for feed in (500.0, 2000.0)
        for repeat in (1, 2)
        for way in ("CCW", "CW")
    ]
    runs = [pulled(run, 8.0, 24.6, 0.5) for run in made.measure(tests)]
    found = diagnose(observe(made.campaign(), runs), [], Library())
    named = {s.label for group in found.found for s in group}
    # What follows the place of X alone is a curve of its guideway, whatever makes it.
    assert {"backlash X"} <= named <= {"backlash X", "squareness XY", "guideway_shape X"}
    assert found.unresolved is not None
    assert found.unresolved.systematic_rms_um > 1.0
