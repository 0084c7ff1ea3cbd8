"""Circles of a machine that is written here: a square that is not one, lost motion, and a centre that wanders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from dtwin.physics._spread import unsteady
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.localise import residual_um
from dtwin.physics.observations import Observations, observe
from dtwin.physics.problem import Term
from dtwin.physics.whitening import to_harmonics
from dtwin.schema import Campaign, Direction, Floats, Run, RunMeta
from dtwin.twins.learn import _together

LIBRARY = Library()
WAYS: tuple[tuple[float, Direction], ...] = ((1.0, "CCW"), (-1.0, "CW"))
NOTHING = np.zeros(2)


def measured(
    centre_um: Callable[[float], Floats], lobes_um: float = 0.0, feeds: tuple[float, ...] = (500.0, 2000.0)
) -> Observations:
    """Return three repeats; ``centre_um``: of a run that begins after so many hours; ``lobes_um``: of seven lobes."""
    rng, runs = np.random.default_rng(4), list[Run]()
    for repeat in (1, 2, 3):
        for feed in feeds:
            for sense, way in WAYS:
                hour = len(runs) / 20.0
                angle = sense * 2.0 * np.pi * (np.arange(1440) + 0.5) / 1440
                cos, sin = np.cos(angle), np.sin(angle)
                lost_um = -np.sign(-sense * sin) * cos
                read_um = -1.5 * np.sin(2.0 * angle) + lost_um + np.stack([cos, sin], axis=1) @ centre_um(hour)
                read_um += lobes_um * np.cos(7.0 * angle + 1.0) + 0.2 * rng.standard_normal(len(angle))
                meta = RunMeta(
                    f"r{len(runs)}",
                    plane="XY",
                    direction=way,
                    radius_mm=150.0,
                    feed_mm_min=feed,
                    repeat=repeat,
                    started=f"2026-03-02T08:{3 * len(runs):02d}:00Z",
                )
                turned = {"angle_deg": np.degrees(angle) % 360.0, "deviation_um": read_um}
                runs.append(Run(meta, {"t_s": np.linspace(0.0, 9000.0 * 2.0 * np.pi / feed, 1440), **turned}))
    return observe(Campaign("written", "here"), runs)


def test_a_centre_that_wanders_costs_nothing_that_is_told() -> None:
    rng = np.random.default_rng(5)
    still, wandering = measured(lambda hour: NOTHING), measured(lambda hour: 3.0 * rng.standard_normal(2))
    assert still.wander_um == 0.0
    assert wandering.wander_um == pytest.approx(3.0, rel=0.35)
    terms = [
        Term(Instance(LIBRARY["squareness"], "XY")),
        Term(Instance(LIBRARY["backlash"], "X"), {"standstill_um": 0.1}),
    ]
    for told, truth in zip(fit(wandering, terms, refine=False).estimates, (20.0, 2.0), strict=True):
        assert abs(told.value) == pytest.approx(truth, abs=1.5 * told.uncertainty)
        assert told.uncertainty < 0.05 * truth


def test_places_that_are_left_out_leave_effects_as_they_are_elsewhere() -> None:
    rng = np.random.default_rng(5)
    whole = measured(lambda hour: 3.0 * rng.standard_normal(2))
    part = replace(whole, mask=whole.mask & (np.arange(whole.n_bins) % 90 > 5))
    lobes, bow = Instance(LIBRARY["instrument_artefact"], ""), Instance(LIBRARY["straightness"], "X")
    for instance in (lobes, bow):
        columns = part.regressors(instance, {})
        np.testing.assert_allclose(columns[part.mask], whole.regressors(instance, {})[part.mask], atol=1e-9)
        np.testing.assert_allclose(part.harmonics(instance, {}), to_harmonics(columns), atol=1e-9)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["the second wanders", "the first wanders"])
def test_tests_of_which_one_wanders_are_learned_from_without_their_centres(order: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    still = measured(lambda hour: np.array([4.0, 0.0]), feeds=(500.0,))
    tests = [still, measured(lambda hour: 3.0 * rng.standard_normal(2))]
    joined = _together([tests[number] for number in order])
    assert joined.wander_um == tests[1].wander_um > 0.0
    harmonics = to_harmonics(joined.y_um)
    np.testing.assert_allclose(harmonics[:, 1:3], 0.0, atol=1e-9)
    assert np.abs(harmonics[:, 3:5]).max() > 1.0
    assert _together([still, still]).wander_um == 0.0


def test_what_moves_a_centre_that_wanders_anyway_is_not_told() -> None:
    rng, drift = np.random.default_rng(5), LIBRARY["thermal_drift"]
    wandering = measured(lambda hour: 3.0 * rng.standard_normal(2))
    told = fit(wandering, [Term(Instance(drift), drift.start_shape)], refine=False).estimates
    assert [(e.value, e.identifiable) for e in told if e.name.startswith("shift")] == [(0.0, False)] * 3
    assert abs(told[-1].value) < 0.1


def test_a_centre_that_moves_evenly_is_a_drift_and_stays() -> None:
    still, moving = measured(lambda hour: NOTHING), measured(lambda hour: np.array([20.0 * hour, -8.0 * hour]))
    assert moving.wander_um == 0.0
    assert unsteady(moving, residual_um(moving, [])).endswith("most of it is the centre, which moves between runs")
    assert unsteady(still, residual_um(still, [])) == ""


def test_lobes_are_not_waves_of_two_axes_that_take_each_other_away() -> None:
    found = diagnose(measured(lambda hour: NOTHING, lobes_um=0.7, feeds=(1000.0,)), [], LIBRARY)
    names = {suspect.label for group in found.found for suspect in group}
    assert "squareness XY" in names
    assert not names & {"pitch_error X", "pitch_error Y", "cyclic_error X", "cyclic_error Y"}
    assert found.unresolved is not None
    assert found.unresolved.systematic_rms_um == pytest.approx(0.7 / np.sqrt(2.0), rel=0.2)


@pytest.mark.parametrize("arc", [False, True])
def test_a_set_up_that_moves_between_two_feeds_is_told(*, arc: bool) -> None:
    obs = measured(lambda hour: NOTHING)
    late = np.array([obs.conditions[c].feed_mm_min == 2000.0 for c in obs.condition_of])
    read_um = obs.y_um + np.outer(late, 12.0 * np.cos(obs.grid.phase_rad))
    seen = obs.mask & (np.arange(obs.n_bins) < (220 if arc else 360))
    left = diagnose(replace(obs, y_um=np.where(seen, read_um, 0.0), mask=seen), [], LIBRARY).unresolved
    assert left is not None
    said, to_do = left.words.split("; ")
    assert said == f"as if set-up {obs.runs[0].setup} had moved by 12 µm between its runs at 500 and 2000 mm/min"
    assert "give runs after a move" in to_do


def test_beside_a_set_up_that_moved_what_an_arc_shows_is_named() -> None:
    """On an arc effects look like a move: nothing was named, and the move was not said."""
    runs = []
    for feed, (sense, way), repeat in product((1000.0, 2000.0), WAYS, (1, 2)):
        angle = sense * np.radians(np.arange(-20.0, 200.0)[:: int(sense)] + 0.5)
        cos, sin = np.cos(sense * angle), np.sin(sense * angle)
        read_um = 6.0 * cos * sin + (5.0 * cos + 12.0 * sin) * (feed > 1500.0)
        read_um += 0.1 * np.random.default_rng(len(runs)).standard_normal(angle.size)
        meta = RunMeta(f"{len(runs)}", "circular", "YZ", way, 150.0, feed, repeat=repeat, setup="YZ")
        runs.append(Run(meta, {"angle_deg": np.degrees(sense * angle), "deviation_um": read_um}))
    found = diagnose(observe(Campaign("arcs", "mill"), runs), [], LIBRARY)
    assert [[suspect.label for suspect in group] for group in found.found] == [["squareness YZ"]]
    assert found.unresolved is not None
    assert found.unresolved.words.startswith("as if set-up YZ had moved by 13 µm between its runs at 1000 and 2000")
    (size,) = found.group[0].sizes
    assert abs(size.value + 40.0) < size.uncertainty < 0.5
