from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire._lone_table import open_table
from dtwin.acquire._trace_json import read_trace_json
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.ingest import ingest, open_source
from dtwin.acquire.quality import judge_run
from dtwin.acquire.signal_files import write_signals
from dtwin.errors import InputError
from dtwin.lake.parquet import table_of, write_parquet
from dtwin.lake.store import Lake
from dtwin.report.checking import check_source
from dtwin.schema import SignalGroup

HEAD = '[campaign]\nname = "c"\nmachine = "m"\nkind = "circular"\n'


def csv_rows(n: int = 200) -> str:
    angle = np.linspace(0, 360, n)
    rows = [f"{i / 100},{a},{np.sin(i / 9)}" for i, a in enumerate(angle)]
    return "t_s,angle_deg,deviation_um\n" + "\n".join(rows) + "\n"


def folder(tmp_path: Path, run: str, files: dict[str, str] | None = None) -> Path:
    for name, content in (files or {"r1.csv": csv_rows()}).items():
        (tmp_path / name).write_text(content)
    (tmp_path / "campaign.toml").write_text(HEAD + run)
    return tmp_path


RUN = '[[run]]\nid = "r1"\nfile = "r1.csv"\nplane = "XY"\nradius_mm = 100.0\nfeed_mm_min = 2000.0\ndirection = "CCW"\n'


@pytest.mark.parametrize(
    ("direction", "reading", "said"),
    [
        ("[]", "1.0", "direction"),
        ("0", "1" + "0" * 400, "finite"),
        ("0", "1" + "0" * 5000, "readable"),
        ("0", "1e308", "no size"),
    ],
)
def test_odd_numbers_of_a_trace_are_refused_in_words(tmp_path: Path, direction: str, reading: str, said: str) -> None:
    trace = tmp_path / "t.json"
    trace.write_text(
        f'{{"ErrorUnits": "millimetres", "Runs": [{{"Direction": {direction}, "Readings": [1, 2, {reading}]}}]}}'
    )
    with pytest.raises(InputError, match=said):
        read_trace_json(trace)


def test_words_where_a_unit_is_read_are_refused(tmp_path: Path) -> None:
    source = open_campaign(folder(tmp_path, RUN + '[run.condition]\ntime_h = "six"\nmade_in = "free"\n'))
    with pytest.raises(InputError, match=r"condition\.time_h"):
        source.read(source.entries[0])


def test_a_number_of_thousands_of_digits_in_a_campaign_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not readable"):
        open_campaign(folder(tmp_path, RUN + f"repeat = {'9' * 5000}\n"))


def test_csv_json_parquet_and_b5r_go_the_same_way(tmp_path: Path, real_recording: Path) -> None:
    shutil.copy(real_recording, tmp_path / "real.b5r")
    trace = {"ErrorUnits": "millimetres", "Runs": [{"Direction": 0, "Readings": [0.001 * i for i in range(300)]}]}
    (tmp_path / "t.json").write_text(json.dumps(trace))
    n = 50
    write_parquet(
        tmp_path / "p.parquet",
        table_of(
            {"t_s": np.arange(n) / 10, "angle_deg": -np.linspace(0, 360, n), "deviation_um": np.sin(np.arange(n))}
        ),
    )
    write_signals(tmp_path / "s.parquet", SignalGroup("accelerometers", 1651.6, {"wrist_x_g": np.ones(9)}))
    more = (
        '[[run]]\nid = "real"\nfile = "real.b5r"\n'
        '[[run]]\nid = "t"\nfile = "t.json"\nplane = "XY"\nradius_mm = 150.0\nfeed_mm_min = 3000.0\ndirection = "CCW"\nsample_rate_hz = 100.0\n'
        '[[run]]\nid = "p"\nfile = "p.parquet"\nplane = "XZ"\nradius_mm = 100.0\nfeed_mm_min = 2000.0\ndirection = "CCW"\nsignals = "s.parquet"\n'
        "[run.covariates]\ntemperature_c = 21.5\n"
    )
    lake = Lake(tmp_path / "lake")
    report = ingest(folder(tmp_path, RUN + more), lake)
    assert sorted(report.added) == ["p", "r1", "real-ccw", "real-cw", "t"]
    rows = {row["run_id"]: row for row in lake.runs("c")}
    assert rows["real-cw"]["direction"] == "CW"
    assert rows["real-cw"]["n_errors"] == 2
    # XZ is ZX seen from the other side.
    assert (rows["p"]["plane"], rows["p"]["direction"]) == ("ZX", "CW")
    p = lake.load(rows["p"])
    assert p.meta.covariates == {"temperature_c": 21.5}
    assert p.signals[0].name == "accelerometers"
    assert lake.load(rows["t"]).samples["deviation_um"][1] == pytest.approx(1.0)
    assert ingest(tmp_path, lake).added == ()


def test_bad_rows_are_rejected_and_kept(tmp_path: Path) -> None:
    lines = csv_rows().splitlines()
    lines[5] = "0.04,5.0,nan"
    lines[9] = "0.08,inf,1.0"
    lake = Lake(tmp_path / "lake")
    report = ingest(folder(tmp_path, RUN, {"r1.csv": "\n".join(lines)}), lake)
    assert report.rejected_rows == 2
    reasons = [row["reason"] for row in lake.tables["rejects"].read().to_pylist()]
    assert reasons == ["no usable number: deviation_um", "no usable number: angle_deg"]
    assert lake.load(lake.runs()[0]).n_samples == 198


@pytest.mark.parametrize(
    ("run", "files", "code"),
    [
        ('[[run]]\nid = "../r"\nfile = "r1.csv"\n', None, "name.invalid"),
        ('[[run]]\nid = "r1"\nfile = "../../etc/passwd"\n', None, "campaign.escape"),
        ('[[run]]\nid = "r1"\nfile = "/etc/passwd"\n', None, "campaign.escape"),
        ('[[run]]\nid = "r1"\nfile = "nothing.csv"\nplane="XY"\ndirection="CW"\n', None, "file.missing"),
        (RUN + RUN, None, "ingest.duplicate_run"),
        (RUN.replace('direction = "CCW"\n', ""), None, "run.direction"),
        (RUN.replace('plane = "XY"\n', ""), None, "run.plane"),
        (RUN.replace('"XY"', '"XX"'), None, "run.plane"),
        (RUN.replace("100.0", "-5.0"), None, "campaign.value"),
        (RUN.replace("100.0", "1e-300"), None, "campaign.value"),
        (RUN.replace("100.0", "true"), None, "campaign.value"),
        (RUN.replace("100.0", "1" + "0" * 400), None, "campaign.value"),
        *(
            (RUN + f"{text}\n", None, "campaign.value")
            for text in (
                'repeat = "abc"',
                "repeat = 1e20",
                "repeat = inf",
                "repeat = true",
                'condition = "x"',
                "condition = {at = 2026-03-02}",
                f"covariates = {{load_kg = 1{'0' * 400}}}",
                "covariates = {load_kg = inf}",
                "started = [1, 2]",
                'started = "yesterday"',
            )
        ),
        (RUN + "covariates = {warmth = 20.5}\n", None, "units.unknown"),
        (RUN.replace('"r1"', '"CON"'), None, "name.invalid"),
        (RUN + "feeed = 3\n", None, "campaign.run"),
        (RUN, {"r1.csv": "t_s,angle_deg,deviation\n0,0,0\n"}, "columns.missing"),
        (
            RUN,
            {"r1.csv": csv_rows().replace("t_s,", "t_s,").replace("deviation_um", "deviation_um,warmth", 1)},
            "table.malformed",
        ),
        (RUN, {"r1.csv": "t_s,angle_deg,deviation_um,warmth\n0,0,0,1.5\n1,1,1,1.5\n"}, "units.unknown"),
        (RUN, {"r1.csv": "t_s,angle_deg,deviation_um\nnan,nan,nan\n"}, "table.no_rows"),
        (RUN, {"r1.csv": ""}, "file.empty"),
        ("run = 3", None, "campaign.toml"),
        ("", None, "campaign.toml"),
        ("[[run", None, "campaign.toml"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_stored(
    tmp_path: Path, run: str, files: dict[str, str] | None, code: str
) -> None:
    lake = Lake(tmp_path / "lake")
    with pytest.raises(InputError) as caught:
        ingest(folder(tmp_path, run, files), lake)
    assert caught.value.code == code
    assert lake.runs() == []


def test_a_pipe_is_no_file_of_a_campaign(tmp_path: Path) -> None:
    made = folder(tmp_path, RUN + 'signals = "pipe.parquet"\n')
    os.mkfifo(made / "pipe.parquet")
    with pytest.raises(InputError, match="a device or a pipe"):
        open_campaign(made)


def test_a_link_that_leads_to_itself_is_no_file_of_a_campaign(tmp_path: Path) -> None:
    made = folder(tmp_path, RUN)
    (made / "r1.csv").unlink()
    (made / "r1.csv").symlink_to("r1.csv")
    with pytest.raises(InputError) as caught:
        ingest(made, Lake(tmp_path / "lake"))
    assert caught.value.code == "file.missing"


def test_a_contradiction_between_toml_and_file_is_a_finding(tmp_path: Path, real_recording: Path) -> None:
    shutil.copy(real_recording, tmp_path / "real.b5r")
    run = '[[run]]\nid = "real"\nfile = "real.b5r"\nfeed_mm_min = 3000.0\n'
    opened = open_campaign(folder(tmp_path, run, {}))
    runs, _ = opened.read(opened.entries[0])
    assert [f.code for f in runs[0].findings] == ["campaign.contradiction"]
    assert runs[0].meta.feed_mm_min == 5000.0


def test_comments_before_the_header_and_the_dialect_of_spreadsheets_are_read(tmp_path: Path) -> None:
    lines = ["# probe 7", "# 20 °C, kept; by hand", "t_s;angle_deg;deviation_um"]
    lines += [f"{i * 0.01:.2f};{i * 0.5:.1f};{i % 7 - 3:.2f}".replace(".", ",") for i in range(721)]
    (tmp_path / "a.csv").write_text("\n".join(lines), encoding="utf-8")
    told = {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1000.0}
    ((run,),) = [runs for runs, _ in open_source(tmp_path / "a.csv", told)[1]]
    assert run.samples["deviation_um"][:3].tolist() == [-3.0, -2.0, -1.0]
    assert run.meta.direction == "CCW"


def test_a_campaign_file_of_windows_is_read_and_a_mistyped_setting_is_refused(tmp_path: Path) -> None:
    where = folder(tmp_path, RUN)
    text = HEAD + RUN
    (where / "campaign.toml").write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert [entry.run_id for entry in open_campaign(where).entries] == ["r1"]
    (where / "campaign.toml").write_text(text.replace("[campaign]\n", '[campaign]\nstartet = "2026-03-02"\n'))
    with pytest.raises(InputError) as refused:
        open_campaign(where)
    assert (refused.value.code, refused.value.got) == ("campaign.setting", "startet")
    (where / "campaign.toml").write_text(text.replace("[campaign]\n", '[campaign]\noperator = "A. B."\n'))
    with pytest.raises(InputError, match=r"operator belongs in \[campaign.instrument\]"):
        open_campaign(where)


@pytest.mark.parametrize(
    ("table", "setting", "meant"),
    [
        ("[campaign.instrument]", "uncertanty_um", "uncertainty_um"),
        ("[campaign.instrument]", "nominal", "nominal_mm"),
        ("[campaign.instrument]", "Calibration_um", "calibration_um"),
        ("[campaign.instrument]", "calibration-um", "calibration_um"),
        ("[campaign.machine_geometry]", "screw_ptich_mm", "screw_pitch_mm"),
        ("[campaign.machine_geometry]", "screw_pitch_in", "screw_pitch_mm"),
        ("[run.condition]", "axsi", "axis"),
    ],
)
def test_a_mistyped_setting_of_a_table_with_notes_is_refused(
    tmp_path: Path, table: str, setting: str, meant: str
) -> None:
    lines = f"{table}\n{setting} = 0.5\n"
    told = RUN + lines if "run" in table else lines + RUN
    with pytest.raises(InputError, match="nearly one that is read") as refused:
        [run for runs, _ in open_campaign(folder(tmp_path, told)) for run in runs]
    assert refused.value.code == "campaign.setting"
    assert f".{meant};" in str(refused.value.hint)
    assert f"did you mean: {meant}" in refused.value.render()


def test_each_kind_names_what_it_reads_and_another_one_takes_the_same_as_a_note(tmp_path: Path) -> None:
    of_run = "[run.condition]\nfrequncy_hz = 5.0\n"
    ((runs, _),) = open_campaign(folder(tmp_path, RUN + of_run))
    assert runs[0].meta.condition == {"frequncy_hz": 5.0}
    (tmp_path / "campaign.toml").write_text(HEAD.replace("circular", "sinusoidal") + RUN + of_run)
    with pytest.raises(InputError, match="nearly one that is read") as refused:
        [run for runs, _ in open_campaign(tmp_path) for run in runs]
    assert "condition.frequency_hz;" in str(refused.value.hint)


def test_notes_of_instrument_machine_and_run_are_free(tmp_path: Path) -> None:
    notes = (
        '[campaign.instrument]\nbought = 2019\ncable = "blue"\nserial = "B1"\n'
        '[campaign.machine_geometry]\nhall = "north"\nspindle_rpm = 8000\n'
    )
    of_run = "[run.condition]\nspeed_mm_min = 3000\namplitude_mm = 0.1\ntime_s = 4.0\nload_kg = 20\n"
    ((runs, _),) = open_campaign(folder(tmp_path, notes + RUN + of_run))
    assert runs[0].meta.condition == {"speed_mm_min": 3000, "amplitude_mm": 0.1, "time_s": 4.0, "load_kg": 20}


def test_a_broken_off_circle_hides_nothing_of_the_others_and_absurd_numbers_are_left_out(tmp_path: Path) -> None:
    angle = np.linspace(0.0, 360.0, 721)
    whole = [f"{0.01 * n:.2f},{a:.4f},{np.sin(n):.3f}" for n, a in enumerate(angle)]
    head = "t_s,angle_deg,deviation_um\n"
    (tmp_path / "off.csv").write_text(head + "\n".join(whole[:2]))
    entry = RUN.replace('"r1"', '"off"').replace("r1.csv", "off.csv")
    whole[3] = f"0.03,{angle[3]},1e300"
    where = folder(tmp_path, RUN + entry, {"r1.csv": head + "\n".join(whole)})
    checked = check_source(where)
    first, second = checked["runs"]
    assert first["by_file_indices"]["circular_deviation_um"] < 10.0
    assert "by_file_indices" not in second
    assert [f["code"] for f in second["findings"]] == ["angle.short"]
    assert any(n.startswith("off is not evaluated: ") for n in checked["sheet"]["notes"])
    assert checked["sheet"]["parts"]


@pytest.mark.parametrize("rate", ["0.0", "-1.0", '"fast"'])
def test_a_sample_rate_that_is_none_is_refused_beside_a_clock(rate: str, tmp_path: Path) -> None:
    source = open_campaign(folder(tmp_path, f"{RUN}sample_rate_hz = {rate}\n"))
    with pytest.raises(InputError, match="sample_rate_hz"):
        source.read(source.entries[0])


@pytest.mark.parametrize(("turn", "direction"), [(1.0, "CCW"), (-1.0, "CW")])
def test_the_direction_of_an_angle_that_wraps_is_that_of_its_steps(tmp_path: Path, turn: float, direction: str) -> None:
    angle = (turn * np.linspace(0.0, 360.0, 721) + 180.0) % 360.0 - 180.0
    rows = "\n".join(f"{0.01 * n:.2f},{a:.4f},1.0" for n, a in enumerate(angle))
    path = tmp_path / "wraps.csv"
    path.write_text(f"t_s,angle_deg,deviation_um\n{rows}\n")
    source = open_table(path, {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 2000.0})
    (run,) = source.read(source.entries[0])[0]
    assert run.meta.direction == direction
    assert not {"angle.direction", "angle.jump"} & {finding.code for finding in judge_run(run)}
    assert [finding.code for finding in run.findings] == ["angle.unwrapped"]
    assert np.diff(run.samples["angle_deg"]) == pytest.approx(0.5 * turn, abs=1e-3)


def test_an_angle_that_jumps_by_less_than_a_turn_stays_as_it_is(tmp_path: Path) -> None:
    angle = np.linspace(0.0, 360.0, 721) - 200.0 * (np.arange(721) > 400)
    rows = "\n".join(f"{0.01 * n:.2f},{a:.4f},1.0" for n, a in enumerate(angle))
    source = open_campaign(folder(tmp_path, RUN, {"r1.csv": f"t_s,angle_deg,deviation_um\n{rows}\n"}))
    (run,) = source.read(source.entries[0])[0]
    assert "angle.jump" in {finding.code for finding in judge_run(run)}
    assert not run.findings
