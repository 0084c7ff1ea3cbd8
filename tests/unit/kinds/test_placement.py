"""Tables of placements: what another unit and a direction that was not measured look like."""

from __future__ import annotations

import numpy as np
import pytest

from dtwin.kinds.registry import kind_named
from dtwin.schema import Run, RunMeta


@pytest.mark.parametrize(
    ("x", "y", "codes"),
    [
        (1.0, 1.0, []),
        (1e-3, 1e-3, ["placement.units"]),
        (1e4, 1.0, ["placement.units"]),
        (1.0, 0.0, ["placement.still"]),
    ],
)
def test_errors_of_another_unit_and_a_direction_without_any_are_told(x: float, y: float, codes: list[str]) -> None:
    rng = np.random.default_rng(0)
    samples = {"t_s": 60.0 * np.arange(20.0)}
    samples |= {"error_x_um": x * rng.normal(300.0, 20.0, 20), "error_y_um": y * rng.normal(-150.0, 20.0, 20)}
    found = kind_named("placement").judge_run(Run(RunMeta("a", kind="placement"), samples))
    assert [f.code for f in found] == codes
