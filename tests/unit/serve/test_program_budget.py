"""How much of a program's error each cause makes: against sums by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_twin_exports import EFFECTS, made_twin

from dtwin.errors import InputError
from dtwin.lifecycle.program_budget import program_budget, program_text

SQUARE = """G21 G90 G17
G0 X-20 Y-20
G1 X20 Y-20 F1200
G1 X20 Y20
G1 X-20 Y20
G1 X-20 Y-20
M30
"""


def test_a_square_shows_the_scale_of_an_axis_across_half_of_its_way() -> None:
    twin, _ = made_twin([EFFECTS[1]])
    widened = tuple(replace(e, uncertainty=e.value / 10.0, at_shape=None) for e in twin.estimates)
    found = program_budget(replace(twin, estimates=widened), SQUARE, origin_mm=np.zeros(3), where="p.nc")
    (cut,) = found.causes
    # 20 ppm: 0.4 um at the sides, and from -0.4 to 0.4 um, along the way, between them.
    assert cut.rms_um["X"] == pytest.approx(np.sqrt((0.4**2 + 0.4**2 / 3.0) / 2.0), rel=1e-3)
    assert cut.rms_um["across"] == pytest.approx(0.4 / np.sqrt(2.0), rel=1e-3)
    assert cut.rms_um["Y"] == cut.rms_um["Z"] == cut.left_um == 0.0
    assert cut.largest_um == pytest.approx(0.4)
    assert cut.uncertainty_um == pytest.approx(cut.rms_um[""] / 10.0)
    assert found.length_mm == pytest.approx(160.0)
    assert found.outside == 0.0


def test_causes_may_undo_each_other_and_all_together_is_what_they_sum_to() -> None:
    twin, _ = made_twin([*EFFECTS[:3], ("reversal_spike", "X", (5.0, 5.0), {})])
    # X goes from 80 to 120 mm there; circles of 100 mm were measured.
    found = program_budget(twin, SQUARE, origin_mm=np.array([-100.0, 0.0, 0.0]), where="p.nc")
    by_label = {cut.label: cut for cut in found.causes}
    assert [cut.rms_um[""] for cut in found.causes] == sorted((c.rms_um[""] for c in found.causes), reverse=True)
    # Half of 4 um on the side that X comes from.
    assert by_label["backlash X"].rms_um[""] == pytest.approx(2.0)
    assert found.every.rms_um[""] ** 2 == pytest.approx(sum(found.every.rms_um[axis] ** 2 for axis in "XYZ"), rel=1e-9)
    alone = program_budget(
        made_twin([EFFECTS[1], EFFECTS[2]])[0], SQUARE, origin_mm=np.array([-100.0, 0.0, 0.0]), where="p"
    )
    assert by_label["backlash X"].left_um == pytest.approx(alone.every.rms_um[""])
    assert set(found.not_told) == {"reversal_spike X"}
    assert found.outside == pytest.approx(0.5)
    said = program_text(found)
    assert "all of them" in said
    assert "not in it: reversal_spike X: over before an offset has arrived" in said


def test_a_program_without_motion_at_feed_is_refused() -> None:
    twin, _ = made_twin([EFFECTS[1]])
    with pytest.raises(InputError, match="no motion at feed"):
        program_budget(twin, "G0 X1 Y1\nG0 X5\n", origin_mm=np.zeros(3), where="p.nc")
