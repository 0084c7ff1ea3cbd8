"""Twins and evidence of drift, on a column that is a network of bodies."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.drift._check import judge_drift
from dtwin.kinds.drift._correction import _grading
from dtwin.kinds.drift._data import Loaded
from dtwin.kinds.drift._diagnosis import DriftDiagnosis, asked, diagnose, explained_together, joined, written
from dtwin.kinds.drift._evidence import _AGAIN, _column_of, _probed, drift_errors, simulate_drift
from dtwin.kinds.drift._model import Series
from dtwin.kinds.drift._twins import DriftTwins
from dtwin.schema import Run, RunMeta
from dtwin.twins.shelf import TwinShelf


@cache
def log(truth: str, seed: int = 1) -> Series:
    column = _column_of(truth)
    day = column.day(column.drawn_program_w(8.0, seed), seed)
    at = _probed(day)
    read = {f"temperature_{name}_c": values[at] for name, values in day.read_c.items()}
    return Series(
        day.t_s[at], column.probed_um(day.moved_um[at], seed), read, np.repeat(np.arange(at.size // _AGAIN), _AGAIN)
    )


def said_of(truth: str, *effects: str) -> DriftDiagnosis:
    series = log(truth)
    return diagnose(series, joined(series, (), asked(series, effects)))


def test_a_sensor_on_the_skin_is_told_to_be_late_and_one_in_the_casting_is_not() -> None:
    on_skin = said_of("surface", "follows")
    assert (on_skin.verdict, on_skin.additions) == ("missing_effect", ("lag@front",))
    assert said_of("pockets", "follows").verdict == "nothing_missing"
    assert "follows@hall" in [written(term) for term in said_of("pockets", "follows").idle]


def test_a_bent_scale_is_told_as_that_and_not_as_a_lag() -> None:
    bent = said_of("thermistor", "follows")
    assert (bent.verdict, bent.additions) == ("missing_effect", ("sensor_curve@front",))


def test_without_readings_taken_at_once_nobody_knows_what_is_noise() -> None:
    series = replace(log("pockets"), sample=None)
    said = diagnose(series, joined(series, (), asked(series, ["follows"])))
    assert said.verdict == "need_repeats"
    assert said.as_dict()["noise_floor_um"] is None


def test_what_moves_slowly_is_no_noise_though_no_reading_was_taken_at_once() -> None:
    series = log("pockets")
    t_s = 30.0 * np.arange(1200)
    warm = {name: np.interp(t_s, series.t_s, values) for name, values in series.temperatures_c.items()}
    followed = 4.0 * warm["temperature_back_c"] + np.random.default_rng(3).normal(0.0, 0.25, t_s.size)
    for swing_um, verdict in ((0.0, "need_repeats"), (0.8, "unknown_effect")):
        moved = followed + swing_um * np.sin(2.0 * np.pi * t_s / 3100.0)
        logged = Series(t_s, moved, {"temperature_back_c": warm["temperature_back_c"]}, None)
        said = diagnose(logged, joined(logged, (), asked(logged, ["follows"])))
        assert said.verdict == verdict
        assert logged.next_um == pytest.approx(0.25, rel=0.1)


def test_what_settles_takes_no_sensor_along_and_is_told_as_time() -> None:
    source, rng = log("pockets"), np.random.default_rng(4)
    t_s = 60.0 * np.arange(700)
    back = np.interp(t_s, source.t_s, source.temperatures_c["temperature_back_c"])
    stray = 25.0 + np.cumsum(rng.normal(0.03, 0.1, t_s.size))
    read = {"temperature_back_c": back, "temperature_cabinet_c": stray}
    moved = 4.0 * back + 10.0 * np.arctan(t_s / 15_000.0) + rng.normal(0.0, 0.25, t_s.size)
    series = Series(t_s, moved, read, None)
    said = diagnose(series, joined(series, (), asked(series, ["follows@back"])))
    assert (said.verdict, said.additions) == ("unknown_effect", ())
    assert "time alone takes 9" in said.headline
    alone = diagnose(replace(series, moved_um=2.0 * stray), ())
    assert (alone.verdict, alone.alike) == ("missing_effect", ("follows@cabinet",))
    once = np.exp(-t_s / 9_000.0)
    warmed = replace(series, moved_um=moved - 4.0 * back, temperatures_c={"temperature_oven_c": 30.0 - 5.0 * once})
    settled = diagnose(replace(warmed, moved_um=-20.0 * once + rng.normal(0.0, 0.25, t_s.size)), ())
    assert (settled.verdict, settled.alike) == ("ambiguous", ("follows@oven", "time alone"))
    assert "warms and cools again" in settled.as_dict()["next_experiment"]["text"]


def test_sensors_that_tell_only_together_are_found_where_they_explain_all() -> None:
    rng, t_s = np.random.default_rng(5), 60.0 * np.arange(700)
    hall, own = (np.convolve(rng.normal(0.0, 1.0, 900), np.ones(201) / 14.0, "valid") for _ in range(2))
    read = {"temperature_front_c": 20.0 + 9.0 * hall + own, "temperature_back_c": 20.0 + 9.0 * hall}
    series = Series(t_s, 5.0 * own + rng.normal(0.0, 0.3, t_s.size), read, None)
    assert diagnose(series, ()).verdict == "unknown_effect"
    assert [written(term) for term in explained_together(series, ())] == ["follows@front", "follows@back"]
    terms = asked(series, ["follows@front"])
    assert "only together with the others: log a time in which front moves" in _grading(series, terms, terms[0]).grade
    waved = replace(series, moved_um=series.moved_um + 2.0 * np.sin(2.0 * np.pi * t_s / 4000.0))
    assert explained_together(waved, ()) == ()


def test_two_sensors_that_read_alike_are_ambiguous() -> None:
    series = log("pockets")
    twice = {**series.temperatures_c, "temperature_beside_c": series.temperatures_c["temperature_back_c"] + 0.005}
    said = diagnose(replace(series, temperatures_c=twice), ())
    assert said.verdict == "ambiguous"
    assert set(said.additions) == {"follows@back", "follows@beside"}
    assert "do not warm together" in said.as_dict()["next_experiment"]["text"]


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> DriftTwins:
    root = tmp_path_factory.mktemp("drift")
    simulate_drift(root / "column", lambda *_: None, quick=True)
    return DriftTwins(Home(root / "home"))


def test_the_verbs_of_a_twin(twins: DriftTwins, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = str(twins.root.parent.parent / "column")
    first = twins.fit(folder, ["follows"], "c")
    late = twins.add("c", "lag", "front")
    assert set(late.labels) == {"follows@spindle", "follows@back", "follows@hall", "lag@front"}
    assert late.figures["held_out_rms_um"] < 0.8 * first.figures["held_out_rms_um"]
    (entry,) = [e for e in late.as_dict()["effects"] if e["effect"] == "lag"]
    assert 120.0 < entry["time_constant_s"] < 3600.0
    result = twins.compare("c").as_dict()
    assert result["residual_rms_um"] == pytest.approx(late.figures["rms_after_um"], rel=0.02)
    assert twins.remove("c", "lag", "front").labels == tuple(one for one in late.labels if one != "lag@front")
    assert twins.restore("c", late.version).labels == late.labels
    with pytest.raises(InputError, match="has this effect already"):
        twins.add("c", "lag", "front")
    with pytest.raises(InputError, match="does not have this effect"):
        twins.remove("c", "sensor_curve", "back")
    for wrong, code in (("backlash", "effect.unknown"), ("lag@nowhere", "effect.axis")):
        with pytest.raises(InputError) as refused:
            twins.fit(folder, [wrong], "other")
        assert refused.value.code == code
    assert TwinShelf(twins.home, "drift").names() == ["c"]
    load = twins.loaded

    def while_another_goes_back(campaign: str) -> Loaded:
        monkeypatch.undo()
        twins.restore("c", 1)
        return load(campaign)

    monkeypatch.setattr(twins, "loaded", while_another_goes_back)
    with pytest.raises(InputError, match="another process changed the twin"):
        twins.remove("c", "lag", "front")
    assert twins.newest("c").labels == first.labels


def corrected(moved_um: float, correction: str = "") -> Run:
    rng = np.random.default_rng(3)
    t_s = np.repeat(60.0 * np.arange(240.0), 2)
    shape = moved_um * (1.0 - np.exp(-t_s / 4000.0)) + 7.0
    samples = {
        "t_s": t_s,
        "displacement_um": shape + 0.5 * rng.standard_normal(t_s.size),
        "sample_1": np.repeat(np.arange(240.0), 2),
        "temperature_frame_c": 20.0 + shape,
    }
    meta = RunMeta("r", kind="drift", condition={"axis": "Z", "test": "warm-up"}, correction=correction)
    return Run(meta, samples, source="here")


def test_what_a_correction_leaves_is_not_stopped_for_being_little() -> None:
    assert [f.code for f in judge_drift(corrected(0.5)) if f.severity == "error"] == ["drift.noise"]
    assert not judge_drift(corrected(0.5, "abc"))


def test_evidence_counts_how_far_a_place_moves_since_its_log_began() -> None:
    one, other = drift_errors([corrected(30.0), corrected(0.0, "abc")])
    assert one.condition == other.condition == {"axis": "Z", "test": "warm-up", "hours": 4.0}
    # The root mean square of 30 (1 - exp(-t / 4000 s)) over four hours, by a sum of its own.
    t_s = np.linspace(0.0, 14400.0, 5000)
    assert one.size_um == pytest.approx(np.sqrt(np.mean((30.0 * (1.0 - np.exp(-t_s / 4000.0))) ** 2)), rel=0.03)
    assert other.size_um < 1.0
    assert one.rest_um.shape == other.rest_um.shape


def test_a_folder_that_holds_a_campaign_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="holds a campaign already"):
        simulate_drift(tmp_path, lambda *_: None)
