"""One fit of several campaigns: sizes, what is shared and what is not, contradictions, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mill_and_laser import circles, laser, warmed

from dtwin.errors import InputError
from dtwin.kinds.circular._correction import _other_rows
from dtwin.machines.mill_parameters import MillParameters
from dtwin.physics._one_size import of_other_sizes
from dtwin.physics.contradictions import Contradiction, without_contradictions
from dtwin.physics.diagnose import diagnose
from dtwin.physics.effect import Instance
from dtwin.physics.fit import fit
from dtwin.physics.library import Library
from dtwin.physics.localise import residual_um
from dtwin.physics.machine_terms import machine_terms, seen_by
from dtwin.physics.observations import Observations
from dtwin.physics.problem import Term
from dtwin.physics.several import SeveralFit, fit_several
from dtwin.physics.several_diagnosis import diagnose_several
from dtwin.physics.several_sizes import covariance_in, nothing_of, sizes_of
from dtwin.physics.several_twin import SeveralTwin, several_twin_of, started_of
from dtwin.report.faults import sized_effects
from dtwin.report.twin_of_campaigns import _settled_lines
from dtwin.twins.learn import _together

LIBRARY = Library()
NAMES = (("backlash", "backlash"), ("friction", "lag"))
SCALED = MillParameters().with_axis("X", scale_ppm=30.0, play_um=3.0)


def together(campaigns: list[Observations], *names: str) -> SeveralFit:
    return fit_several(campaigns, machine_terms(names, LIBRARY, campaigns), LIBRARY)


def apart(campaigns: list[Observations], *names: str) -> tuple[SeveralFit, tuple[Contradiction, ...]]:
    days = [started_of(obs) for obs in campaigns]
    return without_contradictions(together(campaigns, *names), days)


def test_sizes_are_those_of_the_machine_and_better_known_than_by_circles_alone() -> None:
    campaigns = [circles(SCALED), laser("X", 30.0, 3.0), laser("Y", 0.0, 0.0, seed=2)]
    found = together(campaigns, "scale_mismatch", "backlash:X")
    sizes = {f"{e.effect} {e.axis}": e for e in found.estimates}
    for label, truth in (("scale_mismatch X", 30.0), ("scale_mismatch Y", 0.0), ("backlash X", 3.0)):
        assert sizes[label].value == pytest.approx(truth, abs=1.5 * sizes[label].uncertainty)
    alone = fit(campaigns[0], found.fits[0].terms).estimates
    assert sizes["backlash X"].uncertainty < min(e.uncertainty for e in alone if e.effect == "backlash")


def test_how_parameters_go_together_in_a_campaign_is_what_all_campaigns_say() -> None:
    # Circles at one feed know the sum of lost motion and friction that slides at once; a laser knows lost motion alone.
    bar, at_once = circles(SCALED), {"presliding_um": 1.5}
    bound = []
    for other in (circles(SCALED, seed=3, name="again"), laser("X", 30.0, 3.0)):
        terms = machine_terms(["scale_mismatch", "backlash:X", "friction:X"], LIBRARY, [bar, other])
        terms = [replace(t, shape={**t.shape, **at_once}) if t.label == "friction X" else t for t in terms]
        found = fit_several([bar, other], terms, LIBRARY, refine=False)
        seen = covariance_in(found, sizes_of(found), 0)
        stated = found.fits[0].estimates
        assert 2.0 * np.sqrt(np.diag(seen)) == pytest.approx([e.uncertainty for e in stated], rel=0.2)
        lost, lag = ([(e.effect, e.name) for e in stated].index(one) for one in NAMES)
        bound.append(seen[lost, lag] / np.sqrt(seen[lost, lost] * seen[lag, lag]))
    assert bound[0] < -0.99
    assert bound[1] > -0.5


def test_a_difference_of_axes_is_one_parameter_where_nobody_sees_an_axis_alone() -> None:
    bars = [circles(SCALED), circles(SCALED, seed=2, name="again")]
    assert [t.label for t in machine_terms(["scale_mismatch"], LIBRARY, bars)] == ["scale_mismatch XY"]
    lasers = [*bars, laser("X", 30.0, 3.0)]
    assert [t.label for t in machine_terms(["scale_mismatch"], LIBRARY, lasers)] == [
        "scale_mismatch X",
        "scale_mismatch Y",
    ]
    # No laser sees how fast an axis follows.
    assert [t.label for t in machine_terms(["servo_mismatch"], LIBRARY, lasers)] == ["servo_mismatch XY"]
    assert [t.label for t in machine_terms(["lead_error", "scale_mismatch:XY"], LIBRARY, lasers)] == [
        "lead_error X",
        "lead_error Y",
    ]


def test_campaigns_see_a_cause_by_the_name_that_it_has_there() -> None:
    campaigns = [circles(SCALED), laser("X", 30.0, 3.0)]
    (first, _) = machine_terms(["lead_error"], LIBRARY, campaigns)
    seen = [seen_by(first, obs, LIBRARY) for obs in campaigns]
    assert [None if t is None else t.label for t in seen] == ["scale_mismatch X", "lead_error X"]


def test_one_campaign_alone_is_fitted_as_by_itself() -> None:
    bar = circles(SCALED)
    found = together([bar], "backlash:X", "squareness")
    alone = fit(bar, found.terms)
    for one, other in zip(found.estimates, alone.estimates, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-3, abs=1e-4)
        assert one.uncertainty == pytest.approx(other.uncertainty, rel=0.25)
    assert found.fits[0].noise_floor_um == pytest.approx(alone.noise_floor_um, rel=1e-12)


def test_set_ups_and_floors_are_those_of_each_campaign() -> None:
    found = together([circles(SCALED), laser("X", 30.0, 3.0)], "backlash:X", "lead_error:X")
    assert [len(one.setups) for one in found.fits] == [1, 1]
    assert found.fits[0].noise_floor_um < found.fits[1].noise_floor_um


def test_a_test_that_knows_a_size_badly_does_not_spoil_what_another_knows_well() -> None:
    # Low waves of a circle scatter from run to run by much more than neighbouring readings do.
    wide = []
    for seed in range(4):
        campaigns = [circles(SCALED, seed), laser("X", 30.0, 3.0, 2 * seed), laser("Y", 0.0, 0.0, 2 * seed + 1)]
        both = together(campaigns, "lead_error", "backlash:X").estimates
        alone = fit(campaigns[1], machine_terms(["lead_error"], LIBRARY, campaigns[1:2], "X")).estimates
        wide.append([one.uncertainty for one in (both[0], alone[0])])
        assert (both[0].effect, both[0].axis) == (alone[0].effect, alone[0].axis) == ("lead_error", "X")
    together_ppm, alone_ppm = np.mean(wide, axis=0)
    assert together_ppm < 1.1 * alone_ppm


def test_campaigns_that_agree_contradict_nobody() -> None:
    for seed in range(4):
        campaigns = [circles(SCALED, seed), laser("X", 30.0, 3.0, seed), laser("Y", 0.0, 0.0, seed + 50)]
        assert apart(campaigns, "scale_mismatch", "backlash:X")[1] == ()


def bars_with(play: dict[str, float]) -> list[Observations]:
    return [
        circles(MillParameters().with_axis("X", play_um=um), seed=n, name=f"bar-{day}", day=day)
        for n, (day, um) in enumerate(play.items())
    ]


def test_a_change_of_the_machine_is_told_with_its_day_and_the_newer_size_is_kept() -> None:
    bars = bars_with({"2026-01-05": 2.0, "2026-02-05": 2.0, "2026-03-05": 5.0, "2026-04-05": 5.0, "2026-05-05": 5.0})
    found, (told,) = apart(bars, "backlash:X")
    assert (told.what, told.since[:10]) == ("change", "2026-03-05")
    assert abs(told.difference) == pytest.approx(3.0, abs=0.2)
    assert told.p_value < 1e-6
    assert found.estimates[0].value == pytest.approx(5.0, abs=0.2)


def test_a_test_that_those_before_and_after_it_contradict_is_mistaken() -> None:
    bars = bars_with({"2026-01-05": 2.0, "2026-02-05": 5.0, "2026-03-05": 2.0})
    found, (told,) = apart(bars, "backlash:X")
    assert (told.what, told.campaigns) == ("mistake", ("bar-2026-02-05",))
    assert told.difference == pytest.approx(3.0, abs=0.2)
    assert found.estimates[0].value == pytest.approx(2.0, abs=0.2)


def test_a_lead_that_circles_deny_names_all_that_say_so() -> None:
    bar = circles(SCALED, day="2026-01-05")
    campaigns = [bar, laser("X", 55.0, 3.0, day="2026-02-05"), laser("Y", 0.0, 0.0, day="2026-02-06")]
    _, (told,) = apart(campaigns, "scale_mismatch", "backlash:X")
    assert told.parameter == "scale"
    assert abs(told.difference) == pytest.approx(25.0, abs=2.0)
    assert {*told.campaigns, *told.others} == {"bar", "laser-X", "laser-Y"}


def test_the_mean_of_a_lead_that_is_a_curve_is_of_the_stretch_that_was_measured() -> None:
    mill = MillParameters().with_axis("X", play_um=3.0)
    campaigns = [circles(mill), laser("X", 0.0, 3.0), laser("Y", 0.0, 0.0, cubic_um=12.0)]
    found, told = apart(campaigns, "scale_mismatch", "backlash:X", "pitch_error:Y")
    assert told == ()
    leads = [e.name for e in found.estimates if (e.effect, e.axis) == ("scale_mismatch", "Y")]
    assert leads == ["scale, bar", "lead, laser-Y"]


STIFF = {"friction_mm_s2": 248.45, "play_um": 5.61}


def bar_laser_and_bar_again(step_um: float, seed: int = 10006) -> list[Observations]:
    mill = MillParameters().with_axis("X", **STIFF)
    later = mill.with_axis("X", play_um=STIFF["play_um"] + step_um)
    return [
        circles(mill, seed, "bar", "2026-01-05"),
        laser("X", 0.0, STIFF["play_um"], seed, day="2026-01-12"),
        circles(later, seed + 1, "again", "2026-03-09"),
    ]


def test_circles_that_hardly_tell_friction_from_backlash_contradict_nobody() -> None:
    # At one feed a reading that is 0.02 µm off moves 7 µm from the one to the other.
    for seed in (1, 3):
        assert apart(bar_laser_and_bar_again(0.0, seed), "friction:X", "backlash:X")[1] == ()


def test_equal_tests_still_show_a_change_whose_name_they_cannot_tell() -> None:
    (told, *_) = apart(bar_laser_and_bar_again(1.0), "friction:X", "backlash:X")[1]
    assert "backlash X" in (f"{told.effect} {told.axis}", *told.rivals)
    assert (told.since[:10], told.others) == ("2026-03-09", ("bar",))
    assert told.difference == pytest.approx(1.0, abs=0.4)
    assert told.k2 < 0.5


def bars_with_screws(*screws: tuple[float, float]) -> list[Observations]:
    return [
        circles(
            MillParameters().with_axis("X", pitch_error_um=um, pitch_mm=10.0, pitch_phase_rad=phase),
            seed,
            f"b{seed}",
            f"2026-0{seed}-05",
        )
        for seed, (um, phase) in enumerate(screws, start=1)
    ]


def test_phases_of_a_wave_are_of_each_campaign_and_its_amplitude_is_of_the_machine() -> None:
    found, told = apart(bars_with_screws((2.0, 0.0), (2.0, 2.0)), "cyclic_error:X")
    assert (found.estimates[0].name, told) == ("amplitude", ())
    assert found.estimates[0].value == pytest.approx(2.0, abs=0.2)


def test_the_size_of_what_campaigns_do_not_share_is_told_of_each() -> None:
    bars = [circles(MillParameters(cup_lobe_um=2.0), seed, f"b{seed}", f"2026-0{seed}-05") for seed in (1, 2)]
    found, told = apart(bars, "instrument_artefact")
    twin = several_twin_of(found, told, bars, name="m", version=1, action="fit", data=[{}, {}])
    ((size, *_),) = [effect["size"].split(" µm in ") for effect in sized_effects(twin)]
    assert float(size.split(" ± ")[0]) == pytest.approx(2.0, abs=0.2)
    waves = bars_with_screws((2.0, 0.0), (2.0, 2.0))
    found, told = apart(waves, "cyclic_error:X")
    (wave,) = sized_effects(several_twin_of(found, told, waves, name="m", version=1, action="fit", data=[{}, {}]))
    assert wave["value"] == pytest.approx(2.0, abs=0.2)


def test_a_screw_that_got_worse_is_a_contradiction_of_amplitudes() -> None:
    _, (told,) = apart(bars_with_screws((2.0, 0.0), (2.0, 1.0), (4.0, 2.0)), "cyclic_error:X")
    assert (told.parameter, told.campaigns, told.since[:10]) == ("amplitude", ("b3",), "2026-03-05")
    assert told.difference == pytest.approx(2.0, abs=0.3)


def test_an_effect_that_no_campaign_sees_is_refused_with_what_there_is() -> None:
    with pytest.raises(InputError) as refused:
        machine_terms(["tracking_delay"], LIBRARY, [circles(SCALED), laser("X", 30.0, 3.0)])
    assert refused.value.code == "effect.where"
    assert "sinusoidal" in str(refused.value.allowed)


def test_without_repeats_an_uncertainty_is_still_told_by_the_other_campaign() -> None:
    bar = circles(SCALED)
    once = bar.take(np.arange(2))
    found = together([once, laser("X", 30.0, 3.0)], "backlash:X", "lead_error:X")
    assert all(np.isfinite(e.uncertainty) for e in found.estimates)
    assert np.isnan(found.fits[0].noise_floor_um)


def twin_of_all(campaigns: list[Observations], *names: str) -> SeveralTwin:
    found, told = apart(campaigns, *names)
    nothing: list[dict[str, str]] = [{} for _ in campaigns]
    return several_twin_of(found, told, campaigns, name="all", version=1, action="fit", data=nothing)


def test_of_differences_that_are_all_sure_the_one_is_named_that_explains_the_others() -> None:
    # Their p-values are all next to nothing, and say how often each test was repeated.
    worn = MillParameters().with_axis("X", scale_ppm=20.0, play_um=43.0)
    mended = worn.with_axis("X", play_um=3.0)
    campaigns = [circles(worn, 5, "bar", "2026-01-05"), circles(mended, 11, "again", "2026-03-09")]
    lasers = [(24, "2026-01-13"), (34, "2026-03-10"), (14, "2026-01-12")]
    campaigns += [laser("X", 20.0, 3.0, seed, f"laser-{seed}", day) for seed, day in lasers]
    (told,) = apart(campaigns, "lead_error:X", "backlash:X")[1]
    assert ("bar",) in (told.campaigns, told.others)
    assert (told.what, told.since[:10]) == ("change", "2026-01-12")


def test_a_contradiction_is_explained_by_what_one_campaign_takes_for_another_effect() -> None:
    stiff = MillParameters().with_axis("X", friction_mm_s2=150.0, play_um=3.0)
    campaigns = [circles(stiff, 2, day="2026-01-05"), laser("X", 0.0, 3.0, 2, day="2026-01-06")]
    twin = twin_of_all(campaigns, "backlash:X")
    assert [c.effect for c in twin.contradictions] == ["backlash"]
    said = diagnose_several(twin, campaigns, LIBRARY)
    assert said.explained == {"friction X": "backlash X"}
    assert (said.verdict, said.found[0][0].label) == ("missing_effect", "friction X")
    assert twin_of_all(campaigns, "backlash:X", "friction:X").contradictions == ()


@pytest.mark.parametrize("of_both", [True, False])
def test_a_contradiction_is_not_explained_by_what_a_third_campaign_denies(of_both: bool) -> None:
    gives_way = MillParameters().with_axis("X", scale_ppm=30.0, mode_share=0.7, mode_hz=8.0)
    campaigns = [circles(gives_way, 3, day="2026-01-05"), laser("X", 30.0, 0.0, 3, day="2026-01-06")]
    campaigns += [laser("Y", 0.0, 0.0, 5, day="2026-01-07")] * of_both
    (group,) = diagnose_several(twin_of_all(campaigns, "lead_error:X"), campaigns, LIBRARY).found
    assert "structural_resonance X" in {s.label for s in group}
    # Y may be off by as much, if no laser reads it.
    assert ("scale_mismatch XY" in {s.label for s in group}) != of_both


def test_a_name_by_chance_in_one_campaign_is_not_told_where_another_denies_it() -> None:
    # The laser reads 0.13 µm of lost motion; the circles show none.
    scaled = MillParameters().with_axis("X", scale_ppm=13.29)
    campaigns = [circles(scaled, 3), laser("X", 13.29, 0.13, 302), laser("Y", 0.0, 0.0, 7)]
    twin = twin_of_all(campaigns, "lead_error:X")
    alone = diagnose(campaigns[1], twin.on("laser-X").terms, LIBRARY)
    assert [[s.label for s in group] for group in alone.found] == [["backlash X"]]
    said = diagnose_several(twin, campaigns, LIBRARY)
    assert (said.verdict, said.found) == ("nothing_missing", ())
    assert "one campaign alone would name backlash X" in said.headline


def test_a_step_at_one_place_is_passed_on_where_one_campaign_alone_measured_the_axis() -> None:
    plain = laser("X", 30.0, 3.0)
    stepped = plain.with_y(plain.y_um + 6.0 * (plain.grid.points > 250.0))
    campaigns = [circles(SCALED), stepped, laser("Y", 0.0, 0.0, 2)]
    said = diagnose_several(twin_of_all(campaigns), campaigns, LIBRARY)
    (place,) = said.places
    assert (place["effect"], place["axis"]) == ("learned_step", "X")
    learned = Term(Instance(LIBRARY[place["effect"]], "X"), place["shape"])
    fitted = fit_several(
        campaigns, [*machine_terms(["lead_error", "backlash:X"], LIBRARY, campaigns), learned], LIBRARY
    )
    (lead,) = (e for e in fitted.estimates if (e.effect, e.axis) == ("lead_error", "X"))
    assert lead.value == pytest.approx(30.0, abs=1.5 * lead.uncertainty)
    (size,) = (e for e in fitted.fits[1].estimates if e.effect == "learned_step")
    assert size.value == pytest.approx(6.0, abs=1.5 * size.uncertainty)
    again = replace(laser("X", 30.0, 3.0, 4), campaign=replace(plain.campaign, name="again"))
    both = [*campaigns, again]
    assert diagnose_several(twin_of_all(both), both, LIBRARY).places == ()


def test_a_feed_that_is_left_out_is_left_out_of_all_circles() -> None:
    bars = [circles(SCALED, feeds_mm_min=feeds, repeats=1) for feeds in ((1000.0, 2000.0), (2000.0,))]
    kept = [_other_rows(one, "circular", "feed_mm_min", 2000.0) for one in (*bars, laser("X", 30.0, 3.0))]
    assert [len(rows) for rows in kept] == [2, 0, 10]
    assert {bars[0].runs[row].feed_mm_min for row in kept[0]} == {1000.0}


def test_circles_of_several_campaigns_are_learned_from_as_one() -> None:
    first, second = circles(SCALED, name="first"), circles(SCALED, 2, "second", feeds_mm_min=(2000.0, 4000.0))
    both = _together([first, second])
    assert both.campaign.name == "first, second"
    assert len(both.conditions) == 4
    assert len(set(both.run_of.tolist())) == len(set(first.run_of.tolist())) + len(set(second.run_of.tolist()))
    # What is left is that of each, for set-ups stay apart, and a place is left out of both at once.
    left = [residual_um(obs, []) for obs in (first, second)]
    assert residual_um(both, []) == pytest.approx(np.concatenate(left), abs=1e-9)
    rows = both.place_of == both.place_of[0]
    assert {both.runs[row].feed_mm_min for row in np.flatnonzero(rows)} == {2000.0}
    assert {int(row) < first.n_rows for row in np.flatnonzero(rows)} == {True, False}


def test_what_circles_cannot_tell_stays_undecided_until_a_laser_decides_it() -> None:
    wrong = MillParameters().with_axis("X", scale_ppm=25.0, play_um=3.0)
    bars = [circles(wrong), circles(wrong, 9, "again")]
    same = diagnose_several(twin_of_all(bars, "backlash:X", "scale_mismatch"), bars, LIBRARY)
    ((own, *others),) = same.undecided
    assert own == "scale_mismatch XY"
    assert "servo_lag" in others
    assert same.next_experiment is not None
    tests = [bars[0], laser("X", 25.0, 3.0, 4), laser("Y", 0.0, 0.0, 5)]
    told = diagnose_several(twin_of_all(tests, "backlash:X", "lead_error:X"), tests, LIBRARY)
    assert told.undecided == ()
    # In the place of the lead, which a laser tells too, it would contradict that.
    assert "gravity_sag X" in told.invisible
    assert "inertial_compliance" not in told.invisible


def bars_at(mill: MillParameters, *conditions: tuple[float, float]) -> list[Observations]:
    """Tests by a ball bar, each at one radius in mm and one feed in mm/min."""
    return [
        circles(mill, 100 + n, f"bar-{n}", radii_mm=(radius_mm,), feeds_mm_min=(feed_mm_min,))
        for n, (radius_mm, feed_mm_min) in enumerate(conditions)
    ]


@pytest.mark.parametrize(
    ("mill", "conditions", "name", "other"),
    [
        (
            MillParameters().with_axis("X", scale_ppm=20.0),
            ((100.0, 1000.0), (100.0, 4000.0)),
            "scale_mismatch XY",
            "inertial_compliance",
        ),
        (
            MillParameters(cup_lobe_um=1.5, cup_phase_rad=1.0),
            ((50.0, 2000.0), (150.0, 2000.0)),
            "instrument_artefact",
            "straightness X",
        ),
    ],
)
def test_bars_at_other_conditions_rule_out_what_would_need_another_size(
    mill: MillParameters, conditions: tuple[tuple[float, float], ...], name: str, other: str
) -> None:
    bars = bars_at(mill, *conditions)
    found = diagnose_several(twin_of_all(bars), bars, LIBRARY)
    assert all(len(group) > 1 for test in found.tests for group in test.found.found)
    assert [[s.label for s in group] for group in found.found] == [[name]]
    assert other in found.ruled_out
    assert name not in found.ruled_out
    assert other in _settled_lines(found.as_dict())[-1]
    assert diagnose_several(twin_of_all(bars, name.replace(" ", ":")), bars, LIBRARY).undecided == ()


def test_a_name_by_chance_is_not_told_where_what_another_shows_explains_it() -> None:
    """Circles that hardly see a scale of 1.4 ppm took it for a step at the changeover, which no laser can see."""
    bar = circles(MillParameters().with_axis("X", scale_ppm=1.41421), 306)
    campaigns = [bar, laser("X", 1.41421, 0.0, 612), laser("Y", 0.0, 0.0, 613)]
    (shown,) = diagnose(bar, [], LIBRARY).found
    assert [s.label for s in shown] == ["axis_changeover XY"]
    said = diagnose_several(twin_of_all(campaigns), campaigns, LIBRARY)
    assert [[s.label for s in group] for group in said.found] == [["lead_error X"]]
    assert "one campaign alone would name axis_changeover XY" in said.headline


def test_sizes_that_are_uncertain_one_by_one_are_something_together() -> None:
    """Friction has two lags that look alike: 0.114 ± 0.086 and 0.025 ± 0.096 µm."""
    bar = circles(MillParameters().with_axis("X", friction_mm_s2=0.85454), 102, repeats=10)
    fitted = together([bar], "friction:X", "backlash:Y")
    of_friction = [e for e in fitted.estimates if e.effect == "friction"]
    assert all(abs(e.value) < 1.5 * e.uncertainty for e in of_friction)
    assert nothing_of(fitted) == {("backlash", "Y")}


def test_growth_that_differs_between_axes_by_chance_is_no_drift_of_the_circles() -> None:
    """What one axis grows beside both was held against what a laser shows of it; and without one growth of both a drift was left."""
    sizes = MillParameters().with_axis("X", growth_um_m_k=1.5831).with_axis("Y", growth_um_m_k=1.5831)
    tests = [circles(sizes, 314), *(warmed(axis, 314, growth_um_m_k=1.5831) for axis in "XY")]
    found = diagnose_several(twin_of_all(tests), tests, LIBRARY)
    assert {"thermal_growth", "thermal_drift"} <= {s.label for s in found.tests[0].found.found[0]}
    assert {group[0].label for group in found.found} == {"thermal_growth X", "thermal_growth Y"}


def test_what_two_bars_show_is_one_cause_though_they_begin_with_other_names() -> None:
    # Where the feed grows with the radius, a scale and what yields have one size each.
    bars = bars_at(MillParameters().with_axis("X", scale_ppm=20.0), (100.0, 1000.0), (150.0, 1500.0))
    found = diagnose_several(twin_of_all(bars), bars, LIBRARY)
    assert len({group[0].label for test in found.tests for group in test.found.found}) == 2
    (group,) = found.found
    assert {"scale_mismatch XY", "inertial_compliance"} <= {s.label for s in group}
    assert found.ruled_out == ()


def test_growth_by_a_thermometer_that_scatters_is_no_drift_beside_what_lasers_show() -> None:
    """A drift, which follows no thermometer, was the first name of what circles show, and was added to the growth of both axes."""
    bar = circles(MillParameters().with_axis("X", growth_um_m_k=10.0).with_axis("Y", growth_um_m_k=10.0))
    off = 0.02 * np.random.default_rng(6).standard_normal(len(bar.columns))
    logged = [{**c, "temperature_c": c["temperature_c"] + k} for c, k in zip(bar.columns, off, strict=True)]
    tests = [replace(bar, columns=tuple(logged)), *(warmed(axis, 1, growth_um_m_k=10.0) for axis in "XY")]
    (shown,) = diagnose(tests[0], [], LIBRARY).found
    assert shown[0].label == "thermal_drift"
    assert "thermal_growth" in {s.label for s in shown}
    found = diagnose_several(twin_of_all(tests), tests, LIBRARY).found
    assert {group[0].label for group in found} == {"thermal_growth X", "thermal_growth Y"}


def test_a_drift_that_temperature_follows_but_for_a_little_is_no_name_by_itself() -> None:
    """The circles grow with the machine, and their centre creeps a third of a micrometre: a drift alone was named."""
    bar = circles(MillParameters().with_axis("X", growth_um_m_k=10.0).with_axis("Y", growth_um_m_k=10.0))
    time_h = np.array([float(np.mean(c["time_h"])) for c in bar.columns])
    creep = 3.2 * time_h[:, None] * np.cos(np.radians(bar.grid.points))
    (shown,) = diagnose(bar.with_y(bar.y_um + creep), [], LIBRARY).found
    assert {"thermal_drift", "thermal_growth"} <= {s.label for s in shown}


def test_what_could_stand_in_the_place_of_nothing_is_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    bars = [circles(SCALED), circles(SCALED, 2, "again", feeds_mm_min=(2000.0, 4000.0))]
    asked: list[int] = []
    monkeypatch.setattr("dtwin.physics._one_size.fit_several", lambda *_: asked.append(1))
    (group,) = diagnose_several(twin_of_all(bars, "scale_mismatch", "backlash"), bars, LIBRARY).undecided
    assert group[0] == "backlash Y"
    assert len(group) > 13
    assert asked == []


def test_an_effect_that_each_test_sees_on_an_axis_of_its_own_has_no_other_size(monkeypatch: pytest.MonkeyPatch) -> None:
    lasers = [laser("X", 30.0, 3.0), laser("Y", 0.0, 0.0)]
    monkeypatch.setattr("dtwin.physics._one_size.fit_several", lambda *_: pytest.fail("nothing to compare"))
    assert of_other_sizes(["lead_error X", "backlash Y"], [], lasers, lasers[0].grid.kind, LIBRARY) == []


def test_where_others_deny_all_that_a_campaign_finds_it_is_asked_again_without_that() -> None:
    """Circles that took a drift of the bar for growth showed nothing at all, once lasers had seen no growth."""
    bar = circles(MillParameters(bar_growth_um_h=12.0))
    tests = [bar, *(warmed(axis, 1) for axis in "XY")]
    told = diagnose(bar, [], LIBRARY)
    growth = next(s for s in told.suspects if s.effect == "thermal_growth")
    mistaken = replace(told, found=((replace(growth, in_group=True, confounded_with=()),),))
    said = diagnose_several(twin_of_all(tests), tests, LIBRARY, alone=[mistaken, None, None])
    assert [s.label for group in said.found for s in group] == ["thermal_drift"]
