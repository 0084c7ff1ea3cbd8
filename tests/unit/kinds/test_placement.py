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
        (1.0, 1e-3, ["placement.units"]),
        (1.0, 0.0, ["placement.still"]),
    ],
)
def test_errors_of_another_unit_and_a_direction_without_any_are_told(x: float, y: float, codes: list[str]) -> None:
    rng = np.random.default_rng(0)
    samples = {"t_s": 60.0 * np.arange(20.0)}
    samples |= {"error_x_um": x * rng.normal(300.0, 20.0, 20), "error_y_um": y * rng.normal(-150.0, 20.0, 20)}
    found = kind_named("placement").judge_run(Run(RunMeta("a", kind="placement"), samples))
    assert [f.code for f in found] == codes


def test_a_placement_far_off_all_others_and_a_column_filled_down_are_told() -> None:
    rng = np.random.default_rng(0)
    samples = {"t_s": 60.0 * np.arange(20.0), "error_x_um": rng.normal(30.0, 8.0, 20), "error_y_um": np.full(20, 30.0)}
    samples["error_x_um"][7] = 9999.0
    found = kind_named("placement").judge_run(Run(RunMeta("a", kind="placement"), samples))
    assert [f.code for f in found] == ["placement.still", "placement.far"]
    assert "row 8 " in found[1].message
    samples["flag_1"] = np.where(np.arange(20) == 7, 1.0, 0.0)
    found = kind_named("placement").judge_run(Run(RunMeta("a", kind="placement"), samples))
    assert "placement.far" not in {f.code for f in found}
