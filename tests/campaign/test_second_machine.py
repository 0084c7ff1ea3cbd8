"""The second machine of the exam: nothing of dtwin's formulas, and every fault is what its name says."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest

from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms

EXAM = Path(__file__).parents[2] / "benchmarks" / "hidden_effect"
sys.path.insert(0, str(EXAM))
from second_faults import LIBRARY  # noqa: E402
from second_machine import Bench, Machine  # noqa: E402

BENCH = Bench((100.0,), (1500.0, 4000.0), repeats=2)
# The knock of a loose mass comes late at low feed, which the library's ringing does not know.
MOST_LEFT = {"reversal_ringing": 0.4}


@pytest.mark.parametrize("name", ["second_machine.py", "second_faults.py"])
def test_it_knows_of_dtwin_only_what_a_run_is(name: str) -> None:
    tree = ast.parse((EXAM / name).read_text(encoding="utf-8"))
    imports = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    imports |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert {m for m in imports if m and m.startswith("dtwin")} <= {"dtwin.schema"}


def test_a_sound_machine_shows_its_set_up_only() -> None:
    campaign, runs = BENCH.measured(Machine(), 0.001, np.random.default_rng(0))
    assert fit(observe(campaign, runs), []).rms_after_um < 0.03


@pytest.mark.parametrize("name", LIBRARY)
def test_a_fault_is_what_the_library_means_by_its_name(name: str) -> None:
    rng, library = np.random.default_rng(1), Library()
    fault = LIBRARY[name]("X", rng)
    machine = fault.change(Machine(), BENCH.sized(fault, 1.0))
    campaign, runs = BENCH.measured(machine, 0.02, rng)
    obs = observe(campaign, runs)
    before = fit(obs, []).rms_after_um
    assert before == pytest.approx(1.0, rel=0.1)
    after = fit(obs, chosen_terms([fault.label.replace(" ", ":")], library, obs)).rms_after_um
    assert after < MOST_LEFT.get(name, 0.25)
