"""What runs say of a correction, which runs may say it, and of what kind they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop import BEGIN, MACHINE, WITHOUT, circles, copied, in_lake, served, small_bundle, turns

from dtwin.config import Home
from dtwin.errors import DtwinError, GateRefusal, InputError
from dtwin.lake.store import Lake
from dtwin.report.campaign import evidence_advice
from dtwin.schema import Campaign, Run, RunMeta
from dtwin.train.closed_loop import Evidence, EvidenceRun, evidence_of_runs
from dtwin.train.evidence_record import _Gathered, gathered
from dtwin.train.oracle import MeasuredWays

BUNDLE = small_bundle()
SHA = BUNDLE.model_sha256


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path / "home")


def said(runs: list[Run]) -> Evidence:
    return MeasuredWays(tuple(runs), "machine clock").evidence(MACHINE, SHA)


def code(runs: list[Run]) -> str:
    with pytest.raises(DtwinError) as refused:
        said(runs)
    assert refused.value.exit_code == 3
    return refused.value.code


def found(home: Home, without: str, with_: str, *, virtual: bool = False) -> _Gathered:
    campaigns = {"without": [without], "with": [with_]}
    return gathered(home, MACHINE, SHA, campaigns, virtual=virtual)  # type: ignore[arg-type]


def test_before_and_after_with_the_run_as_unit() -> None:
    evidence = said(circles(turns(BUNDLE)))
    (condition,) = evidence.conditions
    assert condition["before_um"] == pytest.approx(12.0, rel=0.03)
    assert condition["after_um"] == pytest.approx(4.0, rel=0.05)
    assert (condition["n_without"], condition["n_with"], evidence.switches) == (6, 6, 5)
    assert condition["better"]
    assert not condition["worse"]
    # Size differs by 2 % from run to run, each sample by half a micrometre.
    assert condition["before_ci_um"] < 0.6
    assert 0.4 < condition["floor_um"] < 0.8


def test_intervals_come_from_runs_not_from_samples() -> None:
    """Few runs of many samples know as little as few runs of few."""
    few = said(circles(turns(BUNDLE), noise_um=0.0)).conditions[0]
    assert few["before_ci_um"] > 0.05


def test_harm_is_worse() -> None:
    harm = said(circles(turns(BUNDLE), before_um=4.0, after_um=12.0))
    assert harm.conditions[0]["worse"]
    assert "will refuse: worse at XY" in evidence_advice(harm.as_dict(), "2", MACHINE)
    assert evidence_advice(said(circles(turns(BUNDLE))).as_dict(), "2", MACHINE).startswith("next: dtwin promote 2")


def test_no_effect_is_neither_and_false_alarms_are_rare() -> None:
    verdicts = [said(circles(turns(BUNDLE), before_um=5.0, after_um=5.0, seed=s)).conditions[0] for s in range(150)]
    # Two 95 % intervals added in squares: one in twenty at most, half of them to either side.
    assert sum(c["worse"] for c in verdicts) <= 0.025 * 150 + 3 * np.sqrt(150 * 0.025)
    assert sum(c["better"] for c in verdicts) <= 0.025 * 150 + 3 * np.sqrt(150 * 0.025)


def test_the_mounting_is_taken_out_but_a_radius_that_follows_the_feed_is_an_error() -> None:
    slow, fast = circles(turns(BUNDLE)), circles(turns(BUNDLE), feed_mm_min=4000.0, seed=1)

    def moved(run: Run, radius_um: float) -> Run:
        angle = np.radians(run.samples["angle_deg"])
        centre = 40.0 * np.cos(angle) - 25.0 * np.sin(angle)
        deviation = run.samples["deviation_um"] + centre + radius_um
        return replace(run, samples={**run.samples, "deviation_um": deviation})

    shifted = said([moved(run, 30.0) for run in (*slow, *fast)])
    plain = said([*slow, *fast])
    for one, other in zip(shifted.conditions, plain.conditions, strict=True):
        assert one["before_um"] == pytest.approx(other["before_um"], rel=1e-6)
    grown = said([*slow, *(moved(run, -20.0) for run in fast)])
    assert all(c["after_um"] > 9.0 for c in grown.conditions)


def test_too_few_runs_are_refused() -> None:
    assert code(circles(turns(BUNDLE, 1))) == "evidence.few"
    assert code(circles(turns(BUNDLE), directions=("CCW",))[:5]) == "evidence.few"
    one_way = [r for r in circles(turns(BUNDLE)) if r.meta.correction or r.meta.direction == "CW"]
    only_cw = said(one_way)
    # What was run one way only is not compared: a direction is a part of the condition.
    assert only_cw.conditions[0]["n_with"] == 3


def test_copies_of_a_run_do_not_count_twice() -> None:
    runs = circles(turns(BUNDLE, 2))
    again = circles(turns(BUNDLE, 1), seed=7, begin=BEGIN.replace(hour=10), directions=("CCW",))
    whole = said([*runs, *(replace(r, meta=replace(r.meta, run_id=f"x{k}")) for k, r in enumerate(again))])
    assert whole.conditions[0]["n_with"] == 5
    faked = [*runs, *(copied(run, f"copy-{k}") for k, run in enumerate(runs))]
    honest = said(runs)
    evidence = said(faked)
    assert evidence.conditions == honest.conditions
    assert sum("is a copy of" in line for line in evidence.told) == len(runs)
    few = circles(turns(BUNDLE, 1))
    assert code([*few, *(copied(run, f"copy-{k}") for k, run in enumerate(few))]) == "evidence.few"


def test_ways_that_follow_each_other_are_refused() -> None:
    assert code(circles([WITHOUT] * 3 + [SHA] * 3)) == "evidence.turns"
    assert code(circles([SHA] * 3 + [WITHOUT] * 3)) == "evidence.turns"
    turned = circles([WITHOUT, SHA, SHA, WITHOUT] * 2)
    assert said(turned).switches == 4
    untold = [replace(run, meta=replace(run.meta, started="")) for run in turned]
    assert code(untold) == "evidence.time"
    same = [replace(run, meta=replace(run.meta, started=BEGIN.isoformat())) for run in turned]
    assert code(same) == "evidence.turns"


def test_what_was_run_one_way_only_is_told_and_not_counted() -> None:
    more = circles([WITHOUT] * 3, feed_mm_min=3000.0, seed=3)
    evidence = said([*circles(turns(BUNDLE)), *more])
    assert [c["feed_mm_min"] for c in evidence.conditions] == [1000.0]
    assert "not counted, because run only without: XY R50 F3000" in evidence.told
    assert len(evidence.runs) == 12
    with pytest.raises(GateRefusal, match="no condition was run both"):
        said([*circles([SHA] * 3), *more])


def test_runs_say_themselves_which_way_they_were_measured(home: Home) -> None:
    runs = circles(turns(BUNDLE))
    in_lake(home, "both", runs, virtual=True)
    ways = ["with" if run.meta.correction else "without" for run in runs]
    assert [r.way for r in found(home, "both", "both").runs] == ways
    with pytest.raises(GateRefusal, match="not measured without this correction"):
        gathered(home, MACHINE, SHA, {"without": ["both"]}, virtual=True)
    with pytest.raises(GateRefusal, match="not measured with this correction"):
        gathered(home, MACHINE, SHA, {"with": ["both"]}, virtual=True)
    with pytest.raises(GateRefusal) as other:
        gathered(home, MACHINE, "0" * 64, {"with": ["both"]}, virtual=True)
    assert other.value.code == "evidence.with"
    with pytest.raises(GateRefusal) as named_twice:
        gathered(home, MACHINE, "0" * 64, {"without": ["both"], "with": ["both"]}, virtual=True)
    assert (named_twice.value.code, named_twice.value.allowed) == ("evidence.with", "runs under 000000000000")


def test_a_campaign_that_says_corrected_but_not_by_what_is_no_reference(home: Home) -> None:
    campaign = Campaign("after", MACHINE, machine_geometry={"virtual": True, "corrected": True})
    Lake(home.lake).commit(campaign, circles([WITHOUT] * 3))
    with pytest.raises(GateRefusal, match="no run says which"):
        gathered(home, MACHINE, SHA, {"without": ["after"]}, virtual=True)


def test_a_run_under_a_correction_marks_its_campaign(home: Home) -> None:
    in_lake(home, "plain", circles([WITHOUT] * 2))
    in_lake(home, "mixed", circles(turns(BUNDLE)))
    lake = Lake(home.lake)
    assert "corrected" not in lake.campaign("plain").machine_geometry
    assert lake.campaign("mixed").machine_geometry["corrected"] is True
    assert {row["correction"] for row in lake.runs("mixed")} == {"", SHA}


def test_runs_of_another_machine_are_refused(home: Home) -> None:
    Lake(home.lake).commit(Campaign("theirs", "mill-b"), circles(turns(BUNDLE)))
    with pytest.raises(InputError, match="another machine"):
        found(home, "theirs", "theirs")


def test_spoilt_runs_are_left_out_and_told(home: Home) -> None:
    from dtwin.schema import Finding

    runs = circles(turns(BUNDLE))
    runs[0] = replace(runs[0], findings=(Finding("arc.gap", "error", "half of it is missing"),))
    in_lake(home, "c", runs, virtual=True)
    assert len(found(home, "c", "c").runs) == 11
    assert "not counted: c/f1000-01 is spoilt" in found(home, "c", "c").told


def test_a_real_machine_needs_the_journal_for_every_run(home: Home) -> None:
    runs = circles(turns(BUNDLE))
    with_ = [run for run in runs if run.meta.correction]
    in_lake(home, "real", runs)

    def refused() -> str:
        with pytest.raises(DtwinError) as caught:
            found(home, "real", "real")
        return caught.value.render()

    assert "the journal does not say" in refused()
    path = served(home, SHA, with_[:-1])
    assert "nothing was served" in refused()
    path.unlink()
    served(home, "f" * 64, with_)
    assert "ffffffffffff was served" in refused()
    path.unlink()
    served(home, SHA, with_, mode="shadow")
    assert "nothing was served" in refused()
    path.unlink()
    served(home, SHA, with_)
    assert found(home, "real", "real").kind == "real"
    served(home, SHA, [runs[0]])
    assert "served during a run without" in refused()


def test_a_correction_that_ended_within_a_run_is_refused(home: Home) -> None:
    runs = circles(turns(BUNDLE))
    in_lake(home, "real", runs)
    with_ = [run for run in runs if run.meta.correction]
    served(home, SHA, with_[:-1])
    served(home, SHA, with_[-1:], lasts_s=3.0, ends="link_lost")
    with pytest.raises(InputError, match="during a part of the run only"):
        found(home, "real", "real")


@pytest.mark.parametrize("where", ["version", "campaign", "journal"])
def test_nothing_virtual_gives_real_evidence(home: Home, where: str) -> None:
    runs = circles(turns(BUNDLE))
    in_lake(home, "c", runs, virtual=where == "campaign")
    device = "virtual" if where == "journal" else "real"
    served(home, SHA, [run for run in runs if run.meta.correction], device=device)
    assert found(home, "c", "c", virtual=where == "version").kind == "virtual"


def test_tones_and_strokes_are_compared_as_well() -> None:
    def tone(number: int, gain: float) -> Run:
        t = np.arange(2000) / 1000.0
        wave = 3.0 * np.sin(2.0 * np.pi * 20.0 * t)
        noise = 1e-4 * np.random.default_rng(number).standard_normal(t.size)
        meta = RunMeta(
            f"t{number}",
            kind="sinusoidal",
            correction=SHA if number % 2 else "",
            condition={"axis": "Z", "frequency_hz": 20.0, "amplitude_um": 3.0},
            started=(BEGIN.replace(minute=number)).isoformat(),
        )
        samples = {"t_s": t, "cmd_z_mm": wave / 1e3, "tool_z_mm": (gain * wave + noise) / 1e3}
        return Run(meta, samples)

    def stroke(number: int, slope: float) -> Run:
        place = np.linspace(0.0, 100.0, 11)
        noise = 0.05 * np.random.default_rng(number).standard_normal(22)
        meta = RunMeta(
            f"s{number}",
            kind="linear",
            correction=SHA if number % 2 else "",
            condition={"axis": "Z"},
            started=(BEGIN.replace(minute=number)).isoformat(),
        )
        samples = {
            "t_s": np.arange(22.0),
            "position_mm": np.concatenate([place, place[::-1]]),
            "direction": np.repeat(np.array(["forward", "reverse"], dtype=object), 11),
            "error_um": slope * np.concatenate([place, place[::-1]]) + noise + 17.0,
        }
        return Run(meta, samples)

    tones = said([tone(n, 1.01 if n % 2 else 1.1) for n in range(6)]).conditions[0]
    assert (tones["before_um"], tones["after_um"]) == pytest.approx((0.3, 0.03), rel=0.01)
    strokes = said([stroke(n, 0.02 if n % 2 else 0.2) for n in range(6)]).conditions
    assert [c["approached"] for c in strokes] == ["forward", "reverse"]
    for condition in strokes:
        assert condition["before_um"] == pytest.approx(0.2 * 31.6, rel=0.02)
        assert condition["better"]


def test_kinds_that_are_not_compared_run_by_run_say_so() -> None:
    meta = RunMeta("p", kind="placement", started=BEGIN.isoformat())
    run = Run(meta, {"t_s": np.zeros(1), "error_x_um": np.ones(1)})
    with pytest.raises(InputError, match="evidence run by run is not offered"):
        evidence_of_runs(
            [EvidenceRun("without", "c", "0", run)], kind="virtual", machine=MACHINE, model_sha256=SHA, campaigns={}
        )
