"""Twins of positioning tests, on a screw made of geometry that shares no formula with the library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.errors import InputError
from dtwin.kinds.linear._plan import linear_plan
from dtwin.kinds.linear._simulate import simulate_lathe
from dtwin.physics.diagnose import diagnose
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.twin import chosen_terms, twin_of
from dtwin.schema import Campaign, Run, RunMeta

LIBRARY = Library()
PLAN = {
    "name": "z",
    "machine": "lathe",
    "axis": "Z",
    "unit": "in",
    "start": 1,
    "end": 25,
    "step": 0.025,
    "runs": 4,
    "dwell_s": 6,
    "feed_min": 20,
    "overshoot": 0.1,
    "window": 0.01,
    "axis_low": 0,
    "axis_high": 41,
    "pitch": 0.25,
}
SLOW = ["lead_error", "backlash", "pitch_error"]


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> Observations:
    """Four runs over 600 mm of a worn screw: play, wear, two flanks, a tilted nut."""
    folder = tmp_path_factory.mktemp("lathe") / "z"
    simulate_lathe(folder, plan=linear_plan(PLAN, "the test"), truth="mechanism")
    opened = open_campaign(folder)
    runs = [run for entry in opened.entries for run in opened.read(entry)[0]]
    return observe(opened.campaign, runs)


def test_the_direction_dependence_of_the_cyclic_error_is_named(worn: Observations) -> None:
    twin = fit(worn, chosen_terms([*SLOW, "screw_error"], LIBRARY, worn))
    found = diagnose(worn, twin.terms, LIBRARY)
    assert found.verdict == "missing_effect", found.headline
    assert [s.label for s in found.group] == ["screw_error_by_direction Z"]
    after = fit(worn, [*twin.terms, *chosen_terms(["screw_error_by_direction"], LIBRARY, worn)])
    assert after.rms_after_um < 0.8 * twin.rms_after_um


def test_play_and_wear_come_out_as_they_are(worn: Observations) -> None:
    names = [*SLOW, "screw_error", "screw_error_by_direction", "worn_screw"]
    found = {(e.effect, e.name): e for e in fit(worn, chosen_terms(names, LIBRARY, worn)).estimates}
    play = found["backlash", "backlash"]
    wear = found["worn_screw", "additional_backlash"]
    # 72 um of play and 16 um of wear in the machine; its wear has another shape.
    assert play.value == pytest.approx(72.0, abs=2.0)
    assert wear.value == pytest.approx(16.0, abs=2.5)
    assert abs(play.value - 72.0) < play.uncertainty < 5.0


def test_a_set_up_is_a_datum_and_nothing_else(worn: Observations) -> None:
    assert worn.grid.kind == "linear"
    assert (worn.n_setup, worn.axes, worn.planes) == (1, ("Z",), ("Z",))
    assert [str(c) for c in worn.conditions] == ["Z forward", "Z reverse"]
    moved = worn.with_y(worn.y_um + 40.0)
    terms = chosen_terms(SLOW, LIBRARY, worn)
    assert fit(moved, terms).rms_after_um == pytest.approx(fit(worn, terms).rms_after_um)


def test_without_repeats_nothing_is_named(worn: Observations) -> None:
    single = worn.take(np.flatnonzero(worn.run_of == 0))
    found = diagnose(single, chosen_terms(SLOW, LIBRARY, single), LIBRARY)
    assert found.verdict == "need_repeats"
    assert not found.group


def test_a_circle_effect_cannot_be_chosen_for_an_axis(worn: Observations) -> None:
    with pytest.raises(InputError, match="cannot act in this campaign"):
        chosen_terms(["squareness"], LIBRARY, worn)


def positioning(position_mm: list[float], axis: str = "Z", repeat: int = 1) -> Run:
    n = len(position_mm)
    samples = {
        "t_s": np.arange(n, dtype=float),
        "position_mm": np.array(position_mm),
        "direction": np.array(["forward"] * n, dtype=object),
        "error_um": np.linspace(0.0, 1.0, n),
    }
    meta = RunMeta(f"r{repeat}", kind="linear", condition={"axis": axis}, repeat=repeat)
    return Run(meta, samples)


@pytest.mark.parametrize(
    ("runs", "code"),
    [
        ([positioning([0.0, 1.0, 2.0])], "twin.targets"),
        ([positioning([k + 0.1 * r for k in range(6)], repeat=r) for r in (1, 2, 3)], "twin.targets"),
        ([positioning(list(range(6))), positioning(list(range(6)), "X", 2)], "twin.axis"),
        ([replace(positioning(list(range(6))), samples={"t_s": np.arange(6.0)})], "twin.columns"),
    ],
)
def test_tests_that_cannot_be_compared_are_refused(runs: list[Run], code: str) -> None:
    with pytest.raises(InputError) as refused:
        observe(Campaign("c", "m", kind="linear"), runs)
    assert refused.value.code == code


def test_a_wave_of_a_version_that_knew_no_curves_says_what_it_said(worn: Observations) -> None:
    twin = twin_of(
        fit(worn, chosen_terms(["pitch_error", "backlash"], LIBRARY, worn)),
        worn,
        name="z",
        version=1,
        action="fit",
        data={},
    )
    before = replace(twin, estimates=tuple(e for e in twin.estimates if not e.name.startswith("half_wave")))
    assert [len(version.values(version.terms[0])) for version in (twin, before)] == [11, 11]
    assert before.values(before.terms[0]).tolist()[:2] == twin.values(twin.terms[0]).tolist()[:2]
    assert not before.values(before.terms[0])[2:].any()
    assert before.values(before.terms[1]).tolist() == twin.values(twin.terms[1]).tolist()
    assert before.doubts == twin.doubts == ()
