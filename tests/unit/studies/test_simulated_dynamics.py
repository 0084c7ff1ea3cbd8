"""What each way of taking vibration out is worth on the published machines."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from studies.dynamics_paper import LOW_PASS, PUBLISHED, Size, dynamics_paper
from studies.report.papers import dynamics_paper_text
from studies.simulated_dynamics import DIRECTIONS, TWIN_OF_FOUR, Case, simulated_machines, simulated_turn


@cache
def table() -> dict[str, Any]:
    size = Size(("sim2",), (0.0, 5.0), (1200.0, 3000.0), 4, 4)
    return dynamics_paper(size, 0, lambda *_: None)


def of(how: str, vibration_um: float) -> list[Case]:
    cases = [Case(**case) for case in table()["cases"]]
    return [c for c in cases if (c.how, c.vibration_um) == (how, vibration_um)]


@pytest.mark.parametrize(("name", "within_um"), [("sim2", 0.5), ("sim3", 1.1)])
def test_still_machines_have_the_printed_circular_deviation(name: str, within_um: float) -> None:
    machine = simulated_machines()[name]
    for way, sign in DIRECTIONS:
        turn = simulated_turn(machine, sign, 0.0, np.random.default_rng(0))
        waves = np.fft.rfft(turn.deviation_um)
        waves[1] = 0.0
        found = np.ptp(np.fft.irfft(waves, turn.readings))
        assert found == pytest.approx(machine["circular_deviation"][way.lower()], abs=within_um)


def test_the_twin_takes_next_to_nothing_out_of_a_still_machine_and_filters_do() -> None:
    assert max(c.dc3_um for c in of(TWIN_OF_FOUR, 0.0)) < 0.1
    assert min(c.dc3_um for c in of(LOW_PASS, 0.0)) > 0.15
    assert min(c.dc3_um for c in of(PUBLISHED, 0.0)) > 1.0


def test_slight_vibration_changes_little_and_all_components_rise() -> None:
    for how in (PUBLISHED, LOW_PASS, TWIN_OF_FOUR):
        shaken, still = of(how, 5.0), of(how, 0.0)
        assert max(abs(c.off_um) for c in shaken) <= 1.7
        for with_it, without in zip(shaken, still, strict=True):
            assert with_it.dc2_um > without.dc2_um
            assert with_it.dc3_um > without.dc3_um
    wrong = {how: max(abs(c.dc3_um - c.true_rms_um) for c in of(how, 5.0)) for how in (PUBLISHED, TWIN_OF_FOUR)}
    assert wrong[TWIN_OF_FOUR] < 0.2 < wrong[PUBLISHED]


def test_the_table_is_made_of_figures_that_can_be_judged() -> None:
    found = table()
    lines = {line["target"]: line for line in found["lines"]}
    assert set(lines) == {"", "A4", "A5", "A6", "A7", "A8", "A10"}
    assert lines["A4"]["answer"] == "calibrated"
    assert lines["A5"]["answer"] == "does not"
    assert lines["A6"]["answer"] == "does not"
    slow, fast = found["sweep"]
    assert fast["dc3_um"] > slow["dc3_um"]
    assert fast["dc3_um"] == pytest.approx(fast["true_dc3_um"], rel=0.3)
    text = dynamics_paper_text(found)
    assert "the paper" in text
    assert "twin of four pairs" in text
