"""Logs of drift: what a displacement follows is told from a machine made here, of rods and housings that warm late."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dtwin.acquire.ingest import ingest, open_source
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.drift._check import drift_figures, judge_campaign_drift, judge_drift
from dtwin.kinds.drift._data import longest_first, of_twin
from dtwin.kinds.drift._diagnosis import diagnose
from dtwin.kinds.drift._held_out import HeldOut
from dtwin.kinds.drift._model import Series, Term, fitted, steady
from dtwin.kinds.drift._read import _read_drift, is_drift_log
from dtwin.kinds.drift._search import additions, idle, missing
from dtwin.kinds.drift._series import series_of
from dtwin.kinds.drift._training import train_drift
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.report.uncertainty import Circumstances
from dtwin.schema import Campaign, Run, RunMeta

HEAD = """[campaign]
name = "log"
machine = "printer"
kind = "drift"
[campaign.instrument.columns]
"frame" = "temperature_frame_c"
"bed" = "temperature_bed_c"
"when" = "t_s"
"""


def machine(seed: int, late_s: float = 900.0, noise_um: float = 1.0) -> tuple[np.ndarray, ...]:
    """Return times, samples, displacement, frame and bed of 6 h: three readings of a sample each minute.

    The frame is warmed by the bed, and its core follows its skin, where the sensor sits, after ``late_s``; a column of 530 mm
    grows with the core by 23.4 µm/(m K), the bed lifts by 2 µm/K. Both are stepped in seconds.
    """
    rng = np.random.default_rng(seed)
    seconds = np.arange(6 * 3600)
    heated = ((seconds > 600) & (seconds < 9000)) | (seconds > 14000)
    bed, skin, core = (np.full(len(seconds), 22.0) for _ in range(3))
    for i in range(1, len(seconds)):
        bed[i] = bed[i - 1] + (((105.0 if heated[i] else 22.0) - bed[i - 1]) / 240.0)
        skin[i] = skin[i - 1] + (0.25 * (bed[i - 1] - 22.0) + 22.0 - skin[i - 1]) / 2500.0
        core[i] = core[i - 1] + (skin[i - 1] - core[i - 1]) / late_s if late_s else skin[i]
    sample = np.arange(len(seconds)) // 60
    read = np.concatenate([np.arange(k, len(seconds), 60) for k in (10, 14, 18)])
    read.sort()
    moved = -530.0 * 23.4e-3 * (core - 22.0) + 2.0 * (bed - 22.0)
    return seconds[read] * 1.0, sample[read], moved[read] + rng.normal(0.0, noise_um, len(read)), skin[read], bed[read]


def series(seed: int, late_s: float = 900.0) -> Series:
    t_s, sample, moved, skin, bed = machine(seed, late_s)
    return Series(t_s, moved, {"temperature_frame_c": skin, "temperature_bed_c": bed}, sample)


def test_the_floor_is_the_scatter_of_readings_at_once() -> None:
    assert series(0).floor_um == pytest.approx(1.0, abs=0.1)


def test_what_follows_at_once_lacks_nothing_and_its_uncertainty_covers_the_truth() -> None:
    inside = 0
    for seed in range(6):
        made = series(seed, late_s=0.0)
        base = steady(made)
        assert {t.channel for t in base.terms} == {"temperature_frame_c", "temperature_bed_c"}
        assert missing(made, base) == []
        told = dict(zip([t.channel for t in base.terms], zip(base.value[1:], base.k2[1:], strict=True), strict=True))
        inside += abs(told["temperature_frame_c"][0] + 530.0 * 23.4e-3) < told["temperature_frame_c"][1]
        inside += abs(told["temperature_bed_c"][0] - 2.0) < told["temperature_bed_c"][1]
    assert inside >= 10


def test_what_follows_late_is_named_with_its_sensor_and_its_time() -> None:
    made = series(3)
    base = steady(made)
    (step, *_) = missing(made, base)
    late = next(t for t in step.fitted.terms if t.kind == "lag")
    assert late.channel == "temperature_frame_c"
    assert 600.0 < late.tau_s < 1400.0
    assert step.fitted.held_out_um < 0.5 * base.held_out_um


def test_a_lag_answers_a_ramp_as_its_differential_equation_does() -> None:
    t_s = np.cumsum([0.0, 10.0, 15.0, 35.0, 1.0, 139.0] * 7)
    ramp = 3.0 + 0.2 * t_s
    made = Series(t_s, ramp, {"temperature_a_c": ramp}, None).column(Term("lag", "temperature_a_c", 30.0))
    assert made == pytest.approx(ramp - 0.2 * 30.0 * (1.0 - np.exp(-t_s / 30.0)))


def _folder(folder: Path, scales: dict[str, float], *, spoilt: str = "", step: str = "") -> Path:
    folder.mkdir()
    text = HEAD
    for n, (name, scale) in enumerate(scales.items()):
        t_s, sample, moved, skin, bed = machine(n)
        if name == spoilt:
            moved[200:] += 900.0
        head = "sample;when;displacement_um;frame;bed;dead"
        rows = np.column_stack([sample, t_s, moved * scale, skin, bed, np.full(len(t_s), -180.0)])
        lines = [";".join(f"{v:.4f}".replace(".", ",") for v in row) for row in rows]
        (folder / f"{name}.csv").write_text("\n".join(["# made here", head, *lines]), encoding="utf-8")
        text += f'[[run]]\nid = "{name}"\nfile = "{name}.csv"\n{step}'
    (folder / "campaign.toml").write_text(
        text.replace('"frame" =', '"dead" = "temperature_dead_c"\n"frame" ='), encoding="utf-8"
    )
    return folder


def _runs(folder: Path) -> list[Run]:
    return [run for runs, _ in open_source(folder)[1] for run in runs]


def test_a_run_in_another_unit_and_a_spoilt_one_are_found(tmp_path: Path) -> None:
    runs = _runs(_folder(tmp_path / "c", {"a": 1.0, "b": 25.4, "c": 1.0}, spoilt="c"))
    assert [[f.code for f in judge_drift(run)] for run in runs] == [[], ["drift.size"], ["drift.jump"]]
    (found,) = judge_campaign_drift(runs)
    assert found.severity == "warning"
    assert "inch and mm" in found.message
    assert "step" not in found.message
    assert found.numbers["ratio_1"] == pytest.approx(25.4, rel=0.06)
    assert {f.code for run in runs for f in run.findings} == {"drift.no_sensor"}
    assert "temperature_dead_c" not in series_of(runs[0]).temperatures_c
    assert judge_campaign_drift(_runs(_folder(tmp_path / "d", {"a": 1.0, "b": 1.0}))) == []


@pytest.mark.parametrize("ratio", [-1.0, 0.33, 5.0, -10.0])
def test_two_probes_of_a_spindle_that_tilts_are_no_error(ratio: float) -> None:
    one = _touched(0.0)
    other = {**one.samples, "displacement_um": ratio * one.samples["displacement_um"]}
    two = replace(one, meta=replace(one.meta, run_id="y2"), samples=other)
    assert judge_campaign_drift([one, two]) == []
    assert len(longest_first([one, two])) == 2


def test_a_log_in_other_steps_than_its_file_states_is_told(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "c", {"a": 1.0, "b": 1.0})
    for name, step in (("a", 0.0025), ("b", 0.0125)):
        text = (folder / f"{name}.csv").read_text("utf-8").replace("displacement_um", "displacement_step")
        (folder / f"{name}.csv").write_text(text.replace("# made here", f"# step_dist={step}"), encoding="utf-8")
    (found,) = judge_campaign_drift(_runs(folder))
    assert found.numbers["ratio_1"] == pytest.approx(5.0, rel=0.1)
    assert "in other steps than are stated" in found.message


def test_a_step_that_the_file_tells_otherwise_is_said(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "c", {"a": 1.0})
    log, told = folder / "a.csv", folder / "campaign.toml"
    text = log.read_text("utf-8").replace("displacement_um", "displacement_step")
    log.write_text(text.replace("# made here", "# step_dist=0.0125"), encoding="utf-8")
    (alone,) = _runs(folder)
    assert {f.code for f in alone.findings} == {"drift.no_sensor"}
    told.write_text(told.read_text("utf-8") + "condition = { step_mm = 0.0025 }\n", encoding="utf-8")
    (run,) = _runs(folder)
    (found,) = (f for f in run.findings if f.code == "drift.step")
    assert "states a step of 0.0025 mm, the file 0.0125" in found.message
    np.testing.assert_allclose(5.0 * run.samples["displacement_um"], alone.samples["displacement_um"])


def test_check_tells_what_is_missing_and_a_campaign_is_ingested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    folder = _folder(tmp_path / "c", {"a": 1.0})
    said = CliRunner().invoke(app, ["check", str(folder)], catch_exceptions=False).output
    assert "missing: the lag of frame" in said
    assert CliRunner().invoke(app, ["ingest", str(folder)], catch_exceptions=False).exit_code == 0
    assert "missing: the lag of frame" in CliRunner().invoke(app, ["check", "log"], catch_exceptions=False).output


@pytest.mark.parametrize(("column", "code"), [("displacement_step", "drift.step"), ("shift", "columns.missing")])
def test_what_is_not_told_is_asked_for(tmp_path: Path, column: str, code: str) -> None:
    folder = _folder(tmp_path / "c", {"a": 1.0})
    file = folder / "a.csv"
    file.write_text(file.read_text(encoding="utf-8").replace("displacement_um", column), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        _runs(folder)
    assert refused.value.code == code


def test_a_model_fits_as_least_squares_do() -> None:
    made = series(1, late_s=0.0)
    terms = [Term("steady", "temperature_frame_c"), Term("steady", "temperature_bed_c")]
    x = np.column_stack([np.ones(len(made.t_s)), *made.temperatures_c.values()])
    assert fitted(made, terms).value == pytest.approx(np.linalg.lstsq(x, made.moved_um, rcond=None)[0], rel=1e-6)


@pytest.mark.parametrize("twice", [False, True], ids=["sensors of their own", "one sensor twice"])
def test_a_column_more_or_less_leaves_what_a_model_with_or_without_it_leaves(twice: bool) -> None:
    rng = np.random.default_rng(0)
    x = np.column_stack([np.ones(150), 20.0 + np.cumsum(rng.normal(0.0, 0.1, (150, 4)), axis=0)])
    y = x @ rng.normal(0.0, 1.0, 5) + rng.normal(0.0, 0.5, 150)
    if twice:
        x[:, 4] = x[:, 2]
    block = np.arange(150) * 7 // 150

    def left(columns: list[int]) -> list[float]:
        squares = []
        for number in range(7):
            held, used = block == number, x[:, columns]
            value = np.linalg.lstsq(used[~held], y[~held])[0]
            squares.append(float(((y[held] - used[held] @ value) ** 2).sum()))
        return squares

    model = HeldOut(x[:, :3], y, block)
    assert model.squares == pytest.approx(left([0, 1, 2]))
    assert model.with_each(x[:, 3:]) == pytest.approx(np.array([left([0, 1, 2, 3]), left([0, 1, 2, 4])]))
    expected = np.array([left([c for c in range(5) if c != column]) for column in range(1, 5)])
    assert HeldOut(x, y, block).without_each(range(1, 5)) == pytest.approx(expected)


def test_of_sensors_that_read_the_same_the_first_is_named_and_the_search_tells_how_far_it_is() -> None:
    made = series(0)
    frame = made.temperatures_c["temperature_frame_c"]
    twice = replace(made, temperatures_c={**made.temperatures_c, "temperature_twin_c": frame.copy()})
    base = steady(twice)
    told: list[tuple[int, int]] = []
    steps = missing(twice, base, lambda done, total, what: told.append((done, total)))
    assert [term.name for term in base.terms] == ["frame", "bed"]
    assert [step.said for step in steps] == ["the lag of frame"]
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1]


def test_a_lag_of_any_time_leaves_no_other_name() -> None:
    # Where the time constant is a little off, the rest looks like a curve of the sensor.
    right = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t_s = 60.0 * np.arange(480.0)
        warm = 6.0 * (1.0 - np.exp(-t_s / 5400.0))
        tau_s = 60.0 * float(rng.uniform(5.0, 90.0))
        late = np.zeros_like(t_s)
        for i in range(1, t_s.size):
            late[i] = late[i - 1] + (warm[i] - late[i - 1]) * -np.expm1(-60.0 / tau_s)
        moved = 1.4 * late + rng.normal(0.0, 0.1, t_s.size)
        made = Series(t_s, moved, {"temperature_spindle_c": 20.0 + warm + rng.normal(0.0, 0.02, t_s.size)}, None)
        right += [step.said for step in missing(made, steady(made))] == ["the lag of spindle"]
    assert right >= 38


def test_foreign_heads_say_by_their_units_what_they_are(tmp_path: Path) -> None:
    t_s, _, moved, skin, bed = machine(0)
    rows = np.column_stack([t_s / 60.0, 0.5 * moved / 1e3, moved, skin, bed, bed, bed, bed])
    lines = [";".join(f"{v:.7f}".replace(".", ",") for v in row) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text(
        "\n".join(["Zeit [min];X [mm];Z [µm];Rahmen [°C];bed_c;A [µm/m];b_urad;C (arcsec)", *lines]), encoding="utf-8"
    )
    x, z = [run for runs, _ in open_source(path, {"machine": "mill-1"})[1] for run in runs]
    assert [(run.meta.run_id, run.meta.condition) for run in (x, z)] == [
        ("log-x", {"axis": "X"}),
        ("log-z", {"axis": "Z"}),
    ]
    assert z.samples["t_s"] == pytest.approx(t_s - t_s[0], abs=1e-4)
    assert z.samples["displacement_um"] == pytest.approx(moved - moved[0], abs=1e-4)
    assert x.samples["displacement_um"] == pytest.approx(0.5 * (moved - moved[0]), abs=1e-3)
    assert {"temperature_rahmen_c", "temperature_bed_c"} <= set(z.samples)
    assert [(f.code, f.message.partition(":")[0]) for f in z.findings] == [
        ("drift.tilts", "A [µm/m], b_urad, C (arcsec)")
    ]
    # Two axes of one machine differ; that is no wrong unit.
    assert judge_campaign_drift([x, z]) == []


@pytest.mark.parametrize(
    "heads", ["t_s,angle_deg,deviation_um,air_c", "t_s,error_x_um,error_y_um,air_c", "position_mm,x_um,air_c"]
)
def test_tables_of_others_with_temperatures_are_left_to_them(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{heads}\n1,2,3,4\n", encoding="utf-8")
    assert not is_drift_log(path)


def test_probes_of_one_axis_are_runs_of_their_own_and_a_time_without_a_unit_is_refused(tmp_path: Path) -> None:
    t_s, _, moved, skin, _ = machine(0)
    rows = np.column_stack([t_s, moved, 2.0 * moved, skin])
    lines = [",".join(f"{v:.6f}" for v in row) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t_s,z1_um,z_end_um,frame_c", *lines]), encoding="utf-8")
    runs = [run for made, _ in open_source(path, {"machine": "m"})[1] for run in made]
    assert [(run.meta.run_id, run.meta.condition) for run in runs] == [
        ("log-z1", {"axis": "Z"}),
        ("log-z_end", {"axis": "Z"}),
    ]
    path.write_text(
        "\n".join(["time,z_um,frame_c", *(",".join([*line.split(",")[::2], "20"]) for line in lines)]), encoding="utf-8"
    )
    with pytest.raises(InputError, match="tell no unit"):
        list(open_source(path, {"machine": "m"})[1])
    path.write_text("\n".join(["t_s,z1_um,frame_c,frame_c", *lines]), encoding="utf-8")
    with pytest.raises(InputError, match="one displacement or temperature"):
        list(open_source(path, {"machine": "m"})[1])


def log(path: Path, stamps: list[str], *, head: str = "timestamp", spindle: list[float] | None = None) -> Path:
    warm = [20.0 + 0.1 * n for n in range(len(stamps))] if spindle is None else spindle
    rows = [f"{s},{0.5 * n},{c},{20 + n % 3}" for n, (s, c) in enumerate(zip(stamps, warm, strict=True))]
    path.write_text("\n".join([f"{head},Z [µm],spindle [°C],air [lbf]", *rows]), encoding="utf-8")
    return path


def read(path: Path) -> Run:
    (run,) = next(iter(open_source(path, {"machine": "mill-7"})[1]))[0]
    return run


@pytest.mark.parametrize(
    ("head", "form"),
    [("Date,Time", "2026-03-02,08:{:02d}:00"), ("Datum", "02.03.2026 08:{:02d}"), ("Time", "3/2/2026 8:{:02d}:00 PM")],
)
def test_stamps_of_loggers_are_read_and_a_log_from_the_newest_on_is_turned(
    tmp_path: Path, head: str, form: str
) -> None:
    stamps = [form.format(n) for n in range(60)]
    run = read(log(tmp_path / "a.csv", stamps, head=head))
    assert run.samples["t_s"] == pytest.approx(60.0 * np.arange(60))
    turned = read(log(tmp_path / "b.csv", stamps[::-1], head=head))
    assert turned.samples["t_s"] == pytest.approx(60.0 * np.arange(60))
    assert turned.samples["displacement_um"][-1] == pytest.approx(-29.5)
    # A clock that was set back.
    with pytest.raises(InputError) as refused:
        read(log(tmp_path / "c.csv", stamps[20:40] + stamps[:40] + stamps[40:], head=head))
    assert (refused.value.code, refused.value.got) == ("drift.clock", "-2340 s after the reading before")


@pytest.mark.parametrize(
    ("head", "stamps"),
    [
        ("Time", [f"11/25/2026 14:{n:02d}:05" for n in range(60)]),
        ("Datum/Uhrzeit", [f'"25.11.2026 14:{n:02d}:05,250"' for n in range(60)]),
        ("Datum", [f"25.11.26 14:{n:02d}" for n in range(60)]),
        ("Uhrzeit", [f"{(23 + (n + 30) // 60) % 24}:{(n + 30) % 60:02d}:05" for n in range(60)]),
        ("Time", [f"{11 + (n + 30) // 60}:{(n + 30) % 60:02d}:05.5 {'AM' if n < 30 else 'PM'}" for n in range(60)]),
        ("Date", [f"{46351.58541 + n / 1440:.8f}" for n in range(60)]),
        ("timestamp", [f"{1_795_000_000 + 60 * n}" for n in range(60)]),
        ("timestamp", [f"{(1_795_000_000 + 60 * n) * 1000}" for n in range(60)]),
        ("epoch", [f"{1_795_000_000 + 60 * n}" for n in range(60)]),
        ("timestamp_ms", [f"{(1_795_000_000 + 60 * n) * 1000}" for n in range(60)]),
        ("time [d]", [f"{0.58541 + n / 1440:.8f}" for n in range(60)]),
        ("Time", [f"{1 + n // 1440}/12/2026 14:{n:02d}:05" for n in range(60)]),
        ("Time [hh:mm:ss]", [f"{n // 60}:{n % 60:02d}:00" for n in range(60)]),
        ("Date (dd-mm-yyyy),Time (UTC)", [f"9-11-2026,08:{n:02d}:00" for n in range(60)]),
        ("Uhrzeit", [f"{8 + n // 60:02d}:{n % 60:02d}" for n in range(60)]),
        ("timestamp", [f"25-Nov-2026 14:{n:02d}:05" for n in range(60)]),
        ("時刻", [f"2026年11月25日 14:{n:02d}:05" for n in range(60)]),
    ],
)
def test_stamps_of_spreadsheets_and_of_the_clock_alone_are_read(tmp_path: Path, head: str, stamps: list[str]) -> None:
    run = read(log(tmp_path / "a.csv", stamps, head=head))
    assert run.samples["t_s"] == pytest.approx(60.0 * np.arange(60), abs=1e-3)


def test_dates_without_times_of_day_are_no_clock(tmp_path: Path) -> None:
    """Nobody knows how long such a log took; its worst hour was the whole of it."""
    path = tmp_path / "a.csv"
    rows = [f"02.03.2026;{0.1 * n:.1f};{20 + 0.01 * n:.2f}" for n in range(120)]
    path.write_text("\n".join(["Datum;Z [µm];T [°C]", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="hardly changes"):
        read(path)


@pytest.mark.parametrize(
    ("head", "stamps", "code"),
    [
        ("Time", [f"{9 + n}/11/2026 08:00:00" for n in range(4)], "time.day_or_month"),
        ("Time", [f"9-{1 + n}-2026" for n in range(12)], "time.day_or_month"),
        ("Time", [f"{0.58541 + n / 1440:.8f}" for n in range(60)], "drift.time"),
        ("Time", [f"{46351.58541 + n / 1440:.8f}" for n in range(60)], "drift.time"),
        ("Time", [f"00:{n:02d}" for n in range(60)], "drift.time"),
    ],
)
def test_stamps_of_two_meanings_are_refused(tmp_path: Path, head: str, stamps: list[str], code: str) -> None:
    with pytest.raises(InputError) as refused:
        read(log(tmp_path / "a.csv", stamps, head=head))
    assert refused.value.code == code


@pytest.mark.parametrize("stamps", [[f"{n}/11/2026 08:00:00" for n in range(9, 21)], ["9/30/2026", "10/1/2026"]])
def test_a_day_above_twelve_settles_the_order_of_a_file(tmp_path: Path, stamps: list[str]) -> None:
    run = read(log(tmp_path / "a.csv", stamps, head="Time"))
    assert run.samples["t_s"] == pytest.approx(86_400.0 * np.arange(len(stamps)))


@pytest.mark.parametrize("head", ["Zeit [h]", "time [min]"])
def test_a_unit_above_stamps_is_not_counted_twice(tmp_path: Path, head: str) -> None:
    run = read(log(tmp_path / "a.csv", [f"02.03.2026 08:{n:02d}" for n in range(60)], head=head))
    assert run.samples["t_s"] == pytest.approx(60.0 * np.arange(60))


@pytest.mark.parametrize("lost", [-127.0, 85.0, 999.9])
def test_a_sensor_that_drops_out_and_one_in_an_unknown_unit_are_told(tmp_path: Path, lost: float) -> None:
    warm = [20.0 + 0.1 * n for n in range(60)]
    warm[10] = warm[11] = warm[40] = lost
    run = read(log(tmp_path / "a.csv", [f"2026-03-02T08:{n:02d}" for n in range(60)], spindle=warm))
    assert run.n_samples == 57
    assert np.abs(run.samples["temperature_spindle_c"] - 23.0).max() < 4.0
    told = {f.code: f.message for f in run.findings}
    assert told["drift.dropout"].startswith("3 readings of temperature_spindle_c")
    assert told["drift.left_out"].startswith("air [lbf]")


@pytest.mark.parametrize(
    ("lost", "at", "code"),
    [
        ("", slice(300, 400), "drift.missing"),
        ("850.0", slice(300, 400), "drift.dropout"),
        ("-127.00", slice(100, 200), "drift.dropout"),
        ("85.0", slice(100, 130), "drift.dropout"),
    ],
)
def test_a_sensor_that_is_lost_for_long_is_told_and_with_it_how_many_rows(
    tmp_path: Path, lost: str, at: slice, code: str
) -> None:
    warm = [f"{20.0 + 0.02 * n:.2f}" for n in range(400)]
    warm[at] = [lost] * len(warm[at])
    rows = [f"{n},{0.1 * n:.1f},{spindle}" for n, spindle in enumerate(warm)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time [min],probe [µm],spindle [°C]", *rows]), encoding="utf-8")
    run = read(path)
    assert run.n_samples == 400 - len(range(400)[at])
    assert run.samples["temperature_spindle_c"].max() < 30.0
    (found,) = (f for f in run.findings if f.code == code)
    assert str(len(range(400)[at])) in found.message
    assert f"from {at.start} to {at.stop - 1} min" in found.message


def test_heads_below_merged_ones_are_joined_and_a_row_without_a_time_is_no_lost_sensor(tmp_path: Path) -> None:
    heads = ["Zeit;Temperatur;;Verlagerung;", ";Spindel 1;Bett;X;Z", "[min];[°C];[°C];[µm];[µm]"]
    rows = [f"{n};{20 + 0.1 * n:.1f};21;0,{n % 3};{n}" for n in range(60)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([*heads, *rows, "Max;;;;59"]), encoding="utf-8")
    campaign = Campaign("a", "m", "drift", "", {})
    across, along = _read_drift(path, campaign, {})[0]
    assert (across.meta.run_id, along.meta.run_id) == ("verlagerung_x", "verlagerung_z")
    assert along.samples["temperature_temperatur_spindel_1_c"][-1] == pytest.approx(25.9)
    assert along.samples["t_s"][-1] == pytest.approx(59 * 60.0)
    assert [f.code for f in along.findings] == []


@pytest.mark.parametrize("head", ["probe [µm]", "Messtaster 1 [µm]", "CH3 [mm]", "Gauge_um"])
def test_a_lone_probe_beside_temperatures_is_a_log_also_below_titles(tmp_path: Path, head: str) -> None:
    path = tmp_path / "a.csv"
    unit_um = 1e3 if "mm" in head else 1.0
    rows = [f"{60 * n},{0.5 * n / unit_um},{20 + 0.1 * n}" for n in range(60)]
    titles = ["Warm-up of spindle,,", "Serial no,4711,"]
    path.write_text("\n".join([*titles, f"time [s],{head},spindle [°C]", *rows, "end of log"]), encoding="utf-8")
    run = read(path)
    assert run.meta.kind == "drift"
    assert run.samples["displacement_um"] == pytest.approx(0.5 * np.arange(60))


@pytest.mark.parametrize(
    "heads", ["t_s,radius [mm],air [°C]", "t_s,a [µm],b [µm],air [°C]", "t_s,runout [µm],air [°C]"]
)
def test_lengths_of_which_none_is_surely_a_probe_are_no_log(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{heads}\n" + f"{','.join('1' for _ in heads.split(','))}\n" * 3, encoding="utf-8")
    assert not is_drift_log(path)


@pytest.mark.parametrize(
    "heads",
    [
        "Zeit in min;Taster in µm;Temperatur in °C",
        "Zeit / min;Taster / µm;Temperatur / °C",
        "Time (minutes);Probe (microns);Temp (deg C)",
        "sep=;\nTime [min];Z [µm];T [°C]",
        "Zeit [min];Sonde 1 [µm];Luft [°C]",
        "time [min];ch1 [µm];room [°C]",
        "Zeit [min];Kanal 1 [µm];Luft [°C]",
        "Zeit [min];Verlagerung [µm];Temperatur [°C]\n;Z;Bett",
        "Zeit [min];Z [0.001 mm];T [°C]",
        "Zeit [min];Messuhr in 1/1000 mm;T [°C]",
        "Zeit;Verlagerung Z;T\nmin;1/1000 mm;°C",
        "Zeit;Z;T;Last;Neigung\nmin;µm;°C;N;µm/m",
        "時間 [分];変位 Z [μm];主軸温度 [℃]",
        "Temps [min];Déplacement Z [µm];Température [°C]",
    ],
)
def test_units_as_people_write_them(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    more = ";1;2" if "Last" in heads else ""
    path.write_text("\n".join([heads, *(f"{n};{n / 2};{20 + n / 10}{more}" for n in range(60))]), encoding="utf-8")
    run = read(path)
    assert run.samples["t_s"] == pytest.approx(60.0 * np.arange(60))
    assert run.samples["displacement_um"] == pytest.approx(0.5 * np.arange(60))
    assert any(name.startswith("temperature_") for name in run.samples)


def test_a_second_displacement_below_the_first_is_refused(tmp_path: Path) -> None:
    lines = []
    for head, start in (("dZ", 0), ("dX", 60)):
        lines += [f"Zeit [min];{head} [µm];T [°C]", *(f"{start + n};{n};20" for n in range(60))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match="second table"):
        read(path)
    # One displacement in two units would be two runs of one name, both read from the last column.
    path.write_text("\n".join(["Zeit [s];Z [µm];Z [mm];T [°C]", *(f"{60 * n};{n};0,250;20" for n in range(60))]))
    with pytest.raises(InputError, match="one displacement"):
        read(path)


@pytest.mark.parametrize(("head", "names"), [("Achse", "XZ"), ("Kanal", "12"), ("Sensor", ("T1", "T2"))])
def test_rows_of_several_channels_in_turn_are_not_read_as_one(tmp_path: Path, head: str, names: str) -> None:
    rows = [f"{n};{name};{n % 7},5;{20 + n / 10:.1f}" for n in range(60) for name in names]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"Zeit [s];{head};Verlagerung [µm];Spindel [°C]", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="several axes, channels") as refused:
        read(path)
    assert refused.value.got == ", ".join(names)
    # Of one channel, or in a state that lasts, they are.
    lasting = [row.replace(f";{names[1]};", f";{names[0]};") for row in rows[:60:2]]
    path.write_text("\n".join([f"Zeit [s];{head};Verlagerung [µm];Spindel [°C]", *lasting]), encoding="utf-8")
    assert read(path).n_samples == 30
    path.write_text("# Soll - Ist\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(InputError, match="target minus actual"):
        read(path)


def test_a_zero_of_a_probe_that_read_nothing_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{0 if n in (0, 40, 41) else n / 2 + 0.1},{20 + n / 10}" for n in range(60)]
    path.write_text("\n".join(["time [min],Z [µm],T [°C]", *rows]), encoding="utf-8")
    run = read(path)
    assert (run.n_samples, run.samples["displacement_um"][0]) == (58, 0.0)
    assert "drift.dropout" in {finding.code for finding in run.findings}
    for other in [
        "correction",
        "compensation",
        "predicted",
        "gefiltert",
        "uncertainty",
        "setpoint",
        "std",
        "command",
        "mean",
        "corrected",
    ]:
        path.write_text("\n".join([f"time [min],Z {other} [µm],T [°C]", *rows]), encoding="utf-8")
        assert not is_drift_log(path), other
    path.write_text("\n".join(["time [min],Z [Nm],T [°C]", *rows]), encoding="utf-8")
    assert not is_drift_log(path)
    for asked in ("frame setpoint", "Target temp"):
        heads = f"time [min],Z [µm],frame [°C],{asked} [°C]"
        path.write_text("\n".join([heads, *(f"{r},20" for r in rows)]), "utf-8")
        assert {n for n in read(path).samples if n.startswith("temperature")} == {"temperature_frame_c"}
    # Another length, whatever its name, is what moves; where the machine stands is not read in its place.
    for other in ("X position", "Z corrected"):
        heads = f"time [min],Dial gauge [µm],frame [°C],{other} [mm]"
        path.write_text("\n".join([heads, *(f"{r},{50 + n % 3}" for n, r in enumerate(rows))]), "utf-8")
        assert not is_drift_log(path), other


@pytest.mark.parametrize("heads", ["Z target [µm],Z [µm]", "Z offset [µm],Z drift [µm]", "Z raw [µm],delta Z [µm]"])
def test_a_target_beside_a_displacement_is_none(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{60 * n},0,{n / 2},{20 + n / 10}" for n in range(60)]
    path.write_text("\n".join([f"time [s],{heads},T [°C]", *rows]), encoding="utf-8")
    assert read(path).samples["displacement_um"][-1] == pytest.approx(29.5)


def test_places_at_which_a_probe_triggers_are_asked_for_their_sign(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{60 * n},{n / 2},{20 + n / 10}" for n in range(60)]
    for head, condition, asked in (
        ("Z trigger [µm]", {}, True),
        ("Z trigger [µm]", {"reads": "displacement"}, False),
        ("Z [µm]", {}, False),
    ):
        path.write_text("\n".join([f"time [s],{head},T [°C]", *rows]), encoding="utf-8")
        (run,) = _read_drift(path, Campaign("a", "m", "drift"), {"condition": condition})[0]
        assert ("drift.reads" in {f.code for f in run.findings}) is asked


@pytest.mark.parametrize(
    ("heads", "drift"),
    [
        ("time [ms],spindle angle [deg],X disp [µm],air [°C]", False),
        ("time [ms],RPM,X disp [µm],air [°C]", False),
        ("time [min],spindle speed [rpm],X [µm],air [°C]", True),
        ("Zeit [min],Drehzahl [1/min],dX [µm],Luft [°C]", True),
    ],
)
def test_a_turning_axis_beside_a_thermometer_is_no_drift_and_a_warm_up_at_a_speed_is(
    tmp_path: Path, heads: str, drift: bool
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([heads, *(f"{n},{n},{n / 2},{20 + n / 10}" for n in range(60))]), encoding="utf-8")
    assert is_drift_log(path) is drift
    assert kind_named("rotation").takes_alone(path) is (not drift)
    if drift:
        assert not any(f.code == "drift.left_out" for f in read(path).findings)


@pytest.mark.parametrize(("order", "step_days"), [("dd/mm/yyyy", 1.0), ("MM/DD/YYYY", 31.0)])
def test_a_head_settles_the_order_of_day_and_month(tmp_path: Path, order: str, step_days: float) -> None:
    run = read(log(tmp_path / "a.csv", ["7/8/2026", "8/8/2026"], head=f"Date ({order})"))
    assert run.samples["t_s"][1] == pytest.approx(86_400.0 * step_days)


def test_positions_beside_temperatures_are_no_displacements(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{100 * (n % 5)},{n / 10},20.1" for n in range(60)]
    path.write_text("\n".join(["time [s],X [mm],dX [µm],T1 [°C]", *rows]), encoding="utf-8")
    assert not is_drift_log(path)


def test_the_axis_of_a_displacement_is_told_by_its_head_and_elapsed_is_a_time(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{n / 2},{n},{20 + n / 10}" for n in range(60)]
    path.write_text("\n".join(["Elapsed time [min],Verlagerung X [µm],dZ [µm],T [°C]", *rows]), encoding="utf-8")
    runs = next(iter(open_source(path, {"machine": "m"})[1]))[0]
    assert [run.meta.condition for run in runs] == [{"axis": "X"}, {"axis": "Z"}]


def _touched(size_um: float, seed: int = 0) -> Run:
    t_s, sample, moved, skin, bed = machine(seed)
    samples = {"t_s": t_s, "sample_1": sample * 1.0, "temperature_frame_c": skin, "temperature_bed_c": bed}
    samples["displacement_um"] = moved + size_um * (t_s > 11_000.0)
    return Run(
        RunMeta(run_id="log", kind="drift", condition={}, sample_rate_hz=float("nan")), samples, source="log.csv"
    )


def test_a_touched_probe_is_told_and_does_not_hide_what_is_late() -> None:
    for seed in range(3):
        run = _touched(60.0, seed)
        (said,) = [f for f in judge_drift(run) if f.code == "drift.touched"]
        assert said.severity == "warning"
        assert "after 184 min" in said.message
        found = missing(series_of(run), steady(series_of(run)))
        assert [step.said for step in found] == ["the lag of frame"]
        (late,) = [n for n, term in enumerate(found[0].fitted.terms) if term.kind == "lag"]
        assert found[0].fitted.terms[late].tau_s == pytest.approx(900.0, rel=0.05)
        assert abs(found[0].fitted.value[late + 1] + 530.0 * 23.4e-3) < 2.0 * found[0].fitted.k2[late + 1]
        assert series_of(run, as_read=True).moved_um == pytest.approx(run.samples["displacement_um"])
    assert not [f for f in judge_drift(_touched(0.0)) if f.code == "drift.touched"]


def test_a_machine_that_stands_still_is_no_probing_that_does_not_repeat() -> None:
    run, rng = _touched(0.0), np.random.default_rng(3)
    still = {**run.samples, "displacement_um": rng.normal(0.0, 0.4, run.n_samples)}
    assert {f.code: f.severity for f in judge_drift(replace(run, samples=still))} == {"drift.still": "info"}
    many = {f"temperature_{n}_c": still["t_s"] for n in range(48)}
    assert "drift.many" in {f.code for f in judge_drift(replace(run, samples=still | many)) if f.severity == "error"}
    # Readings that scatter as much as the machine moves are another matter.
    noisy = {**run.samples, "displacement_um": run.samples["displacement_um"] + rng.normal(0.0, 150.0, run.n_samples)}
    assert ("drift.noise", "error") in {(f.code, f.severity) for f in judge_drift(replace(run, samples=noisy))}


def test_a_pause_is_told() -> None:
    run = _touched(0.0)
    kept = (run.samples["t_s"] < 5000.0) | (run.samples["t_s"] > 8000.0)
    paused = replace(run, samples={name: values[kept] for name, values in run.samples.items()})
    (said,) = [f for f in judge_drift(paused) if f.code == "drift.gap"]
    assert said.numbers["longest_s"] == pytest.approx(3000.0, abs=120.0)
    assert "summer time" not in said.message
    # A place that is read three times, every 340 s, pauses as it was told to.
    at = np.arange(run.n_samples)
    thrice = replace(run, samples={**run.samples, "t_s": 340.0 * (at // 3) + 3.0 * (at % 3)})
    assert "drift.gap" not in {f.code for f in judge_drift(thrice)}


def test_a_sensor_that_steps_alone_is_told() -> None:
    run = _touched(0.0)
    step = 2.0 * (run.samples["t_s"] > 12_500.0)
    names = [name for name in run.samples if name.startswith("temperature_")]
    for stepping, told in ((names[:1], 1), (names[:2], 0)):
        stepped = {name: run.samples[name] + step for name in stepping}
        found = judge_drift(replace(run, samples=run.samples | stepped))
        assert [f.code for f in found].count("drift.sensor_steps") == told


def test_what_follows_a_sensor_that_slipped_is_told_apart_from_the_step() -> None:
    whole = _touched(0.0)
    step = 2.0 * (whole.samples["t_s"] > 12_500.0)
    slipped = replace(
        whole, samples=whole.samples | {"temperature_frame_c": whole.samples["temperature_frame_c"] + step}
    )
    terms = [Term("steady", "temperature_bed_c"), Term("lag", "temperature_frame_c", 900.0)]
    of_whole, of_slipped = (fitted(series_of(run), terms) for run in (whole, slipped))
    assert of_slipped.value[1:] == pytest.approx(of_whole.value[1:], rel=0.01)
    assert of_slipped.left_um == pytest.approx(of_whole.left_um, rel=0.02)


def test_sizes_beside_a_law_that_the_fit_does_not_know_are_as_wide_as_that() -> None:
    # The core is late, and the fit takes the skin at once.
    for seed in range(3):
        model = fitted(series(seed), [Term("steady", "temperature_frame_c"), Term("steady", "temperature_bed_c")])
        off = np.abs(model.value[1:] - [-530.0 * 23.4e-3, 2.0])
        assert (off < model.k2[1:]).all()
        assert (off > model.scatter_k2[1:]).any()
        known = fitted(series(seed, late_s=0.0), model.terms)
        assert known.k2 == pytest.approx(known.scatter_k2)


def test_a_sensor_whose_readings_scatter_is_not_late_for_that() -> None:
    made = series(0, late_s=0.0)
    read = {n: v + np.random.default_rng(1).normal(0.0, 0.1, len(v)) for n, v in made.temperatures_c.items()}
    noisy = replace(made, temperatures_c=read)
    tried = additions(noisy, [Term("steady", channel) for channel in read])
    assert [one.said for one in tried if one.pays] == []


def test_a_pause_of_an_hour_and_a_reading_looks_like_a_clock_that_was_set() -> None:
    run = _touched(0.0)
    t_s = run.samples["t_s"]
    later = replace(run, samples={**run.samples, "t_s": t_s + np.where(t_s > 5000.0, 3600.0, 0.0)})
    (said,) = [f for f in judge_drift(later) if f.code == "drift.gap"]
    assert "summer time" in said.message


def test_what_takes_a_quarter_of_the_squares_is_not_idle_where_more_is_left() -> None:
    # A wave that no sensor knows: stretches of time do not agree on what the sensor takes.
    t_s, sample, moved, skin, bed = machine(1, late_s=0.0)
    waved = moved + 40.0 * np.sin(2.0 * np.pi * t_s / 4700.0)
    log = Series(t_s, waved, {"temperature_frame_c": skin, "temperature_bed_c": bed}, sample)
    frame = Term("steady", "temperature_frame_c")
    without, now = fitted(log, [Term("steady", "temperature_bed_c")]), fitted(log, steady(log).terms)
    assert without.held_out_um > 1.2 * now.held_out_um
    assert frame in now.terms
    assert frame not in idle(log, now.terms)


def test_a_log_without_a_temperature_tells_how_far_it_drifted(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{60 * n},{n // 2},{n / 2:g}" for n in range(120)]
    path.write_text("\n".join(["t_s,sample_1,displacement_um", *rows]), encoding="utf-8")
    told = CliRunner().invoke(app, ["check", str(path), "--machine", "m", "--kind", "drift"], catch_exceptions=False)
    assert re.search(r"range of the drift +59\.", told.output)
    assert "no temperature was logged" in told.output
    assert "R²" not in told.output
    (run,), _ = _read_drift(path, Campaign("c", "m", "drift"), {})
    assert run.samples["sample_1"].tolist() == [n // 2 for n in range(120)]
    path.write_text("\n".join(["t_s,frame,displacement_um", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="lacks columns"):
        _read_drift(path, Campaign("c", "m", "drift"), {})


def test_degrees_that_are_not_known_are_told_where_nothing_else_is(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{60 * n},{n / 2},{290 + n / 10}" for n in range(60)]
    path.write_text("\n".join(["t_s,Z [µm],spindle [K]", *rows]), "utf-8")
    with pytest.raises(InputError, match="lacks columns"):
        next(iter(open_source(path, {"machine": "m"})[1]))
    head = '[campaign]\nname = "c"\nmachine = "m"\nkind = "drift"\n'
    entry = '[[run]]\nid = "r"\nfile = "a.csv"\n'
    (tmp_path / "campaign.toml").write_text(head + entry, encoding="utf-8")
    with pytest.raises(InputError, match="lacks columns") as caught:
        next(iter(open_source(tmp_path)[1]))
    assert "spindle [K]" in str(caught.value.hint)
    named = '[campaign.instrument.columns]\n"spindle [K]" = "temperature_spindle_c"\n'
    (tmp_path / "campaign.toml").write_text(head + named + entry, encoding="utf-8")
    with pytest.raises(InputError, match="in another unit"):
        next(iter(open_source(tmp_path)[1]))


@pytest.mark.parametrize(("factor", "zero", "told"), [(1.0, 0.0, False), (1.8, 32.0, True)])
def test_a_sensor_that_goes_on_in_another_unit_is_told(tmp_path: Path, factor: float, zero: float, told: bool) -> None:
    path = tmp_path / "a.csv"
    read = [20.0 + n / 60.0 for n in range(120)]
    rows = [f"{60 * n},{n / 10},{t if n < 70 else factor * t + zero:.3f}" for n, t in enumerate(read)]
    path.write_text("\n".join(["t_s,Z [µm],spindle [°C]", *rows]), "utf-8")
    ((run,),) = (runs for runs, _ in open_source(path, {"machine": "m"})[1])
    assert told == any(f.code == "drift.sensor_steps" for f in run.findings)


def test_a_logger_writes_colons_behind_heads_and_units_of_some_columns_below(tmp_path: Path) -> None:
    rows = [f"28.03.26\t20:{n:02d}:00\t{20 + n / 10}\t{n / 2}".replace(".", ",") for n in range(60)]
    rows = [row.replace("28,03,26", "28.03.26") for row in rows]
    path = tmp_path / "a.txt"
    path.write_text(
        "\n".join(["ALMEMO 2890", "DATUM:\tZEIT:\tM00: Spindel\tM01: Taster Z", "\t\t°C\tµm", *rows]), "utf-8"
    )
    (run,) = next(iter(open_source(path, {"machine": "m"})[1]))[0]
    assert run.samples["t_s"][-1] == 59 * 60.0
    assert run.samples["displacement_um"][-1] == pytest.approx(29.5)


@pytest.mark.parametrize("unit", ["°F", "F"])
@pytest.mark.parametrize("named", ["", '[campaign.instrument.columns]\n"spindle [°F]" = "temperature_nut_c"\n'])
def test_a_log_in_degrees_fahrenheit_is_one_in_degrees_celsius(tmp_path: Path, named: str, unit: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{60 * n},{n / 2},{68 + 1.8 * n / 10:.6f}" for n in range(60)]
    path.write_text("\n".join([f"t_s,Z [µm],spindle [{unit}]", *rows]), "utf-8")
    (tmp_path / "campaign.toml").write_text(
        f'[campaign]\nname = "c"\nmachine = "m"\nkind = "drift"\n{named.replace("°F", unit)}[[run]]\nid = "r"\nfile = "a.csv"\n',
        encoding="utf-8",
    )
    (run,) = next(iter(open_source(tmp_path)[1]))[0]
    column = "temperature_nut_c" if named else "temperature_spindle_c"
    assert run.samples[column] == pytest.approx(20.0 + 0.1 * np.arange(60))


def test_a_log_that_follows_no_temperature_trains_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    rows = [f"{30 * n + m},{n},{rng.normal(0.0, 0.4)},{20 + n / 300}" for n in range(400) for m in (0, 2)]
    heads = "t_s,sample,displacement_um,temperature_air_c"
    (tmp_path / "a.csv").write_text("\n".join([heads, *rows]), "utf-8")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nname = "c"\nmachine = "m"\nkind = "drift"\n[[run]]\nid = "r"\nfile = "a.csv"\ncondition = { axis = "Z" }\n',
        encoding="utf-8",
    )
    home = Home(tmp_path / "home")
    ingest(tmp_path, Lake(home.lake))
    with pytest.raises(InputError, match="says anything of what moved"):
        train_drift(Lake(home.lake), "c")


def test_a_display_that_shows_whole_micrometres_has_a_floor() -> None:
    run = _touched(0.0)
    # Each sample reads the same three times.
    sample = run.samples["sample_1"].astype(int)
    first = np.unique(sample, return_index=True)[1]
    shown = np.round(run.samples["displacement_um"][first])[np.unique(sample, return_inverse=True)[1]]
    series = series_of(replace(run, samples={**run.samples, "displacement_um": shown}))
    assert series.floor_um == pytest.approx(1.0 / np.sqrt(12.0))
    assert diagnose(series, steady(series).terms).verdict == "missing_effect"
    assert drift_figures([replace(run, samples={**run.samples, "displacement_um": shown})])["log"]["floor_um"] > 0.0


def test_a_probe_that_is_stuck_is_said() -> None:
    run = _touched(0.0)
    stuck = replace(run, samples={**run.samples, "displacement_um": np.zeros(run.n_samples)})
    assert [(f.code, f.severity) for f in judge_drift(stuck)] == [("drift.stuck", "error")]
    assert drift_figures([stuck]) == {"log": None}
    assert kind_named("drift").sheet([stuck], Circumstances()).parts[0].characteristics[0].value_um == 0.0


def test_a_twin_is_not_of_a_log_that_the_others_contradict() -> None:
    runs = [replace(_touched(0.0, seed), meta=replace(_touched(0.0).meta, run_id=f"r{seed}")) for seed in range(3)]
    wrong = {**runs[1].samples, "displacement_um": 25.4 * runs[1].samples["displacement_um"]}
    runs[1] = replace(runs[1], samples=wrong)
    assert {run.meta.run_id for run in longest_first(runs)} == {"r0", "r2"}
    # Of a file with several displacements that which moved most.
    axes = [replace(runs[0], meta=replace(runs[0].meta, run_id=axis, condition={"axis": axis})) for axis in "XZ"]
    axes[0] = replace(axes[0], samples={**axes[0].samples, "displacement_um": 0.2 * axes[0].samples["displacement_um"]})
    assert of_twin(axes).meta.run_id == "Z"


def test_what_fits_short_stretches_by_being_smooth_is_not_named() -> None:
    # A spindle warms for 4 h of 8, in quarters of an hour, a column late behind it. What moves is ahead of the spindle's sensor,
    # which no effect here says; the column has nothing to do with it.
    rng, t_s = np.random.default_rng(6), 30.0 * np.arange(960)
    load = (t_s < 14_400.0) * (0.7 + 0.3 * np.sign(np.sin(2.0 * np.pi * t_s / 5400.0)))
    air = 21.0 + 1.5 * np.sin(2.0 * np.pi * t_s / 43_200.0) + 0.2 * behind(t_s, 3.0 * rng.standard_normal(960), 600.0)
    spindle = air + behind(t_s, 14.0 * load, 1500.0)
    column = behind(t_s, air, 5400.0) + 0.12 * behind(t_s, spindle - air, 3600.0)
    for sensor_s in (200.0, 300.0):
        moved = 2.0 * (spindle - spindle[0]) + rng.normal(0.0, 0.3, 960)
        sensors = {
            "temperature_spindle_c": behind(t_s, spindle, sensor_s) + 0.05 * rng.standard_normal(960),
            "temperature_column_c": column + 0.05 * rng.standard_normal(960),
        }
        log = Series(t_s, moved, sensors, None)
        assert not [one for one in additions(log, [Term("steady", name) for name in sensors]) if one.pays]


def behind(t_s: np.ndarray, values: np.ndarray, tau_s: float) -> np.ndarray:
    """Return what follows values by a first-order lag, stepped in the middle of each pause."""
    out = values.copy()
    for i, pause in enumerate(np.diff(t_s)):
        out[i + 1] = out[i] + (0.5 * (values[i] + values[i + 1]) - out[i]) * (1.0 - np.exp(-pause / tau_s))
    return out


@pytest.mark.parametrize(("from_then_on", "said"), [(None, ""), ("25.00", "stuck"), ("85.0", "DS18B20"), ("still", "")])
def test_a_sensor_that_stands_to_the_end_while_another_moves_on_is_suspect(
    tmp_path: Path, from_then_on: str | None, said: str
) -> None:
    rng = np.random.default_rng(3)
    warm = 20.0 + 10.0 * (1.0 - np.exp(-np.arange(300) / 90.0)) + 0.02 * rng.normal(size=300)
    spindle, frame = [f"{t:.2f}" for t in warm], [f"{20.0 + 0.5 * (t - 20.0):.2f}" for t in warm]
    if from_then_on == "still":
        spindle[150:], frame[150:] = ["28.00"] * 150, ["24.00"] * 150
    elif from_then_on:
        spindle[150:] = [from_then_on] * 150
    rows = [f"{n},{0.1 * n:.1f},{a},{b}" for n, (a, b) in enumerate(zip(spindle, frame, strict=True))]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time [min],probe [µm],spindle [°C],frame [°C]", *rows]), encoding="utf-8")
    found = [f.message for f in read(path).findings if f.code == "drift.sensor_stands"]
    assert len(found) == bool(said)
    assert all(said in message and "from 150 to 299 min" in message for message in found)


@pytest.mark.parametrize(
    ("standing", "warming", "told"), [(True, True, True), (False, True, False), (True, False, False)]
)
def test_a_probe_that_stands_while_temperatures_move_on_is_suspect(
    tmp_path: Path, standing: bool, warming: bool, told: bool
) -> None:
    rng = np.random.default_rng(3)
    warm = 20.0 + 10.0 * (1.0 - np.exp(-np.arange(300) / (200.0 if warming else 5.0)))
    moved = 5.0 * (warm - 20.0) + 0.2 * rng.normal(size=300)
    moved[150:] = moved[150] if standing else moved[150:]
    path = tmp_path / "a.csv"
    rows = [f"{n},{a:.2f},{b:.3f}" for n, (a, b) in enumerate(zip(moved, warm, strict=True))]
    path.write_text("\n".join(["time [min],probe [µm],spindle [°C]", *rows]), encoding="utf-8")
    assert ("drift.probe_stands" in {finding.code for finding in judge_drift(read(path))}) is told


def test_a_displacement_without_readings_is_told_with_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{'' if n >= 200 else n / 10},{20 + n / 100}" for n in range(300)]
    path.write_text("\n".join(["time [min],probe [µm],spindle [°C]", *rows]), encoding="utf-8")
    (said,) = [finding.message for finding in read(path).findings if finding.code == "drift.missing"]
    assert said.startswith("the displacement has no reading in 100 of 300 rows")


def test_sensors_in_rows_of_their_own_are_read_between_these(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},,{20 + 0.01 * n:g}" if n % 10 == 0 else f"{n},{0.05 * n:g}," for n in range(401)]
    path.write_text("\n".join(["time [s],z [um],frame [C]", *rows]), encoding="utf-8")
    run = read(path)
    assert run.n_samples == 360
    assert run.samples["temperature_frame_c"] == pytest.approx([20 + 0.01 * n for n in range(401) if n % 10])
    assert {f.code for f in run.findings} == {"drift.between"}


@pytest.mark.parametrize(
    ("form", "stamp"),
    [
        ("hh:mm:ss", "08:{:02d}:00"),
        ("[TT.MM.JJJJ hh:mm]", "02.03.2026 08:{:02d}"),
        ("hh:mm", "00:{:02d}"),
        ("min", "{}"),
    ],
)
def test_the_form_of_times_may_stand_in_the_row_of_units(tmp_path: Path, form: str, stamp: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{stamp.format(n)};0,{n:02d};0,1;2{n % 10},5" for n in range(60)]
    path.write_text(
        "\n".join(["Log;;;", "Zeit;X;Z;Spindel", f"{form};µm;µm;°C", *rows, ";;;", "Ende;;;"]), encoding="utf-8"
    )
    assert is_drift_log(path)
    runs, _ = _read_drift(path, Campaign("c", "m", kind="drift"), {})
    assert [run.meta.run_id for run in runs] == ["x", "z"]
    assert runs[0].samples["t_s"][-1] == 59 * 60.0
    assert not {finding.code for finding in runs[0].findings}


@pytest.mark.parametrize(("head", "seconds"), [("minutes", 60.0), ("Stunden", 3600.0)])
def test_a_head_that_is_nothing_but_a_unit_of_time_is_one_of_times(tmp_path: Path, head: str, seconds: float) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{head},Z [µm],spindle [°C]\n" + "\n".join(f"{n},{n},2{n}" for n in range(5)), encoding="utf-8")
    assert is_drift_log(path)
    (run,) = _read_drift(path, Campaign("a", "m", "drift"), {})[0]
    assert run.samples["t_s"].tolist() == [n * seconds for n in range(5)]


def test_a_spindle_s_speed_beside_a_warm_up_and_a_time_that_elapsed_are_of_a_drift_log(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"0:{n:02d}:00,8000,{n},2{n % 10}" for n in range(10)]
    path.write_text("\n".join(["elapsed,speed [rpm],Z [µm],spindle [°C]", *rows]), encoding="utf-8")
    assert is_drift_log(path)
    (run,) = _read_drift(path, Campaign("a", "m", "drift"), {})[0]
    assert run.samples["t_s"].tolist() == [60.0 * n for n in range(10)]


def _two_causes(seed: int) -> Series:
    """A spindle that is followed 25 min late by 1.2 µm/K, and a room at once by -3 µm/K."""
    rng = np.random.default_rng(seed)
    fine_s = np.arange(0.0, 36_000.0, 5.0)
    runs = np.where((fine_s // 5400.0) % 2 == 0, 1.0, 0.2)
    hot, late = np.full(fine_s.size, 21.0), np.full(fine_s.size, 21.0)
    for i in range(1, fine_s.size):
        hot[i] = hot[i - 1] + (21.0 + 14.0 * runs[i - 1] - hot[i - 1]) * -np.expm1(-5.0 / 1500.0)
        late[i] = late[i - 1] + (0.5 * (hot[i - 1] + hot[i]) - late[i - 1]) * -np.expm1(-5.0 / 1500.0)
    t_s, spindle, core = (values[::12] for values in (fine_s, hot, late))
    room = 20.0 + 1.5 * np.sin(2.0 * np.pi * t_s / 40_000.0 + 0.3 * seed)
    moved = np.repeat(1.2 * (core - 21.0) - 3.0 * (room - 20.0), 2) + rng.normal(0.0, 0.15, 2 * t_s.size)
    again = np.repeat(np.arange(t_s.size), 2)
    temperatures = {"temperature_spindle_c": spindle[again], "temperature_room_c": room[again]}
    return Series(np.repeat(t_s, 2) + np.tile([0.0, 2.0], t_s.size), moved, temperatures, again)


@pytest.mark.parametrize("seed", range(3))
def test_two_causes_are_found_together_with_the_time_and_its_uncertainty(seed: int) -> None:
    made = _two_causes(seed)
    last = missing(made, steady(made))[-1].fitted
    by_name = {term.name: n for n, term in enumerate(last.terms)}
    spindle, room = by_name["spindle"], by_name["room"]
    assert len(last.terms) == 2
    assert last.terms[spindle].kind == "lag"
    assert last.value[[1 + spindle, 1 + room]] == pytest.approx([1.2, -3.0], rel=0.03)
    assert abs(last.terms[spindle].tau_s - 1500.0) < 2.0 * last.late_k2_s[spindle] < 200.0
    assert last.late_k2_s[room] == 0.0
    assert last.held_out_um < 0.2


def test_what_a_sensor_that_stands_leaves_is_no_lag(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, 21_600.0, 60.0)
    warm = 14.0 * (1.0 - np.exp(-t_s / 4000.0)) + 2.0 * np.sin(t_s / 1500.0)
    column = 20.0 + 0.1 * warm + rng.normal(0.0, 0.05, t_s.size)
    spindle = 21.0 + np.where(t_s < 8000.0, warm, warm[t_s < 8000.0][-1])
    head = "Time [s],Z [µm],spindle [°C],column [°C]"
    rows = zip(t_s, 1.3 * warm, spindle, column, strict=True)
    path = tmp_path / "stuck.csv"
    path.write_text("\n".join([head, *(",".join(f"{v:.3f}" for v in row) for row in rows)]), encoding="utf-8")
    runs = [run for runs, _ in open_source(path, {"machine": "mill-1"})[1] for run in runs]
    assert "drift.sensor_stands" in {f.code for f in runs[0].findings}
    (told,) = drift_figures(runs).values()
    assert told is not None
    assert told["missing"] == []
    assert "a sensor stands" in told["verdict"]


def test_a_term_whose_coefficient_is_less_than_its_uncertainty_is_not_named() -> None:
    for seed in range(3):
        made = _two_causes(seed)
        for one in additions(made, [Term("steady", "temperature_room_c")]):
            model = fitted(made, one.terms)
            at = 1 + model.terms.index(one.added)
            assert not (one.pays and one.sure) or abs(model.value[at]) > model.k2[at]


def test_a_sensor_that_stands_in_for_a_second_lag_is_not_named() -> None:
    made = _two_causes(0)
    once = replace(made, moved_um=made.column(Term("lag", "temperature_spindle_c", 900.0)))
    again = {**made.temperatures_c, "temperature_spindle_c": once.moved_um}
    late = replace(made, temperatures_c=again).column(Term("lag", "temperature_spindle_c", 900.0))
    noise = np.random.default_rng(5).normal(0.0, 0.15, late.size)
    found = missing(second := replace(made, moved_um=1.4 * late + noise), steady(second))
    assert {term.name for term in found[-1].fitted.terms} == {"spindle"}
    assert [step.said for step in found] == ["the lag of spindle", "a second lag of spindle"]
