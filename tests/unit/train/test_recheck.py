"""The verdict on a champion: pairs as unit, false alarms rare, harm seen."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dtwin.errors import InputError
from dtwin.train.closed_loop import Evidence
from dtwin.train.still_helps import CheckedRun, judge, judge_evidence

CONDITIONS = (("XY", 100.0, 2000.0), ("YZ", 150.0, 5000.0), ("ZX", 100.0, 5000.0))


def runs(growth_um: dict[int, float], *, blocks: int = 3, noise_um: float = 1.0, seed: int = 0) -> list[CheckedRun]:
    rng = np.random.default_rng(seed)
    made = []
    for number, condition in enumerate(CONDITIONS):
        for direction, block, way in itertools.product(("CCW", "CW"), range(blocks), (False, True)):
            size = 30.0 + way * growth_um.get(number, growth_um.get(-1, 0.0))
            rms = size + noise_um * float(rng.standard_normal())
            made.append(CheckedRun(*condition, direction, block, way, rms))
    return made


def test_harm_in_one_condition_is_enough_and_is_named() -> None:
    found = judge(runs({-1: -15.0, 1: 6.0}))
    assert found.verdict == "worse"
    assert "YZ R150 F5000" in found.reason
    assert [c.worse for c in found.conditions] == [False, True, False, False]


def test_help_everywhere_is_said() -> None:
    found = judge(runs({-1: -15.0}))
    assert (found.verdict, found.conditions[-1].better) == ("helps", True)
    assert found.conditions[-1].growth_um == pytest.approx(-15.0, abs=1.0)


def test_no_difference_is_unclear_and_false_alarms_are_rare() -> None:
    verdicts = [judge(runs({}, seed=seed)).verdict for seed in range(300)]
    # All intervals of a check hold together with 95 %, half of the rest is on either side.
    assert verdicts.count("worse") <= 0.025 * 300 + 3 * np.sqrt(300 * 0.025)
    assert verdicts.count("unclear") > 270


def test_every_run_needs_its_partner_and_an_interval_needs_pairs() -> None:
    whole = runs({})
    with pytest.raises(InputError, match="once with and once without"):
        judge(whole[1:])
    with pytest.raises(InputError, match="too few pairs"):
        judge(runs({}, blocks=1))


def test_both_approaches_of_a_run_are_one_pair() -> None:
    told = {"before_um": 10.0, "after_um": 8.0, "before_ci_um": 0.9, "after_ci_um": 1.2, "n_with": 6}
    numbers = {"one": [0, 1, 2, 3, 4, 5], "other": [6, 7, 8, 9, 10, 11]}

    def every(*of: str) -> tuple[int, float]:
        rows = tuple({"axis": "X", "approached": str(n), **told, "runs_with": numbers[o]} for n, o in enumerate(of))
        last = judge_evidence(Evidence("real", "m", "0" * 64, {}, rows, (), 1)).conditions[-1]
        return last.pairs, last.half_width_um

    assert every("one", "one") == (6, pytest.approx(1.5))
    assert every("one", "other") == (12, pytest.approx(1.5 / np.sqrt(2.0)))
