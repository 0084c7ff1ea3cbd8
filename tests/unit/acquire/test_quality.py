from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.motion_quality import aligned_angle_deg, motion_of, non_repeatable_um
from dtwin.acquire.quality import judge_campaign, judge_copies, judge_pasted, judge_run
from dtwin.schema import Finding, Run, RunMeta, SignalGroup


def found(findings: list[Finding], code: str) -> Finding:
    return next(f for f in findings if f.code == code)


@pytest.fixture(scope="module")
def real(real_recording: Path) -> dict[str, Run]:
    return {run.meta.run_id: run for run in read_b5r(real_recording).runs}


def test_the_short_clockwise_window_is_found(real: dict[str, Run]) -> None:
    finding = found(judge_run(real["cw"]), "arc.window_short")
    assert finding.severity == "error"
    assert finding.numbers["true_deg"] == pytest.approx(326, abs=1.5)
    assert 1590 <= finding.numbers["period_samples_1"] <= 1592
    assert not any(f.code.startswith("arc.") for f in judge_run(real["ccw"]))


@pytest.mark.parametrize(("direction", "expected"), [("ccw", (810, 1609, 2387)), ("cw", (551, 1351, 2140))])
def test_the_stops_every_half_turn_are_found(real: dict[str, Run], direction: str, expected: tuple[int, ...]) -> None:
    stops = found(judge_run(real[direction]), "motion.stops").numbers["samples_1"]
    assert isinstance(stops, list)
    for wanted in expected:
        assert min(abs(wanted - stop) for stop in stops) <= 10


def test_the_clockwise_angles_are_misregistered(real: dict[str, Run]) -> None:
    finding = found(judge_run(real["cw"]), "angle.misregistered")
    assert finding.numbers["worst_deg"] == pytest.approx(52, abs=4)
    aligned = aligned_angle_deg(real["cw"], motion_of(real["cw"]))
    assert aligned is not None
    assert np.all(np.diff(aligned) < 0)
    assert not any(f.code == "angle.misregistered" for f in judge_run(real["ccw"]))


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_what_repeats_between_revolutions(real: dict[str, Run], direction: str) -> None:
    result = non_repeatable_um(real[direction], motion_of(real[direction]))
    assert result is not None
    correlation, repeatable, rest = result
    assert correlation > 0.96
    assert repeatable > 50
    assert rest < 11
    assert found(judge_run(real[direction]), "feed.differs").numbers["real_mm_min"] < 4850


@pytest.mark.parametrize("overshoot_deg", [180.0, 45.0])
def test_feeding_the_bar_in_and_out_is_no_part_of_a_period(overshoot_deg: float) -> None:
    rate, feed, radius = 250.0, 1000.0, 150.0
    angle = np.arange(-overshoot_deg, 360.0 + overshoot_deg, np.degrees(feed / 60.0 / radius) / rate)
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    circle = -2.0 * (cos**2 - sin**2) - 3.0 * np.sign(sin) * cos - 3.0 * np.sign(cos) * sin
    circle += 0.2 * np.random.default_rng(1).standard_normal(angle.size)
    fed = np.concatenate([np.full(75, 1500.0), np.linspace(1500.0, 0.0, 25)])
    value = np.concatenate([fed, circle, fed[::-1]])
    angle = np.concatenate([np.full(100, angle[0]), angle, np.full(100, angle[-1])])
    inside = np.flatnonzero((angle >= 0.0) & (angle < 360.0))
    meta = RunMeta("r", plane="XY", direction="CCW", radius_mm=radius, feed_mm_min=feed, sample_rate_hz=rate)
    samples = {"t_s": np.arange(angle.size) / rate, "angle_deg": angle, "deviation_um": value}
    run = Run(meta, samples, window=(int(inside[0]), int(inside[-1]) + 1))
    period = motion_of(run).period_samples
    assert np.isnan(period) or period == pytest.approx(len(inside), rel=0.005)


def test_steps_of_a_large_backlash_of_the_second_axis_are_no_stops() -> None:
    """Right files of a machine with 120 µm of play were refused: misregistered by 89 degrees."""
    rate, feed, radius = 250.0, 3000.0, 150.0
    angle = np.arange(-180.0, 540.0, np.degrees(feed / 60.0 / radius) / rate)
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    value = -60.0 * np.sign(cos) * sin + 0.1 * np.random.default_rng(1).standard_normal(angle.size)
    inside = np.flatnonzero((angle >= 0.0) & (angle < 360.0))
    meta = RunMeta("r", plane="XY", direction="CCW", radius_mm=radius, feed_mm_min=feed, sample_rate_hz=rate)
    samples = {"t_s": np.arange(angle.size) / rate, "angle_deg": angle, "deviation_um": value}
    run = Run(meta, samples, window=(int(inside[0]), int(inside[-1]) + 1))
    assert len(motion_of(run).stops) > 1
    assert not any(f.severity == "error" for f in judge_run(run))


def test_a_feed_of_twice_what_marks_and_rate_say_is_told(real: dict[str, Run]) -> None:
    run = real["ccw"]
    twice = replace(run, meta=replace(run.meta, feed_mm_min=10_000.0))
    assert found(judge_run(twice), "feed.differs").numbers["real_mm_min"] == pytest.approx(4740, abs=20)


def made(**columns: np.ndarray) -> Run:
    n = 400
    samples = {
        "t_s": np.arange(n) / 200.0,
        "angle_deg": np.linspace(0, 360, n),
        "deviation_um": 5 * np.sin(np.arange(n) / 7.0),
    } | columns
    meta = RunMeta("r", plane="XY", direction="CCW", radius_mm=100.0, feed_mm_min=18_800.0, sample_rate_hz=200.0)
    return Run(meta, samples)


def codes(run: Run) -> set[str]:
    return {f.code for f in judge_run(run)}


def test_a_clean_run_has_no_findings() -> None:
    assert codes(made()) == set()


def _changed(values: np.ndarray, at: slice, to: float) -> np.ndarray:
    copy = values.copy()
    copy[at] = to
    return copy


@pytest.mark.parametrize(
    ("columns", "code"),
    [
        ({"t_s": _changed(np.arange(400) / 200, slice(200, 201), 0.0)}, "clock.backwards"),
        ({"t_s": np.arange(400) / 200 + (np.arange(400) > 200) * 0.5}, "clock.dropout"),
        ({"deviation_um": 1e4 * np.sin(np.arange(400) / 7.0)}, "reading.out_of_range"),
        ({"deviation_um": np.linspace(0.0, 360.0, 400)}, "reading.ramp"),
        ({"deviation_um": 350.0 + 5.0 * np.sin(np.arange(400) / 7.0)}, "reading.datum"),
        ({"deviation_um": _changed(5 * np.sin(np.arange(400) / 7.0), slice(100, 150), 1.0)}, "reading.stuck"),
        ({"deviation_um": np.minimum(5 * np.sin(np.arange(400) / 30.0), 3.0)}, "reading.clipped"),
        ({"angle_deg": -np.linspace(0, 360, 400)}, "angle.direction"),
        ({"angle_deg": np.linspace(0, 360, 400) + (np.arange(400) > 200) * 90.0}, "angle.jump"),
        ({"angle_deg": np.linspace(0, 29, 400)}, "angle.short"),
        ({"t_s": np.arange(2) / 200.0, "angle_deg": np.array([0.0, 90.0]), "deviation_um": np.ones(2)}, "angle.short"),
    ],
)
def test_each_fault_of_a_run_is_named(columns: dict[str, np.ndarray], code: str) -> None:
    assert code in codes(made(**columns))


def test_faults_of_signals_are_named() -> None:
    rng = np.random.default_rng(1)
    good = rng.normal(size=5000)
    for values, code in (
        (np.where(np.arange(5000) == 7, np.nan, good), "signal.not_finite"),
        (np.clip(good, -1, 1), "signal.clipped"),
        (np.zeros(5000), "signal.dead"),
    ):
        run = replace(made(), signals=(SignalGroup("accelerometers", 1651.6, {"wrist_x_g": values}),))
        assert code in codes(run)


@pytest.mark.parametrize(
    ("lost", "told", "code"), [(12, True, ""), (12, False, "signal.not_finite"), (600, True, "signal.lost")]
)
def test_samples_that_a_recorder_told_as_lost_spoil_a_run_only_in_number(lost: int, told: bool, code: str) -> None:
    rng = np.random.default_rng(1)
    gone = np.arange(5000) < lost
    columns = {n: np.where(gone, np.nan, rng.normal(size=5000)) for n in ("target_x_mm", "wrist_x_g")}
    columns["segment_id"] = np.where(gone, -1, 1)
    findings = (Finding("recording.gap", "warning", "lost"),) if told else ()
    run = replace(made(), signals=(SignalGroup("controller", 125.0, columns),), findings=findings)
    assert {f.code for f in judge_run(run) if f.severity == "error"} == ({code} if code else set())
    # One value alone is no lost sample.
    columns["wrist_x_g"][-1] = np.nan
    assert "signal.not_finite" in codes(run)


def test_a_campaign_without_repeats_or_directions_says_so() -> None:
    one = made()
    found_codes = {f.code for f in judge_campaign([one])}
    assert found_codes == {"campaign.one_direction", "campaign.no_repeat"}
    runs = [
        replace(one, meta=replace(one.meta, run_id=f"{d}{r}", direction=d, repeat=r))
        for d in ("CCW", "CW")
        for r in (1, 2)
    ]
    assert judge_campaign(runs) == []
    # A year that was mistyped would be the newest test of the machine for a year.
    later = f"{max(date.today().year, 2026) + 1}-03-02T08:00:00+00:00"
    runs[0] = replace(runs[0], meta=replace(runs[0].meta, started=later))
    (told,) = judge_campaign(runs)
    assert (told.code, told.numbers) == ("campaign.to_come", {"runs_1": 1.0})


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"feed_mm_min": 1000.0}, "feed.differs"),
        ({"radius_mm": 100.0 * 25.4}, "feed.differs"),
        ({"radius_mm": 100.0 / 25.4}, "radius.implausible"),
    ],
)
def test_a_wrong_feed_or_a_radius_in_inches_is_an_error(change: dict[str, float], code: str) -> None:
    run = made()
    wrong = replace(run, meta=replace(run.meta, **change))  # type: ignore[arg-type]
    assert found(judge_run(wrong), code).severity == "error"


def test_millimetres_in_a_column_of_micrometres_are_an_error() -> None:
    run = made(deviation_um=0.005 * np.sin(np.arange(400) / 7.0))
    assert found(judge_run(run), "reading.too_small").severity == "error"


def test_a_copy_of_a_run_is_no_repeat() -> None:
    assert judge_copies({"a": "1", "b": "2", "c": "1"}).keys() == {"c"}


def _reads(name: str, read_um: np.ndarray, source: str = "x.csv") -> Run:
    return Run(RunMeta(name), {"t_s": np.arange(read_um.size), "error_um": read_um}, source=source)


def test_a_cycle_or_a_direction_that_was_copied_over_another_is_told_and_a_coarse_display_is_not() -> None:
    read = np.random.default_rng(1).normal(0.0, 1.0, (5, 120))
    copied = read[[0, 1, 2, 3, 3]]
    assert judge_pasted([_reads(str(n), one[:18]) for n, one in enumerate(copied)]).keys() == {"4"}
    assert judge_pasted([_reads("ccw", read[0]), _reads("cw", read[0, ::-1])]).keys() == {"cw"}
    coarse = np.round(np.linspace(0.0, 9.0, 18) + 0.05 * read[:, :18])
    coarse[4] = coarse[3]
    assert not judge_pasted([_reads(str(n), one) for n, one in enumerate(coarse)])
    assert not judge_pasted([_reads("1", read[0, :18]), _reads("2", read[0, :18])])
    assert not judge_pasted([_reads("1", np.zeros(120)), _reads("2", np.zeros(120))])


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (1.0 / 25.4, True), (-1.0, True)])
def test_readings_that_do_not_give_what_their_file_states_are_told(
    real: dict[str, Run], factor: float, told: bool
) -> None:
    for run in real.values():
        changed = replace(run, samples=run.samples | {"deviation_um": factor * run.samples["deviation_um"]})
        assert told == any(f.code == "vendor.differs" for f in judge_run(changed))


def test_a_feed_that_is_a_tenth_of_the_real_one_is_told_of_a_record_too_short_for_it(real: dict[str, Run]) -> None:
    run = replace(real["ccw"], meta=replace(real["ccw"].meta, feed_mm_min=500.0))
    assert found(judge_run(run), "feed.differs").severity == "error"


@pytest.mark.parametrize(("slope", "told"), [(1.0, True), (0.05, False)])
def test_actual_positions_under_a_head_of_errors_are_told(slope: float, told: bool) -> None:
    at = np.linspace(0.0, 500.0, 51)
    error = slope * at + 2e-3 * np.sin(at)
    samples = {"t_s": np.arange(51.0), "position_mm": at, "error_um": error, "direction": np.array(["forward"] * 51)}
    run = Run(RunMeta("a", kind="linear", condition={"axis": "X"}), samples)
    assert ("linear.positions" in codes(run)) == told
