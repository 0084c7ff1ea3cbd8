"""An effect of a twin that its runs cannot tell from others is said to be one of them, whoever chose it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mill_and_laser import circles, laser, measured

from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics.diagnose import diagnose
from dtwin.physics.experiment import _power, _size, next_experiment
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.observations import observe
from dtwin.physics.twin import chosen_terms, twin_of
from dtwin.physics.undecided import undecided
from dtwin.report.faults import faults, not_told
from dtwin.report.twins import parameter_table

_WRONG = MillParameters().with_axis("X", scale_ppm=25.0, play_um=3.0)
_KNOWN = ("backlash:X", "scale_mismatch")


def test_one_radius_and_feed_do_not_tell_a_scale_from_a_lag_and_say_so() -> None:
    library, obs = Library(), circles(_WRONG)
    fitted = fit(obs, chosen_terms(_KNOWN, library, obs))
    found = diagnose(obs, fitted.terms, library)
    assert found.verdict == "nothing_missing"
    ((own, *others),) = undecided(obs, fitted.terms, library)
    assert own == "scale_mismatch XY"
    assert {"servo_lag", "inertial_compliance"} <= set(others)
    said = {"undecided": [[own, *others]]}
    backlash, scale = (
        one.sentence
        for one in faults(twin_of(fitted, obs, name="mill", version=1, action="fit", data={}), said, library)
    )
    assert "do not tell it from" in scale
    assert "Inertial compliance" in scale
    assert "do not tell" not in backlash


def test_effects_of_a_twin_that_its_runs_show_alike_have_no_size_and_no_remedy() -> None:
    library, obs = Library(), circles(_WRONG)
    known = chosen_terms(("backlash:X", "friction:X", "squareness"), library, obs)
    twin = twin_of(fit(obs, known, refine=False), obs, name="mill", version=1, action="add friction", data={})
    told = {fault.effect: fault for fault in faults(twin)}
    assert [{alias["first"], alias["second"]} for alias in twin.aliases] == [{"backlash X", "friction X"}]
    assert told["backlash"].sentence.startswith("Backlash, X: these runs do not tell it from Friction, X. ")
    assert library["backlash"].remedy not in told["backlash"].sentence
    assert twin.aliases[0]["separate_by"] in told["friction"].sentence
    assert "±" in told["squareness"].size
    none, some = (
        [f.sentence for f in faults(replace(twin, estimates=[replace(e, value=size) for e in twin.estimates]))][-1]
        for size in (0.0, 1e3)
    )
    assert none.endswith("These runs do not tell it from zero.")
    assert some.endswith(library["squareness"].remedy)
    sizes = {row[:2]: row[2] for row in parameter_table(twin, in_words=False).rows}
    assert sizes["backlash X", "backlash"] == "not told"
    assert "±" in sizes["squareness XY", "squareness"]


def test_runs_that_separate_them_are_proposed_and_decide() -> None:
    library, obs = Library(), circles(_WRONG)
    known = chosen_terms(_KNOWN, library, obs)
    found = diagnose(obs, known, library)
    groups = undecided(obs, known, library)
    proposed = next_experiment(obs, known, replace(found, undecided=groups), library)
    assert proposed is not None
    assert "scale_mismatch XY" in proposed["separates"]
    more = circles(_WRONG, radii_mm=(50.0, 150.0), feeds_mm_min=(1000.0, 4000.0), repeats=2)
    assert undecided(more, chosen_terms(_KNOWN, library, more), library) == ()


def test_a_rival_of_another_shape_is_not_excluded_by_runs_that_exclude_the_first_that_is_tried() -> None:
    """Growth that is soon over is a scale at every feed: 8000 mm/min were to tell them with 100 %, as growth for ever is none."""
    library, (campaign, runs) = Library(), measured(MillParameters().with_axis("X", scale_ppm=1.0, play_um=3.0), 1)
    hourly = [replace(r, meta=replace(r.meta, started=f"2026-03-02T{8 + n:02d}:00:00")) for n, r in enumerate(runs)]
    obs = observe(campaign, hourly)
    known = chosen_terms(("backlash:X",), library, obs)
    (wanted,), (rival,) = (chosen_terms((name,), library, obs) for name in ("scale_mismatch:XY", "warming_growth:X"))
    found = _size(obs, known, wanted)
    assert found is not None
    one, two = (
        _power(obs, known, wanted, [replace(rival, shape={"settling_h": hours})], obs.conditions, *found)
        for hours in (0.15, 1e4)
    )
    assert one == two


def test_circles_that_were_measured_once_are_judged_by_the_least_noise_that_they_can_have() -> None:
    library, obs = Library(), circles(_WRONG, repeats=1)
    groups = {own: others for own, *others in undecided(obs, chosen_terms(_KNOWN, library, obs), library)}
    assert "servo_lag" in groups["scale_mismatch XY"]


def test_positions_that_were_measured_once_say_nothing() -> None:
    library, obs = Library(), laser("X", 25.0, 3.0)
    once = obs.take(np.flatnonzero(obs.run_of == 0))
    assert undecided(once, chosen_terms(("backlash:X", "lead_error:X"), library, once), library) == ()


def test_what_could_not_be_tried_is_told_by_its_reason() -> None:
    library, obs = Library(), laser("X", 25.0, 3.0)
    said = diagnose(obs, [], library).as_dict()
    assert (
        "screw_error X, screw_error_by_direction X: screw_pitch_mm is not stated in the machine's geometry"
        in not_told(said)
    )
    assert any(line.startswith("Screw error within a turn X") for line in not_told(said, library))
