"""`dtwin demo tracking`: the thesis's chain on the virtual cobot says nothing that it should not."""

from __future__ import annotations

import json

import pytest

from studies.report.tracking import tracking_text
from studies.tracking_chain import tracking_chain

pytestmark = [pytest.mark.system, pytest.mark.long]


def test_the_chain_closes_no_gap_that_a_constant_would_not() -> None:
    found = json.loads(json.dumps(tracking_chain(0, repeats=2).as_dict()))
    constant = found["controls_pct"]["one constant, the mean gap of the other feeds"]
    # The published 41.3 % is far outside what the chain gives here; one constant beats it.
    assert found["reduction_pct"] + found["reduction_half_width_pct"] < 41.3
    assert constant > found["reduction_pct"] + found["reduction_half_width_pct"]
    assert len(found["feeds"]) == 5
    assert all(feed["runs"] == 4 and feed["ball_bar_floor_um"] > 0 for feed in found["feeds"])
    # Along the path it does not help beyond its interval.
    path = found["along_the_path"]
    assert path["change_um"] > -path["change_half_width_um"]
    # The real recording: half a circle shows the mounting, a whole one does not.
    real = [c for c in found["set_up"] if c["circle"].startswith("real")]
    assert [round(c["middle_half_um"]) for c in real] == [45, 36]
    assert all(abs(c["full_circle_um"]) < 6.0 for c in real)
    text = tracking_text(found)
    for part in ("what the thesis reports", "what does not follow", "not reproduced"):
        assert part in text
