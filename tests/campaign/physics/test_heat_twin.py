"""Twins of heat on made-up series: what is missing, what cannot be told apart, what nobody knows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.volumetric._chain import COEFFICIENTS, design
from dtwin.kinds.volumetric._heat_diagnosis import HeatDiagnosis, diagnose_heat
from dtwin.kinds.volumetric._heat_series import HeatSeries
from dtwin.kinds.volumetric._identify import Artefact, Balls
from dtwin.kinds.volumetric.heat_twin import fit_heat, heat_figures, heat_told, heat_twin_from
from dtwin.kinds.volumetric.heat_twins import HeatTwins
from dtwin.kinds.volumetric.motions import FAMILIES, family_of, heat_terms
from dtwin.kinds.volumetric.twin_report import REPORT

NOISE = 0.5
MOTIONS = ("EX0", "EXX1", "EZX2", "EXZ1")


def lasting(seed: int, n: int = 120, hours: float = 15.0) -> np.ndarray:
    """Return a temperature that wanders, of unit size, and begins at nought."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-1.0 / hours)
    out = np.zeros(n)
    for i in range(1, n):
        out[i] = keep * out[i - 1] + rng.normal(0.0, np.sqrt(1.0 - keep**2))
    return 3.0 * out


def series(driven: dict[str, np.ndarray], *, seed: int = 0, alike: float = 0.0, n: int = 120) -> HeatSeries:
    """Return motions with noise, two thermocouples on bed and ram each, and a logged tank."""
    rng = np.random.default_rng(1000 + seed)
    bed, ram, tank = (lasting(k, n) for k in (1, 2, 3))
    ram = alike * bed + (1.0 - alike) * ram
    read = {"bed_01_c": bed, "bed_02_c": 0.8 * bed, "ram_01_c": ram, "ram_02_c": 1.1 * ram}
    rise = {name: t + rng.normal(0, 0.02, n) for name, t in read.items()} | {"tank_c": tank}
    values = rng.normal(0.0, NOISE, (n, len(MOTIONS)))
    for name, motion in driven.items():
        values[:, MOTIONS.index(name)] += motion
    each = np.tile(np.eye(len(MOTIONS)), (n, 1, 1))
    return HeatSeries(
        "made",
        "mill",
        np.arange(n, dtype=float),
        MOTIONS,
        values,
        NOISE**2 * each,
        each,
        np.full(n, 0.25),
        rise,
        dict.fromkeys(rise, 20.0),
        tuple(read),
    )


def found(made: HeatSeries, *effects: str) -> HeatDiagnosis:
    return diagnose_heat(made, fit_heat(made, heat_terms(effects)), ())


BED, RAM, TANK, NOBODY = (lasting(k) for k in (1, 2, 3, 4))


def test_a_motion_that_temperatures_tell_is_missing_until_it_is_added() -> None:
    made = series({"EXX1": 2.0 * BED, "EX0": BED + RAM})
    before = found(made, "EX0")
    assert (before.verdict, [m.motion for m in before.group]) == ("missing_effect", ["EXX1"])
    assert before.group[0].bodies == ("bed",)
    assert before.as_dict()["candidates"][0]["grade"] == "law-confirmed"
    after = found(made, "EX0", before.additions[0])
    assert (after.verdict, after.movers) == ("nothing_missing", ())
    assert after.figures["rms_after_um"] < 0.5 * before.figures["rms_after_um"]
    assert after.figures["rms_after_um"] == pytest.approx(after.figures["noise_floor_um"], rel=0.05)


def test_two_bodies_that_go_together_are_not_guessed_between() -> None:
    both = found(series({"EXX1": 2.0 * BED}, alike=0.98))
    assert (both.verdict, set(both.group[0].bodies)) == ("ambiguous", {"bed", "ram"})
    assert set(both.next_experiment["heat_alone"]) == {"bed", "ram"}
    assert both.as_dict()["candidates"][0]["confounded_with"] == ["EXX1@bed", "EXX1@ram"]
    apart = found(series({"EXX1": 2.0 * BED}))
    assert (apart.verdict, apart.group[0].bodies) == ("missing_effect", ("bed",))


def test_what_no_thermocouple_tells_is_unknown_with_and_without_a_logged_cause() -> None:
    logged = found(series({"EXZ1": TANK}))
    assert (logged.verdict, logged.additions) == ("unknown_effect", ("EXZ1@tank_c",))
    silent = found(series({"EXZ1": NOBODY}))
    assert (silent.verdict, silent.additions) == ("unknown_effect", ())
    assert silent.group[0].motion == "EXZ1"
    assert silent.next_experiment["watch"] == ["EXZ1"]
    added = found(series({"EXZ1": TANK}), "EXZ1@tank_c")
    assert added.verdict == "nothing_missing"


def test_a_motion_of_the_twin_that_lacks_a_temperature_gets_it() -> None:
    made = series({"EXX1": BED + RAM})
    lacking = found(made, "EXX1@bed")
    assert lacking.verdict == "missing_effect"
    assert lacking.group[0].in_twin
    assert "lacks temperatures" in lacking.headline
    assert set(lacking.group[0].sensors) <= {"ram_01_c", "ram_02_c", "bed_01_c", "bed_02_c"}
    assert found(made, "EXX1").verdict == "nothing_missing"


def test_thermocouples_that_differ_by_number_alone_are_told_by_name() -> None:
    made = series({"EXX1": 2.0 * BED})
    named = dict(zip((f"t{n}_c" for n in range(1, 5)), (made.rise_c[name] for name in made.thermocouples), strict=True))
    said = found(replace(made, rise_c=named, begun_c=dict.fromkeys(named, 20.0), thermocouples=tuple(named)))
    text = REPORT.diagnosis_text("t", said.as_dict())
    assert "t1_c to t4_c are of one body by their names" in text
    assert {"t1_c", "t2_c"} & set(text.split())
    assert "of one body" not in REPORT.diagnosis_text("t", found(made).as_dict())


def with_room(made: HeatSeries, room: np.ndarray) -> HeatSeries:
    return replace(
        made,
        rise_c={**made.rise_c, "room_01_c": room},
        begun_c={**made.begun_c, "room_01_c": 20.0},
        thermocouples=(*made.thermocouples, "room_01_c"),
    )


def test_what_only_rises_beside_a_cause_is_told_as_no_cause_and_taken_as_no_input() -> None:
    hours = np.arange(120.0)
    settles = 2.0 * (1.0 - np.exp(-hours / 40.0))
    made = with_room(series({"EXX1": 2.0 * BED + settles, "EX0": settles}), 0.04 * hours)
    said = {m.motion: m for m in found(made).movers}
    assert (tuple(said["EXX1"].alike), said["EXX1"].as_time) == (("bed",), ("room",))
    assert (said["EX0"].sensors, said["EX0"].as_time) == ((), ("room",))
    told = found(with_room(series({"EX0": settles}), 0.04 * hours))
    assert (told.verdict, told.additions) == ("ambiguous", ())
    assert {label for c in told.as_dict()["candidates"] for label in c["confounded_with"]} == {"time alone"}
    assert "so does time alone" in told.headline
    # A user may know better.
    (model,) = fit_heat(made, heat_terms(["EX0@room"])).models
    assert model.sensors == ("room_01_c",)
    logged = with_room(series({"EX0": 1.5 * settles}), 0.04 * hours)
    (mover,) = found(replace(logged, thermocouples=logged.thermocouples[:-1])).movers
    assert (mover.channel, mover.as_time, mover.told) == (None, ("room_01_c",), True)


def test_a_room_that_wanders_by_itself_is_hardly_ever_a_cause_of_what_no_thermocouple_tells() -> None:
    told = 0
    for seed in range(40):
        walk = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.3, 120))
        made = with_room(series({"EX0": BED + lasting(200 + seed, hours=60.0)}, seed=seed), walk - walk[0])
        told += any("room" in m.alike for m in found(made).movers if m.told)
    assert told <= 1


def test_noise_alone_is_not_taken_for_a_motion() -> None:
    verdicts = [found(series({}, seed=seed)).verdict for seed in range(40)]
    assert verdicts.count("nothing_missing") >= 39


def test_a_motion_below_a_quarter_of_the_floor_is_told_but_does_not_count() -> None:
    warm = lasting(1, 900)
    small = found(series({"EXX1": 0.22 * warm / warm.std()}, n=900))
    assert (small.verdict, small.quiet) == ("nothing_missing", ("EXX1",))
    assert 1.0 < small.figures["rms_after_um"] / small.figures["noise_floor_um"] < 1.05


def test_what_only_the_motions_together_show_is_told_with_its_size_and_p() -> None:
    alike = NOISE**2 * np.where(np.eye(len(MOTIONS)), 1.0, 0.9)
    noise = np.random.default_rng(5).multivariate_normal(np.zeros(len(MOTIONS)), alike, 120)
    moves = np.outer(NOBODY / NOBODY.std(), [1.0, -1.0, 1.0, -1.0])
    still = replace(series({}), values=noise, covariance=np.tile(alike, (120, 1, 1)), left_ms_um2=np.full(120, 0.01))
    less, said = (found(replace(still, values=noise + um * moves)) for um in (0.18, 0.26))
    assert (said.verdict, said.additions) == ("unknown_effect", ())
    assert {m.motion for m in said.group} == {"EXX1", "EXZ1"}
    assert all(0.1 < m.seen_um < 0.6 for m in said.group)
    left = f"{said.figures['systematic_rms_um']:.2g} µm more than noise at the balls (p {said.lack_of_fit_p:.1g})"
    assert f"all motions together leave {left}" in said.headline
    assert less.verdict == "nothing_missing"
    assert f"(p {less.lack_of_fit_p:.1g})" in less.headline
    assert "together" not in found(still).headline


def test_hours_left_out_have_no_part_in_the_choice_of_bodies() -> None:
    made = series({"EX0": BED + RAM})
    motion, span = made.values[:, 0], made.spans()[1]
    other = motion.copy()
    other[span] = 40.0 * NOBODY[span]
    told = [made.driven("EX0", one).expected[span] for one in (motion, other)]
    assert np.array_equal(*told)
    assert made.driven("EX0", other).model.sensors != made.driven("EX0", motion).model.sensors


def test_a_motion_that_lasts_is_not_given_a_cause_by_chance() -> None:
    said = [found(series({"EXZ1": lasting(100 + seed)}, seed=seed)) for seed in range(60)]
    assert {d.verdict for d in said} <= {"unknown_effect", "missing_effect", "ambiguous"}
    assert sum(bool(d.additions) for d in said) <= 1


def test_hours_left_out_cost_more_than_hours_fitted_and_days_add_up() -> None:
    made = series({"EXX1": BED + 0.5 * NOBODY, "EX0": RAM})
    terms = heat_terms(["EXX1", "EX0"])
    told = heat_told(made, terms)
    figures = told["figures"]
    assert figures["held_out_rms_um"] > figures["rms_after_um"] > figures["noise_floor_um"]
    total = sum(d["cycles"] * d["rms_after_um"] ** 2 for d in told["by_condition"])
    assert np.sqrt(total / 120) == pytest.approx(figures["rms_after_um"])
    head = {"twin": "t", "version": 1, "machine": "m", "campaign": "c", "action": "fit"}
    again = heat_twin_from(json.loads(json.dumps({**head, **told})))
    assert np.array_equal(again.expected(made), fit_heat(made, terms).expected)
    assert again.terms == terms
    assert not again.outside(made)


def test_the_uncertainty_counts_the_cycles_that_are_independent() -> None:
    def spread(extra: np.ndarray) -> float:
        made = series({"EXX1": BED + extra})
        (only,) = heat_told(made, heat_terms(["EXX1@bed_01_c"]))["parameters"]
        return float(only["uncertainty"])

    white = np.random.default_rng(7).normal(0.0, NOBODY.std(), 120)
    assert spread(NOBODY) > 1.5 * spread(white)


def test_what_balls_leave_and_what_motions_leave_add_up() -> None:
    rng = np.random.default_rng(11)
    strokes = {"x": (30.0, 1460.0), "y": (50.0, 1200.0), "z": (460.0, 1490.0)}
    low, high = np.array([strokes[axis] for axis in "xyz"]).T
    place = rng.uniform(low, high, (60, 3))
    pose = np.repeat(np.arange(5), 12)
    balls = Balls(place, np.zeros((60, 3)), pose, np.tile(np.arange(12), 5))
    artefact = Artefact(strokes, pose_repeat_um=1.5)
    truth, other = rng.normal(0.0, 5.0, (2, 24))
    moved = artefact.predicted_um(balls, truth) + rng.normal(0.0, 1.0, (60, 3))
    settled = artefact.settle(balls, moved)
    unit = design(place, strokes, COEFFICIENTS).reshape(-1, 24)
    whole = settled.moved_um.ravel() - unit @ other
    rest = settled.moved_um.ravel() - unit @ settled.values
    apart = settled.values - other
    assert whole @ whole == pytest.approx(rest @ rest + apart @ (unit.T @ unit) @ apart)
    assert np.abs((settled.values - truth) / np.sqrt(np.diag(settled.covariance))).max() < 5.0
    with pytest.raises(InputError):
        Artefact(strokes, held_out=(2,)).settle(balls, moved)


@pytest.mark.parametrize("noise_um", [0.2, 3.0])
def test_how_strongly_places_are_held_is_by_the_noise_of_this_probe(noise_um: float) -> None:
    rng = np.random.default_rng(12)
    strokes = {"x": (30.0, 1460.0), "y": (50.0, 1200.0), "z": (460.0, 1490.0)}
    low, high = np.array([strokes[axis] for axis in "xyz"]).T
    pose = np.repeat(np.arange(9), 14)
    middle = rng.uniform(low + 250.0, high - 250.0, (9, 3))
    place = middle[pose] + rng.uniform(-250.0, 250.0, (126, 3))
    balls = Balls(place, np.zeros((126, 3)), pose, np.tile(np.arange(14), 9))
    moved = []
    for _ in range(40):
        shift, turn = rng.normal(0.0, 1.5, (2, 9, 3)) * (np.arange(9) > 0)[:, None]
        stood = shift[pose] + np.cross(turn[pose], 1e-3 * (place - middle[pose]))
        moved.append((balls, stood + rng.normal(0.0, noise_um, (126, 3))))
    artefact = Artefact(strokes, pose_repeat_um=1.5).with_noise_of(moved)
    assert artefact.noise_um == pytest.approx(noise_um, rel=0.1)
    settled = [artefact.settle(*one) for one in moved]
    off = np.array([one.values / np.sqrt(np.diag(one.covariance)) for one in settled])
    assert 0.85 < np.sqrt(np.mean(off**2)) < 1.15


def test_figures_without_a_twin_are_the_error_itself() -> None:
    made = series({"EXX1": BED})
    figures = heat_figures(made, made.values)
    assert figures["rms_before_um"] == figures["rms_after_um"]
    assert figures["noise_floor_um"] == pytest.approx(np.sqrt(0.25 + 4 * NOISE**2))


def test_names_of_motions_and_families() -> None:
    assert [t.motion for t in heat_terms(["axis_expansion"])] == ["EXX1", "EZZ1", "EYY1"]
    assert [t.motion for t in heat_terms(["axis_expansion:x"])] == ["EXX1"]
    assert [t.motion for t in heat_terms(["guideway_bending"], "Y")] == ["EZY2", "EXY2"]
    (term,) = heat_terms(["EXZ1@tank_c + bed"])
    assert (term.label, term.axis) == ("EXZ1@bed+tank_c", "Z")
    assert {family_of(m).name for m in COEFFICIENTS} == set(FAMILIES)
    assert family_of("ECX1").name == "carriage_turning"
    for wrong, code in (
        (["EXX1", "EXX1@bed"], "twin.effect_twice"),
        (["backlash"], "twin.effect"),
        (["rigid_turn:X"], "twin.effect_axis"),
    ):
        with pytest.raises(InputError) as caught:
            heat_terms(wrong)
        assert caught.value.code == code


def test_too_few_cycles_are_refused() -> None:
    with pytest.raises(InputError) as caught:
        fit_heat(series({}, n=12), ())
    assert caught.value.code == "volumetric.cycles"


def test_motions_that_are_missing_together_are_findings_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = series({"EXX1": 2.0 * BED, "EZX2": 3.0 * RAM})
    shelf = HeatTwins(Home(tmp_path))
    monkeypatch.setattr(
        HeatTwins,
        "_store",
        lambda self, name, loaded, terms, action, base: SimpleNamespace(name="t", terms=terms, version=2),
    )
    monkeypatch.setattr(
        HeatTwins, "newest", lambda self, name: SimpleNamespace(name="t", terms=(), version=1, campaign="c")
    )
    monkeypatch.setattr(HeatTwins, "loaded", lambda self, campaign: made)
    monkeypatch.setattr(
        HeatTwins, "_diagnosed", lambda self, twin, loaded: diagnose_heat(loaded, fit_heat(loaded, twin.terms), ())
    )
    _, groups, last = shelf.discover("t")
    assert sorted(len(group) for group in groups) == [1, 1]
    assert {group[0].partition("@")[0] for group in groups} == {"EXX1", "EZX2"}
    assert last.verdict == "nothing_missing"
