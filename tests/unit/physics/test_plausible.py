"""Values that no machine can have are findings, not results."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.physics._plausible import implausible
from dtwin.physics.effect import Instance
from dtwin.physics.library import Library
from dtwin.physics.problem import Term

LIBRARY = Library()
USUAL = {"duration_ms": 60.0, "rise_ms": 1.0, "presliding_um": 0.2, "speed_exponent": 0.0}


@pytest.mark.parametrize(
    ("shape", "values", "said"),
    [
        ({}, (5.0, -4.0), ""),
        ({}, (-3.6e9, 5.0), "height_at_positive_end of -3.6e+09 um is more than 1000"),
        ({"duration_ms": 1.0}, (5.0, 5.0), "duration_ms of 1 ms lies at a limit"),
        ({"duration_ms": 2500.0}, (5.0, 5.0), "duration_ms of 2500 ms lies at a limit"),
        # A spike that rises at once is a spike.
        ({"rise_ms": 1e-6}, (5.0, 5.0), ""),
    ],
)
def test_a_value_or_shape_at_its_limit_is_said(shape: dict[str, float], values: tuple[float, float], said: str) -> None:
    term = Term(Instance(LIBRARY["reversal_spike"], "X"), USUAL | shape)
    found = implausible([term], np.array(values), on_circles=True).get("reversal_spike X", "")
    assert said in found
    assert bool(said) == bool(found)


@pytest.mark.parametrize(
    ("play_um", "standstill_um", "long"), [(0.3, 12.0, False), (60.0, 90.0, False), (8.0, 40.0, True)]
)
def test_a_table_stands_still_for_about_its_play(play_um: float, standstill_um: float, long: bool) -> None:
    term = Term(Instance(LIBRARY["backlash"], "X"), {"standstill_um": standstill_um})
    assert bool(implausible([term], np.array([-play_um]), on_circles=True)) == long


def test_a_drift_that_does_not_settle_is_told() -> None:
    """Its time constant begins at its limit."""
    drift = LIBRARY["thermal_drift"]
    steady = drift.start_shape["settling_h"]
    # The clock of a table of an axis may be assumed.
    for settling_h, on_circles, is_at_limit in ((steady, True, False), (steady, False, True), (0.05, True, True)):
        term = Term(Instance(drift, ""), {"settling_h": settling_h})
        assert bool(implausible([term], np.ones(len(drift.parameters)), on_circles=on_circles)) == is_at_limit
