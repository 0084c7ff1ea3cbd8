"""The laser's ASCII file: printed rows, signs, sweeps, and what is noticed about a test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.ingest import ingest
from dtwin.acquire.quality import judge_campaign, judge_run
from dtwin.errors import InputError
from dtwin.kinds.linear.laser_file import LaserTest, linear_error, read_laser_file, sign_rule, write_laser_file
from dtwin.lake.store import Lake
from dtwin.positioning.matrix import sweeps
from dtwin.report.checking import check_source, render_check
from dtwin.schema import Run

# The ten rows that the source thesis prints: its table 2-3 and figure 4.4.
PRINTED_X = """Position\tLasRead\tLinearError\tStatus\tAirTemp\tAirPress\tMatTemp
-7.00000\t-0.000004\t0.000004\t0\t73.76\t29.33\t74.65
-6.86000\t-0.139901\t-0.000099\t0\t73.76\t29.33\t74.65
-6.72000\t-0.279949\t-0.000051\t0\t73.76\t29.34\t74.65
-6.58000\t-0.419945\t-0.000055\t0\t73.76\t29.34\t74.65
-6.44000\t-0.559952\t-0.000048\t0\t73.76\t29.34\t74.65
-6.30000\t-0.699888\t-0.000112\t0\t73.76\t29.34\t74.65
"""
PRINTED_Z = """Position\tLasRead\tLinearError\tStatus\tAirTemp\tAirPress
MatTemp
1.00000\t0.000010\t-0.000010\t0\t70.37\t29.25 71.49
2.00000\t-0.999691\t-0.000309\t0\t70.36\t29.25 71.49
3.00000\t-1.999600\t-0.000400\t0\t70.35\t29.25 71.49
4.00000\t-2.999554\t-0.000446\t0\t70.35\t29.25 71.49
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "laser.txt"
    path.write_text(text, encoding="ascii")
    return path


@pytest.mark.parametrize(("text", "rows"), [(PRINTED_X, 6), (PRINTED_Z, 4)])
def test_the_printed_rows_obey_the_sign_rule(tmp_path: Path, text: str, rows: int) -> None:
    test = read_laser_file(written(tmp_path, text))
    assert (test.raw.shape, test.rejects) == ((rows, 7), [])
    position = test.column("Position")
    computed = linear_error(position, test.column("LasRead"), position[0], "decrease")
    assert np.max(np.abs(computed - test.column("LinearError"))) < 1.000001e-6
    assert sign_rule(test) == ("decrease", True)


def test_turned_readings_and_turned_errors_are_told_apart(tmp_path: Path) -> None:
    test = read_laser_file(written(tmp_path, PRINTED_Z))
    turned = test.raw * [1, -1, 1, 1, 1, 1, 1]
    assert sign_rule(LaserTest(turned, test.averages, [])) == ("increase", True)
    wrong = test.raw * [1, 1, -1, 1, 1, 1, 1]
    assert sign_rule(LaserTest(wrong, test.averages, [])) == ("decrease", False)
    mixed = test.raw.copy()
    mixed[2:, 2] += 0.001
    assert sign_rule(LaserTest(mixed, test.averages, []))[0] is None


def test_what_is_written_is_read_again_with_its_averages(tmp_path: Path) -> None:
    test = read_laser_file(written(tmp_path, PRINTED_X))
    averages = np.array([[-7.0, 0.000004], [-6.86, -0.000099]])
    path = write_laser_file(tmp_path / "again.txt", LaserTest(test.raw, averages, []))
    assert path.read_text().startswith(PRINTED_X)
    again = read_laser_file(path)
    assert np.array_equal(again.raw, test.raw)
    assert np.array_equal(again.averages, averages)


def test_a_spoilt_line_is_kept_aside_and_no_file_is_refused(tmp_path: Path) -> None:
    test = read_laser_file(written(tmp_path, PRINTED_X + "-6.16000\t-0.83\n-6.02 x 0 0 0 0 0\n"))
    assert [(r["row"], len(test.raw)) for r in test.rejects] == [(7, 6), (8, 6)]
    for text in ("1 2 3 4 5 6 7\n", "Position LasRead\n1 2\n", "hello\n"):
        with pytest.raises(InputError, match="laser file"):
            read_laser_file(written(tmp_path, text))


def test_sweeps_part_where_the_axis_turns_even_when_a_reading_is_missing() -> None:
    whole = np.array([1, 2, 3, 3, 2, 1, 1, 2, 3, 3, 2, 1.0])
    assert [(s.start, s.stop, d) for s, d in sweeps(whole)] == [(0, 3, 1), (3, 6, -1), (6, 9, 1), (9, 12, -1)]
    assert [(s.start, s.stop, d) for s, d in sweeps(np.array([1, 2, 3, 2, 1.0]))] == [(0, 3, 1), (3, 5, -1)]


def campaign(tmp_path: Path, error_in: np.ndarray, targets_in: np.ndarray, skip: int = -1, sign: float = 1.0) -> Path:
    """Write runs of errors (runs, 2 targets) as a campaign folder."""
    path = np.concatenate([targets_in, targets_in[::-1]])
    rows = [
        [p, -e - (p - path[0]), sign * e, 0, 70, 29.3, 71]
        for run in np.round(error_in, 6)
        for p, e in zip(path, run, strict=True)
    ]
    rows = [row for i, row in enumerate(rows) if i != skip]
    write_laser_file(tmp_path / "z.txt", LaserTest(np.array(rows), np.empty((0, 2)), []))
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nname = "z"\nmachine = "lathe"\nkind = "linear"\n'
        "[campaign.machine_geometry]\nscrew_pitch_mm = 6.35\n"
        '[campaign.instrument]\nlength_unit = "in"\nreading_period_s = 6\n'
        '[[run]]\nid = "z"\nfile = "z.txt"\n'
    )
    return tmp_path


def runs_of(folder: Path) -> list[Run]:
    opened = open_campaign(folder)
    return opened.read(opened.entries[0])[0]


def errors(n_runs: int = 4, targets: int = 31, drift: bool = False) -> np.ndarray:
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(n_runs, 2 * targets)) * 3e-5
    if drift:
        noise += np.cumsum(rng.normal(size=(n_runs, 2 * targets)), axis=1) * 5e-5
    return noise + np.repeat([0.0, 0.004], targets)


def test_a_laser_file_becomes_runs_in_mm_and_um_and_lands_in_the_lake(tmp_path: Path) -> None:
    told = errors(2)
    folder = campaign(tmp_path, told, np.linspace(1.0, 16.6, 31))
    runs = runs_of(folder)
    assert [(r.meta.run_id, r.meta.repeat, r.n_samples) for r in runs] == [("z-1", 1, 62), ("z-2", 2, 62)]
    assert np.allclose(runs[1].samples["error_um"], np.round(told[1], 6) * 25400.0)
    assert runs[0].samples["position_mm"][30] == pytest.approx(16.6 * 25.4)
    assert runs[1].samples["t_s"][0] == 62 * 6
    assert runs[0].samples["air_kpa"][0] == pytest.approx(99.22, abs=0.01)
    lake = Lake(tmp_path / "lake")
    assert ingest(folder, lake).added == ("z-1", "z-2")
    assert ingest(folder, lake).unchanged == ("z-1", "z-2")
    row = lake.runs("z")[0]
    assert list(lake.load(row).samples["direction"][[0, 31]]) == ["forward", "reverse"]


def codes(runs: list[Run]) -> set[str]:
    found = [f for run in runs for f in (*run.findings, *judge_run(run))]
    return {f.code for f in [*found, *judge_campaign(runs)]}


def test_missed_targets_wrong_signs_and_steps_that_divide_the_pitch_are_named(tmp_path: Path) -> None:
    grid = np.linspace(1.0, 16.6, 31)
    assert codes(runs_of(campaign(tmp_path, errors(), grid))) == set()
    assert codes(runs_of(campaign(tmp_path, errors(), grid, skip=40))) == {"linear.missed_targets"}
    assert codes(runs_of(campaign(tmp_path, errors(), grid, sign=-1.0))) == {"laser.sign"}
    assert codes(runs_of(campaign(tmp_path, errors(), np.arange(31.0)))) == {"linear.step_divides_pitch"}
    assert codes(runs_of(campaign(tmp_path, errors() + 1.0, grid))) == {"reading.out_of_range", "linear.datum"}
    assert codes(runs_of(campaign(tmp_path, errors(1), grid))) == {"campaign.no_repeat"}


@pytest.mark.parametrize(
    ("step", "alias_mm"),
    # With the pitch of 0.25 in: a turn is a wave of 6.9 in, or half of one; 0.52 in shows it as 2.4 waves.
    [(0.2593, 6.975), (0.133, 2.078), (0.52, 0.0), (0.096, 0.0)],
)
def test_steps_that_show_the_screw_as_a_long_wave_are_named(tmp_path: Path, step: float, alias_mm: float) -> None:
    targets = 1.0 + step * np.arange(31.0)
    found = [f for r in runs_of(campaign(tmp_path, errors(), targets)) for f in judge_run(r)]
    beats = [f for f in found if f.code == "linear.step_beats_pitch"]
    assert bool(beats) is (alias_mm > 0.0)
    (tmp_path / "better").mkdir()
    (tmp_path / "random").mkdir()
    if beats:
        assert beats[0].numbers["alias_mm"] == pytest.approx(25.4 * alias_mm, rel=0.02)
        better = float(beats[0].message.rpartition("steps of ")[2].removesuffix(" mm")) / 25.4
        fine = runs_of(campaign(tmp_path / "better", errors(), 1.0 + better * np.arange(31.0)))
        assert not codes(fine) & {"linear.step_beats_pitch", "linear.step_divides_pitch"}
    parts = 0.25 * np.random.default_rng(1).uniform(0.0, 0.5, 31)
    assert "linear.step_beats_pitch" not in codes(runs_of(campaign(tmp_path / "random", errors(), targets + parts)))


def test_drift_is_told_from_noise(tmp_path: Path) -> None:
    runs = runs_of(campaign(tmp_path, errors(drift=True), np.linspace(1.0, 16.6, 31)))
    found = judge_campaign(runs)
    assert [f.code for f in found] == ["linear.drift"]
    # A wandering sum adds its own small steps to the reading's 0.76 um.
    assert 0.76 < float(found[0].numbers["noise_um"]) < 1.5  # type: ignore[arg-type]


def test_a_table_must_say_its_directions(tmp_path: Path) -> None:
    folder = campaign(tmp_path, errors(), np.linspace(1.0, 16.6, 31))
    toml = (folder / "campaign.toml").read_text().replace("z.txt", "z.csv")
    (folder / "campaign.toml").write_text(toml)
    table = "t_s,position_mm,direction,error_um\n0,1,forward,2\n1,2,forward,3\n2,2,{},4\n"
    (folder / "z.csv").write_text(table.format("reverse"))
    assert list(runs_of(folder)[0].samples["direction"]) == ["forward", "forward", "reverse"]
    (folder / "z.csv").write_text(table.format("sideways"))
    with pytest.raises(InputError, match="from which side"):
        runs_of(folder)


def test_a_laser_file_without_its_unit_is_refused(tmp_path: Path) -> None:
    folder = campaign(tmp_path, errors(), np.linspace(1.0, 16.6, 31))
    toml = (folder / "campaign.toml").read_text().replace('length_unit = "in"', "")
    (folder / "campaign.toml").write_text(toml)
    with pytest.raises(InputError, match="unit of length"):
        runs_of(folder)


def test_check_gives_the_standard_and_the_four_figures(tmp_path: Path) -> None:
    grid = np.linspace(1.0, 16.6, 61)
    cyclic = 0.0005 * np.sin(2 * np.pi * 2 * np.concatenate([grid, grid[::-1]]) / 0.25)
    result = check_source(campaign(tmp_path, errors(targets=61) + cyclic, grid))
    found = result["positioning"]
    assert found["iso_230_2"]["reversal_um"] == pytest.approx(101.6, abs=4.0)
    four = found["before_after"]
    assert four["max_reversal_error_um"] == pytest.approx(found["iso_230_2"]["reversal_um"])
    assert four["max_average_error_um"] == pytest.approx(found["iso_230_2"]["systematic_um"])
    assert four["cyclic_error_um"] == pytest.approx(25.4, rel=0.1)
    assert four["max_repeat_um"] > four["max_reversal_error_um"]
    text = render_check(result)
    assert "A, bi-directional accuracy" in text
    assert "Max reversal error" in text
    # A page that tells an error of all runs does not say beside it that there is none.
    alone = {**result, "findings": []}
    assert "no error and no warning\n" in render_check(alone)
    told = {**result, "findings": [{"severity": "error", "code": "linear.spoilt_readings", "message": "one"}]}
    assert "no error and no warning in a run alone; of all runs together: 1 error\n" in render_check(told)
    coarse = check_source(campaign(tmp_path, errors(), np.arange(31.0)))["positioning"]
    assert coarse["before_after"]["cyclic_error_um"] is None
