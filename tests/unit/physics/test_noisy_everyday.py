"""A machine of the exam in everyday tests whose noise, as large as its faults, lies in the low harmonics."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from dtwin.physics.diagnose import diagnose
from dtwin.physics.library import Library
from dtwin.physics.observations import observe

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks" / "hidden_effect"))
from cases import ROWS, make_case


def test_an_effect_that_falls_does_not_pull_down_the_others() -> None:
    """What it left counted as misfit of the library, and one after the other all fell: nothing had a name."""
    case = make_case(replace(ROWS["everyday_6"], name="ev_lobes_1.0", noise="lobes", noise_um=1.0), 2)
    found = diagnose(observe(case.campaign, case.runs), [], Library()).found
    assert {group[0].label for group in found} == {"backlash_taper Y", "lateral_play_taper Y", "cyclic_error Y"}
