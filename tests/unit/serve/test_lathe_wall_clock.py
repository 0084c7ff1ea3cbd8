"""Every cycle of the lathe's loop is corrected, or counted as missed."""

from __future__ import annotations

import time

import pytest

from dtwin.errors import InputError
from dtwin.kinds.linear._simulate import verification_plan
from dtwin.serve.builder import GraphBuilder
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import create_bundle
from dtwin.serve.interface import Input, Output, SafetyLimits
from studies.lathe_clock import paced


def position_bundle(*names: str) -> Bundle:
    builder = GraphBuilder()
    inputs = [builder.input(name) for name in names]
    return create_bundle(
        name="slope",
        machine="lathe",
        model_version=0,
        inputs=[Input(name, "mm", "none", 100.0, "controller", -25.0, 1250.0) for name in names],
        outputs=[Output("error_z_um", "base_z", "error")],
        tick_graph=builder.graph({"error_z_um": 0.08 * inputs[0]}),
        safety=SafetyLimits(clamp_um=200.0),
    )


def test_a_stall_is_counted_cycle_by_cycle() -> None:
    sent: dict[int, float] = {}

    def stalled(cycle: int, um: float) -> None:
        sent[cycle] = um
        if cycle == 20:
            time.sleep(0.055)

    found = paced(position_bundle("position_mm"), verification_plan(), 0.6, priority=0, send=stalled)
    assert found["cycles"] == 60
    absent = sorted(set(range(60)) - set(sent))
    # What the control's end did not get is what the loop says that it missed.
    assert len(absent) == found["missed"] >= 4
    assert {21, 22, 23, 24} <= set(absent)
    assert found["late"] >= 1
    assert found["unaccounted"] == 0
    assert sent[60] == 0.0


def test_a_correction_that_asks_for_a_direction_is_refused() -> None:
    with pytest.raises(InputError, match="remembers the play"):
        paced(position_bundle("position_mm", "direction_1"), verification_plan(), 0.1)
