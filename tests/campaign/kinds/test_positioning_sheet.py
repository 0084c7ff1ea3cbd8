"""Test sheets of positioning tests that are less, or longer, than the standard's usual one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dtwin.kinds.linear._report import positioning_lines, positioning_result
from dtwin.kinds.registry import kind_named
from dtwin.positioning.check import judge_positioning_campaign
from dtwin.positioning.positioning_sheet import positioning_figure
from dtwin.report.language import _german_of
from dtwin.report.sheet import Sheet, judged
from dtwin.report.uncertainty import Circumstances
from dtwin.schema import Finding, Run, RunMeta

TARGETS = np.arange(0.0, 301.0, 50.0)


def sweeps(
    n: int, targets: np.ndarray, ways: tuple[str, ...] = ("forward", "reverse"), noise_um: float = 0.5
) -> list[Run]:
    """Return n runs of an axis with a slope, a wave and 2 um of lost motion."""
    rng = np.random.default_rng(n)
    place = np.concatenate([targets if way == "forward" else targets[::-1] for way in ways])
    way = np.repeat(list(ways), targets.size)
    runs = []
    for number in range(n):
        error = 0.01 * place + np.sin(place / 30.0) - 2.0 * (way == "reverse") + rng.normal(0.0, noise_um, place.size)
        samples = {"t_s": np.arange(place.size) * 1.0, "position_mm": place, "direction": way, "error_um": error}
        runs.append(Run(RunMeta(f"r{number}", kind="linear", condition={"axis": "X"}, repeat=number + 1), samples))
    return runs


def sheet_of(runs: list[Run]) -> Sheet:
    return judged(kind_named("linear").sheet(runs, Circumstances()), {})


def read(runs: list[Run], way: str) -> np.ndarray:
    """Return readings (targets, runs) by rising target."""
    columns = []
    for run in runs:
        chosen = run.samples["direction"] == way
        columns.append(run.samples["error_um"][chosen][np.argsort(run.samples["position_mm"][chosen])])
    return np.stack(columns, axis=1)


def test_one_run_of_a_long_axis_has_the_figures_of_its_means() -> None:
    """ISO 230-2 tests axes over 2 m once in each direction: E, B and M without repeatability."""
    runs = sweeps(1, np.arange(0.0, 3001.0, 250.0))
    sheet = sheet_of(runs)
    (part,) = sheet.parts
    up, down = read(runs, "forward")[:, 0], read(runs, "reverse")[:, 0]
    assert {c.symbol: c.value_um for c in part.characteristics} == {
        "E": pytest.approx(max(up.max(), down.max()) - min(up.min(), down.min())),
        "E↑": pytest.approx(np.ptp(up)),
        "E↓": pytest.approx(np.ptp(down)),
        "B": pytest.approx(np.abs(up - down).max()),
        "B̄": pytest.approx((up - down).mean()),
        "M": pytest.approx(np.ptp((up + down) / 2.0)),
    }
    assert not any(np.isfinite(c.expanded_um) for c in part.characteristics)
    assert sheet.notes == ()
    assert positioning_figure(runs).data


@pytest.mark.parametrize(("way", "arrow"), [("forward", "↑"), ("reverse", "↓")])
def test_one_direction_has_its_own_figures(way: str, arrow: str) -> None:
    runs = sweeps(5, np.arange(0.0, 501.0, 50.0), (way,))
    (part,) = sheet_of(runs).parts
    mean, deviation = read(runs, way).mean(axis=1), read(runs, way).std(axis=1, ddof=1)
    assert part.title == f"axis X, {way} only, 0 to 500 mm, 11 targets"
    assert {c.symbol: c.value_um for c in part.characteristics} == {
        f"A{arrow}": pytest.approx((mean + 2 * deviation).max() - (mean - 2 * deviation).min()),
        f"R{arrow}": pytest.approx(4 * deviation.max()),
        f"E{arrow}": pytest.approx(np.ptp(mean)),
    }
    # As all targets scatter alike, the scatter is that of 11 targets; of runs as wholes it is that of five runs.
    assert all(c.expanded_um > 0.0 and 4.0 < c.dof <= 44.0 for c in part.characteristics)
    # As the standard draws it: the mean at each target, and two standard deviations of what the runs read there.
    (drawn,) = positioning_figure(runs).data
    assert drawn.y == pytest.approx(mean, abs=1e-4)
    assert drawn.error_y.array == pytest.approx(2.0 * deviation)


def test_an_axis_of_both_directions_leaves_others_out() -> None:
    runs = sweeps(5, np.arange(0.0, 501.0, 50.0))
    alone = Run(
        RunMeta("alone", kind="linear", condition={"axis": "X"}), sweeps(1, np.arange(5.0), ("forward",))[0].samples
    )
    sheet = sheet_of([*runs, alone])
    assert sheet.notes[0] == "alone is not evaluated: it has one direction only."
    assert sheet.parts[0].runs == ("r0", "r1", "r2", "r3", "r4")


@pytest.mark.parametrize(
    ("runs", "targets", "said"),
    [
        (5, np.arange(0.0, 501.0, 50.0), ""),
        (3, np.arange(0.0, 501.0, 50.0), "asks for five runs, these are 3"),
        (1, np.arange(0.0, 501.0, 50.0), "asks for five runs, this is one, and tells no repeatability"),
        (5, np.arange(0.0, 301.0, 100.0), "asks for 5 targets on this travel, these are 4"),
        (5, np.arange(0.0, 1601.0, 400.0), "asks for 8 targets on this travel, these are 5"),
        (1, np.arange(0.0, 3001.0, 500.0), "a target every 250 mm in the mean, these are 7"),
        (2, np.arange(0.0, 3001.0, 250.0), "R and A of 2 m at most"),
    ],
)
def test_what_the_standard_asks_for_is_said(runs: int, targets: np.ndarray, said: str) -> None:
    notes = " ".join(n for n in sheet_of(sweeps(runs, targets)).notes if "would be" not in n)
    assert said in notes
    assert bool(said) == bool(notes)


def test_a_run_that_ends_early_is_told_before_figures_of_a_part_of_the_travel() -> None:
    runs = sweeps(5, np.arange(0.0, 501.0, 50.0))
    runs[4] = replace(runs[4], samples=sweeps(1, np.arange(0.0, 201.0, 50.0))[0].samples)
    (found,) = (f for f in judge_positioning_campaign(runs) if f.code == "linear.ended_early")
    assert (
        "1 of 5 runs read a part of the travel: all figures are of 5 of 11 targets, from 0 to 200 mm" in found.message
    )
    assert _german_of(found.message, str) is not None
    assert "linear.ended_early" not in {f.code for f in judge_positioning_campaign(runs[:4])}


def test_the_uncertainty_of_one_direction_covers_its_mean_figure() -> None:
    perfect = dict.fromkeys(("uncertainty_um", "uncertainty_um_per_m", "alignment_mm"), 0.0)
    under = Circumstances(perfect | {"temperature_uncertainty_k": 0.0, "expansion_uncertainty_um_per_m_k": 0.0})
    rng = np.random.default_rng(7)
    told = []
    for _ in range(100):
        runs = sweeps(5, np.arange(0.0, 501.0, 50.0), ("forward",), noise_um=0.0)
        for run in runs:
            run.samples["error_um"][:] += rng.normal(0.0, 0.5, run.n_samples)
        sheet = judged(kind_named("linear").sheet(runs, under), {})
        told.append(next((c.value_um, c.expanded_um) for c in sheet.parts[0].characteristics if c.symbol == "A↑"))
    value, half = np.array(told).T
    assert np.mean(np.abs(value - value.mean()) <= half) >= 0.9


PERFECT = Circumstances(
    dict.fromkeys(
        (
            "uncertainty_um",
            "uncertainty_um_per_m",
            "alignment_mm",
            "temperature_uncertainty_k",
            "expansion_uncertainty_um_per_m_k",
        ),
        0.0,
    )
)


@pytest.mark.parametrize(("shift_um", "back_um"), [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
def test_the_uncertainty_is_as_wide_as_tests_scatter_also_where_runs_move_as_wholes(
    shift_um: float, back_um: float
) -> None:
    """Drawn target by target U of R was twice too wide, of E twice too wide where runs shift, and of R then too narrow.

    Where a run moves between there and back U of B̄ was that of many targets, not of few runs.
    """
    rng = np.random.default_rng(9)
    told: dict[str, list[tuple[float, float]]] = {}
    for _ in range(150):
        runs = sweeps(10, np.arange(0.0, 501.0, 50.0), noise_um=0.0)
        for run in runs:
            run.samples["error_um"][:] += rng.normal(0.0, 0.5, run.n_samples) + rng.normal(0.0, shift_um)
            run.samples["error_um"][run.samples["direction"] == "reverse"] += rng.normal(0.0, back_um)
        for c in judged(kind_named("linear").sheet(runs, PERFECT), {}).parts[0].characteristics:
            told.setdefault(c.symbol, []).append((c.value_um, c.expanded_um))
    for symbol in ("A", "R", "E", "M", "B̄"):
        value, half = np.array(told[symbol]).T
        assert np.mean(np.abs(value - value.mean()) <= half) >= 0.9, symbol
        assert half.mean() < 1.45 * 2.0 * value.std(), symbol


def test_two_targets_and_one_have_an_uncertainty() -> None:
    for targets in (np.array([0.0, 100.0]), np.array([50.0])):
        for ways in (("forward", "reverse"), ("forward",)):
            (part,) = judged(kind_named("linear").sheet(sweeps(5, targets, ways), PERFECT), {}).parts
            arrow = part.characteristics[1] if len(ways) == 1 else part.characteristics[3]
            assert arrow.symbol in ("R", "R↑")
            assert arrow.expanded_um > 0.0


def test_the_axes_of_one_campaign_are_not_taken_together() -> None:
    """A lathe's X and Z in one folder: each has its own figures, and what they differ by is no drift."""
    short = sweeps(5, TARGETS)
    steep = [replace(run, samples={**run.samples, "error_um": 30.0 + 3.0 * run.samples["error_um"]}) for run in short]
    z = [replace(run, meta=replace(run.meta, run_id=f"z{n}", condition={"axis": "Z"})) for n, run in enumerate(steep)]
    both = positioning_result([*short, *z])
    assert both == {"axes": [positioning_result(short), positioning_result(z)]}
    assert "axis Z:" in positioning_lines(both)
    codes = [f.code for f in kind_named("linear").judge_campaign([*short, *z])]
    assert codes == [f.code for runs in (short, z) for f in kind_named("linear").judge_campaign(runs)]


def test_what_is_computed_beside_the_sheet_is_of_the_same_runs() -> None:
    runs = sweeps(6, TARGETS)
    missed = Finding(
        "linear.missed_targets",
        "error",
        "1 readings of 16 are missing, the first at 0 mm: window too small, or the dwell too short",
    )
    short = {name: values[1:] for name, values in runs[2].samples.items()}
    runs[2] = replace(runs[2], samples=short, findings=(missed,))
    figures = positioning_result(runs)
    (part,) = sheet_of(runs).parts
    told = {c.symbol: c.value_um for c in part.characteristics}
    assert (figures["runs"], figures["targets"]) == (5, len(TARGETS))
    assert (figures["iso_230_2"]["accuracy_um"], figures["iso_230_2"]["systematic_um"]) == (told["A"], told["E"])


def test_runs_of_two_mountings_are_not_one_test_in_silence() -> None:
    runs = sweeps(5, TARGETS)
    runs[4] = replace(runs[4], meta=replace(runs[4].meta, setup="rear"))
    assert any("2 set-ups" in note for note in sheet_of(runs).notes)
    assert not any("set-ups" in note for note in sheet_of(runs[:4]).notes)


def test_reverse_readings_that_stand_upside_down_are_told() -> None:
    """Reverse columns written as they were read, from the last target to the first, beside targets that rise."""
    runs = sweeps(5, TARGETS, noise_um=0.1)
    judge = kind_named("linear").judge_campaign
    assert "linear.turned" not in {f.code for f in judge(runs)}
    n = len(TARGETS)
    turned = [
        replace(run, samples={**run.samples, "error_um": np.append(e[:n], e[n:][::-1])})
        for run, e in ((run, run.samples["error_um"]) for run in runs)
    ]
    # Readings with times of their own were read as they stand: the play grows along the axis.
    assert "linear.turned" not in {f.code for f in judge(turned)}
    table = [replace(run, findings=(Finding("clock.assumed", "info", "no clock"),)) for run in turned]
    assert {f.code: f.severity for f in judge(table)}["linear.turned"] == "warning"


def test_a_pause_at_the_turn_is_no_lost_reading() -> None:
    """ISO 230-2 has an overrun and a dwell at each end; a reading that a steady log lacks is told."""
    (run,) = sweeps(1, TARGETS)
    n = len(TARGETS)
    judge = kind_named("linear").judge_run
    paused = replace(run, samples={**run.samples, "t_s": run.samples["t_s"] + 1.0 * (np.arange(2 * n) >= n)})
    assert "clock.dropout" not in {f.code for f in judge(paused)}
    lost = replace(run, samples={**run.samples, "t_s": run.samples["t_s"] + 1.0 * (np.arange(2 * n) >= 3)})
    assert "clock.dropout" in {f.code for f in judge(lost)}
    one_way = {name: np.append(values[:n], values[:n]) for name, values in paused.samples.items()}
    again = replace(run, samples={**one_way, "t_s": paused.samples["t_s"]})
    assert "clock.dropout" not in {f.code for f in judge(again)}
