"""A twin of an axis as a bundle: against the twin's own numbers, and against a slide with play."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.errors import InputError
from dtwin.kinds.linear._correction import _Flanks, _pitch_mm, _reach_mm, _test_of_runs, flanks_twin_bundle
from dtwin.kinds.linear._gates import along, positioning_gates, registered_positioning_gates, screw_metrics
from dtwin.kinds.linear._plan import linear_plan
from dtwin.kinds.linear._simulate import simulate_lathe, virtual_lathe
from dtwin.kinds.linear._training import screw_of
from dtwin.physics.effect import Effect, Instance, Law, Parameter
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term
from dtwin.physics.state import State
from dtwin.physics.twin import Twin, chosen_terms, predict_um, twin_of
from dtwin.schema import Floats
from dtwin.serve.builder import GraphBuilder
from dtwin.units import UM_PER_MM

LIBRARY = Library()
PLAN = {
    "name": "z",
    "machine": "lathe",
    "axis": "Z",
    "unit": "in",
    "start": 1,
    "end": 30.76,
    "step": 0.48,
    "runs": 3,
    "dwell_s": 6,
    "feed_min": 20,
    "overshoot": 0.1,
    "window": 0.02,
    "axis_low": 0,
    "axis_high": 41,
    "pitch": 0.25,
}
NAMES = ["lead_error", "pitch_error", "backlash", "worn_screw", "screw_error", "screw_error_by_direction"]
BOTH = (("forward", 1.0), ("reverse", -1.0))
twin_from = partial(twin_of, name="t", version=1, action="fit", data={"samples": 3})


def measured(folder: Path, **changed: object) -> Observations:
    """Return what the laser reads of a worn screw made of geometry."""
    simulate_lathe(folder, plan=linear_plan(PLAN | changed, "the test"), truth="mechanism")
    opened = open_campaign(folder)
    runs = [run for entry in opened.entries for run in opened.read(entry)[0]]
    return observe(opened.campaign, runs)


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> Observations:
    """Three runs over 760 mm, 63 targets at 25 angles of the screw."""
    return measured(tmp_path_factory.mktemp("lathe") / "z")


@pytest.fixture(scope="module")
def twin(worn: Observations) -> Twin:
    return twin_from(fit(worn, chosen_terms(NAMES, LIBRARY, worn)), worn)


def evaluated(twin: Twin, obs: Observations, position_mm: Floats, way: str) -> Floats:
    builder = GraphBuilder()
    graph = builder.graph({way: _Flanks(builder, twin, obs).limit_um(builder.input("position_mm"), way)})
    found = [graph.evaluate({"position_mm": float(x)}, {})[0][way] for x in position_mm]
    return np.array(found)


def test_both_flanks_are_what_the_twin_foretells(worn: Observations, twin: Twin, tmp_path: Path) -> None:
    # Also between the targets: another test of the same travel, which the twin did not see.
    finer = measured(tmp_path / "finer", step=0.08, runs=1)
    assert finer.grid.points[[0, -1]] == pytest.approx(worn.grid.points[[0, -1]], abs=1e-9)
    for obs in (worn, finer):
        foretold = predict_um(twin, obs)
        for way, sense in BOTH:
            row = int(np.flatnonzero(obs.sense == sense)[0])
            told = evaluated(twin, worn, obs.grid.points, way)
            assert np.abs(told - foretold[row]).max() < 1e-9
            assert np.ptp(told) > 20.0


def test_what_is_served_rests_on_the_flank_where_the_screw_is_sent(worn: Observations, twin: Twin) -> None:
    frozen = flanks_twin_bundle(twin, worn)
    assert [t.label for t in frozen.terms if t.included] == list(twin.labels)
    low, high = _reach_mm(worn)
    up = np.linspace(low, high, 400)
    served = along(frozen.bundle, np.concatenate([up, up[::-1]]))
    flanks = {way: partial(evaluated, twin, worn, way=way) for way, _ in BOTH}
    for answers, path, way in ((served[:400], up, "forward"), (served[400:], up[::-1], "reverse")):
        moved = path - flanks[way](path) / UM_PER_MM
        # The first of the way back is still inside the play.
        assert answers[5:] == pytest.approx(flanks[way](moved)[5:], abs=1e-9)
    assert all(v.passed for v in positioning_gates(frozen.bundle, _pitch_mm(worn), (low, high)))


def test_a_slide_with_play_follows_its_command_better(worn: Observations, twin: Twin) -> None:
    bundle = flanks_twin_bundle(twin, worn).bundle
    lathe = virtual_lathe("mechanism", 5)
    low, high = _reach_mm(worn)
    rng = np.random.default_rng(3)
    # Turning round anywhere, far from every sweep that the twin has seen.
    turns = np.concatenate([[low], rng.uniform(low + 2.5, high - 2.5, 25)])
    path = np.concatenate([np.linspace(a, b, 300) for a, b in pairwise(turns)])
    screw = path - along(bundle, path) / UM_PER_MM
    before, after = (lathe.slide_mm(x) - path for x in (path, screw))
    assert np.std(after) < 0.12 * np.std(before)


def test_without_the_play_no_memory_can_carry_the_flanks(worn: Observations) -> None:
    terms = chosen_terms(["lead_error", "screw_error_by_direction"], LIBRARY, worn)
    with pytest.raises(InputError, match="play that the twin foretells is negative"):
        flanks_twin_bundle(twin_from(fit(worn, terms), worn), worn)


def test_what_the_loop_is_not_told_is_left_out_by_name(worn: Observations) -> None:
    def by_feed(state: State, axis: str, shape: object) -> Floats:
        return (1e-3 * state.velocity_mm_s[axis])[:, None]

    def by_place(state: State, axis: str, shape: object) -> Floats:
        return np.cos(state.angle_rad)[:, None]

    for name, columns, told in (
        ("by_feed", by_feed, "changes with the feed"),
        ("by_place", by_place, "its place among the targets"),
    ):
        own = Effect(
            name,
            name,
            (Parameter("a", "um", 1.0),),
            columns,
            Law(1.0, 0.0, "odd"),
            *(["x"] * 6),
            kinds=("linear",),
            correctable="yes",
        )
        terms = [*chosen_terms(["backlash"], LIBRARY, worn), Term(Instance(own, "Z"), {})]
        frozen = flanks_twin_bundle(twin_from(fit(worn, terms), worn), worn)
        assert [t.included for t in frozen.terms] == [True, False]
        assert told in frozen.terms[1].how


def test_heat_needs_a_channel_that_the_loop_is_not_told(worn: Observations) -> None:
    warm = replace(worn, columns=tuple({**c, "temperature_c": 20.0 + 0.1 * i} for i, c in enumerate(worn.columns)))
    terms = chosen_terms(["backlash", "thermal_growth:Z"], LIBRARY, warm)
    frozen = flanks_twin_bundle(twin_from(fit(warm, terms), warm), warm)
    assert "temperature_c, and the loop of an axis is told its position only" in frozen.terms[1].how


def test_runs_that_do_not_show_play_or_screw_are_refused(worn: Observations, tmp_path: Path) -> None:
    up = worn.take(np.flatnonzero(worn.sense > 0.0))
    lead = chosen_terms(["lead_error"], LIBRARY, up)
    with pytest.raises(InputError, match="cannot be made of these runs"):
        flanks_twin_bundle(twin_from(fit(up, lead), up), up)
    coarse = measured(tmp_path / "coarse", step=0.5, end=31)
    with pytest.raises(InputError, match="do not show the screw"):
        flanks_twin_bundle(twin_from(fit(coarse, lead), coarse), coarse)
    # A linear scale measures the axis: there is no screw that targets would have to show, and no seam at its turns.
    scaled = replace(coarse, campaign=replace(coarse.campaign, machine_geometry={"screw_pitch_mm": 0}))
    both = [*lead, *chosen_terms(["backlash"], LIBRARY, scaled)]
    bundle = flanks_twin_bundle(twin_from(fit(scaled, both), scaled), scaled).bundle
    ends = screw_metrics(_pitch_mm(scaled), _reach_mm(scaled))
    gates = {v.gate: v.passed for v in registered_positioning_gates(bundle, ends)}
    assert gates["ends held outside of the mapped travel"]
    assert gates["no step at reversal"]
    assert not any("screw" in name for name in gates)


def test_a_correction_is_not_judged_by_one_run(worn: Observations) -> None:
    one = worn.take(np.flatnonzero(worn.run_of == 0))
    with pytest.raises(InputError, match="cannot be judged"):
        _test_of_runs(one)
    test = _test_of_runs(worn)
    with pytest.raises(InputError, match="of a screw") as refused:
        screw_of(replace(test, pitch_mm=0.0), "campaign a")
    assert "dtwin twin correct" in str(refused.value.hint)
    assert (test.forward_um.shape, test.left_out) == ((63, 3), 0)
    assert np.array_equal(test.reverse_um[:, 1], worn.y_um[(worn.run_of == 1) & (worn.sense < 0)][0])
