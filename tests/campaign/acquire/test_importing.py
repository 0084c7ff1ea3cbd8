"""Foreign tables: what they are taken for, the folder made of them, and what is remembered."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from dtwin.acquire.importing import understand, write_folder
from dtwin.acquire.ingest import open_source
from dtwin.acquire.table_dialect import decoded, rows_of
from dtwin.cli import app
from dtwin.config import Home
from dtwin.errors import InputError

CIRCLE = {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1000.0, "machine": "mill-7"}


def circle(n: int = 400, *, below: bool = True) -> str:
    """A German table: title, semicolons, decimal commas, units in a row below."""
    t = np.arange(n) * 0.1
    phi, dev = 0.9 * np.arange(n) + 0.5, 0.004 * np.sin(np.arange(n))
    cells = [[f"{v:.6f}".replace(".", ",") for v in row] for row in zip(t, phi, dev, 20.0 + 0 * t, strict=True)]
    heads = ["Zeit;Winkel;Abweichung;Luft;Bemerkung", "s;°;mm;°C;"]
    if not below:
        heads = ["Zeit [s];Winkel [°];Abweichung (mm);Luft [°C];Bemerkung"]
    return "\r\n".join(["Kreisformtest Müller", *heads, *(";".join([*row, "gut"]) for row in cells)]) + "\r\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("below", [True, False])
def test_a_german_table_of_a_circle(tmp_path: Path, encoding: str, below: bool) -> None:
    path, home = tmp_path / "Kreis 1.csv", Home(tmp_path / "home")
    path.write_bytes(circle(below=below).encode(encoding))
    first = understand(path, home, {}, {})
    assert (first.missing, first.runs, first.skipped, first.mark) == (("plane", "radius_mm", "feed_mm_min"), (), 1, ";")
    assert [c.name for c in first.columns] == ["t_s", "angle_deg", "deviation_um", "luft_c", ""]
    assert not home.root.exists()
    found = understand(path, home, CIRCLE, {})
    write_folder(found, tmp_path / "c", home)
    campaign, sources, _ = open_source(tmp_path / "c")
    (run,) = next(iter(sources))[0]
    assert (campaign.machine, run.meta.plane, run.meta.direction, run.meta.radius_mm) == ("mill-7", "XY", "CCW", 100.0)
    assert (tmp_path / "c" / "campaign.toml").read_text("utf-8").startswith('# dtwin import "Kreis 1.csv", sha256 ')
    np.testing.assert_allclose(run.samples["deviation_um"], 4.0 * np.sin(np.arange(400)), atol=1e-3)
    # The next file with this header needs no answers.
    later = tmp_path / "later.csv"
    later.write_bytes(circle(300, below=below).encode(encoding))
    again = understand(later, home, {"feed_mm_min": 2000.0}, {})
    assert again.remembered
    assert (again.told["plane"], again.told["feed_mm_min"], again.runs) == ("XY", 2000.0, (("later", 300),))


@pytest.mark.parametrize(
    ("title", "way"), [("Lauf rechts", "CW"), ("Direction: CW", "CW"), ("im Gegenuhrzeigersinn", "CCW")]
)
def test_titles_tell_the_direction_of_columns_that_are_told(tmp_path: Path, title: str, way: str) -> None:
    path, home = tmp_path / "k.csv", Home(tmp_path / "home")
    path.write_text(circle().replace("Kreisformtest Müller", title), encoding="utf-8")
    found = understand(path, home, CIRCLE, {"Abweichung": "deviation_um", "Luft": ""})
    assert found.told["direction"] == way
    # The angle rises whichever way it was, as in a table that was sorted; the form of the workbench says the direction again.
    sortd = "Phi;Wert\n" + "\n".join(f"{n},5;0,00{n % 7}" for n in range(360))
    path.write_text(f"{title}\n{sortd}", encoding="utf-8")
    for stated in ({}, {"direction": way}):
        again = understand(path, home, CIRCLE | stated, {"Phi": "angle_deg", "Wert": "deviation_um"})
        assert again.runs == ((f"k-{way.lower()}1", 360),)
    other = {"direction": "CCW" if way == "CW" else "CW"}
    for stated in (other, {"radius_mm": 150.0}):
        path.write_text(circle().replace("Kreisformtest Müller", f"Radius 100 mm\n{title}"), encoding="utf-8")
        with pytest.raises(InputError, match="titles of the table tell another condition"):
            understand(path, home, CIRCLE | stated, {"Abweichung": "deviation_um"})


def test_a_circle_without_time_takes_it_from_the_feed(tmp_path: Path) -> None:
    path, home = tmp_path / "c.csv", Home(tmp_path / "home")
    rows = [f"{359.5 - n};{math.sin(n):.3f}".replace(".", ",") for n in range(360)]
    path.write_text("\n".join(["Winkel [°];Abweichung [µm]", *rows]), "utf-8")
    assert understand(path, home, {}, {}).missing == ("plane", "radius_mm", "feed_mm_min")
    write_folder(understand(path, home, CIRCLE, {}), tmp_path / "c", home)
    (run,) = next(iter(open_source(tmp_path / "c")[1]))[0]
    turn_s = 2.0 * math.pi * CIRCLE["radius_mm"] / (CIRCLE["feed_mm_min"] / 60.0)
    assert run.meta.direction == "CW"
    np.testing.assert_allclose(run.samples["t_s"], turn_s / 360.0 * np.arange(360), rtol=1e-9)


def test_a_positioning_table_is_read_by_its_own_rules(tmp_path: Path) -> None:
    path, home = tmp_path / "x.csv", Home(tmp_path / "home")
    lines = ["Sollposition [mm];hin 1 [µm];rück 1 [µm];hin 2 [µm];rück 2 [µm]"]
    lines += [f"{100 * n};{n},5;{n + 3},5;{n},4;{n + 3},6" for n in range(5)]
    path.write_bytes("\n".join(lines).encode("cp1252"))
    found = understand(path, home, {"axis": "X"}, {})
    assert (found.columns, [n for _, n in found.runs]) == ((), [10, 10])
    write_folder(found, tmp_path / "c", home)
    runs = next(iter(open_source(tmp_path / "c")[1]))[0]
    assert runs[0].samples["error_um"][:2] == pytest.approx([0.5, 1.5])


def test_a_file_with_rules_of_its_own_needs_no_import(tmp_path: Path) -> None:
    path = tmp_path / "slide.md"
    path.write_text("## Forward\n\ntarget | actual 1 | actual 2\n--- | --- | ---\n0 | 0.1 | 0.2\n9 | 9.1 | 9.2\n")
    with pytest.raises(InputError) as refused:
        understand(path, Home(tmp_path / "home"), {}, {})
    assert refused.value.code == "import.needless"


@pytest.mark.parametrize("words", [False, True])
def test_parquet_is_imported_where_its_names_are_foreign_or_a_column_holds_words(tmp_path: Path, words: bool) -> None:
    path, home, n = tmp_path / "circle.parquet", Home(tmp_path / "home"), 400
    size = 1.0 if words else 1000.0
    names = ("t_s", "angle_deg", "deviation_um", "plane") if words else ("t_ms", "angle_deg", "deviation_mm", "load_v")
    values = (
        size * 0.1 * np.arange(n),
        0.9 * np.arange(n),
        np.sin(np.arange(n)) / size,
        ["XY"] * n if words else [None] * n,
    )
    pq.write_table(pa.table(dict(zip(names, values, strict=True))), path)
    write_folder(understand(path, home, CIRCLE, {}), tmp_path / "c", home)
    (run,) = next(iter(open_source(tmp_path / "c")[1]))[0]
    assert run.samples["deviation_um"] == pytest.approx(np.sin(np.arange(n)), abs=1e-9)
    assert run.samples["t_s"] == pytest.approx(0.1 * np.arange(n))


def test_a_damaged_file_of_parquet_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "circle.parquet"
    pq.write_table(pa.table({"t_ms": [0.0, 1.0], "angle_deg": [0.0, 1.0], "plane": ["XY", "XY"]}), path)
    data = bytearray(path.read_bytes())
    data[4:12] = b"\xff" * 8
    path.write_bytes(data)
    with pytest.raises(InputError):
        understand(path, Home(tmp_path / "home"), CIRCLE, {})


def test_blank_columns_that_a_spreadsheet_leaves_hide_no_table(tmp_path: Path) -> None:
    rows = [
        "Titel,,,,,,",
        "t_s,angle_deg,deviation_um,,,,",
        *(f"{n / 10},{7.2 * n:.1f},{n % 3}.5,,,," for n in range(50)),
    ]
    path = tmp_path / "blank.csv"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    found = understand(path, Home(tmp_path / "home"), CIRCLE, {})
    assert found.runs == (("blank", 50),)


def test_a_number_without_a_unit_is_left_out_until_it_is_told(tmp_path: Path) -> None:
    path, home = tmp_path / "t.csv", Home(tmp_path / "home")
    path.write_text("t_s,Phi,Delta\n" + "".join(f"{n},{n * 0.01},{n % 3}e-3\n" for n in range(50)), encoding="utf-8")
    with pytest.raises(InputError, match="those of no kind") as refused:
        understand(path, home, CIRCLE, {})
    assert "Delta: no unit is told" in str(refused.value.got)
    found = understand(path, home, CIRCLE, {"Phi": "angle_deg", "Delta": "deviation_um"})
    assert found.runs == (("t", 50),)
    with pytest.raises(InputError, match="no such column"):
        understand(path, home, CIRCLE, {"Phy": "angle_deg"})


def test_the_command_shows_first_and_writes_when_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    Path("k.csv").write_text(circle(), encoding="utf-8")

    def run(*words: str) -> Any:
        return CliRunner().invoke(app, ["import", "k.csv", *words])

    shown = run()
    assert shown.exit_code == 0, shown.output
    assert "Abweichung [mm] -> deviation_um, times 1000" in shown.output
    assert "missing: plane, radius_mm, feed_mm_min" in shown.output
    assert "nothing is written" in shown.output
    assert [p.name for p in tmp_path.iterdir()] == ["k.csv"]
    assert isinstance(run("--out", "c").exception, InputError)
    assert not Path("c").exists()
    answers = ["--plane", "XY", "--radius", "100", "--feed", "1000", "--out", "c", "--json"]
    written = json.loads(run(*answers).stdout)
    assert (written["kind"], written["written"]) == ("circular", "c/campaign.toml")
    for wrong in (answers, ["--column", "Zeit"], ["--column", "Zeit=a b"]):
        assert isinstance(run(*wrong).exception, InputError)


def test_conditions_of_an_earlier_file_are_confirmed_for_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTWIN_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    for name in ("k.csv", "l.csv"):
        Path(name).write_text(circle(), encoding="utf-8")

    def run(*words: str) -> Any:
        return CliRunner().invoke(app, ["import", *words])

    answers = ["--plane", "XY", "--radius", "100", "--feed", "1000", "--machine", "mill-7"]
    assert run("k.csv", *answers, "--started", "2026-03-02", "--out", "k").exit_code == 0
    (first,) = next(iter(open_source(Path("k"))[1]))[0]
    assert first.meta.started == "2026-03-02"
    shown = run("l.csv")
    assert "only k.csv tells machine mill-7, plane XY, radius_mm 100" in shown.output
    assert "--as-remembered confirms it" in shown.output
    refused = run("l.csv", "--feed", "2000", "--out", "l").exception
    assert isinstance(refused, InputError)
    assert (refused.code, refused.exit_code) == ("import.unconfirmed", 1)
    assert refused.got == "machine mill-7, plane XY, radius_mm 100.0, of k.csv"
    assert not Path("l").exists()
    # Told again, or confirmed: either is an answer.
    assert run("l.csv", *answers, "--out", "told").exit_code == 0
    assert run("l.csv", "--feed", "2000", "--as-remembered", "--out", "l").exit_code == 0
    (done,) = next(iter(open_source(Path("l"))[1]))[0]
    # A day is of one file.
    assert (done.meta.radius_mm, done.meta.feed_mm_min, done.meta.started) == (100.0, 2000.0, "")


@pytest.mark.parametrize(
    ("decimal", "cells", "value"),
    [("comma", '"0,5","1.234,5"', 1234.5), ("point", '0.5,"1,234.5"', 1234.5), ("comma", '"0,5","-1,5e2"', -150.0)],
)
def test_a_decimal_sign_that_is_told(tmp_path: Path, decimal: str, cells: str, value: float) -> None:
    path, home = tmp_path / "d.csv", Home(tmp_path / "home")
    rows = [f"{n}.0,{cells}" if decimal == "point" else f'"{n},0",{cells}' for n in range(20)]
    path.write_text("\n".join(["t_s,angle_deg,deviation_um", *rows]) + "\n", encoding="utf-8")
    # Digits in groups beside a decimal sign leave no doubt, nor do commas that part no three digits.
    assert understand(path, home, CIRCLE, {}).kind == "circular"
    found = understand(path, home, CIRCLE, {}, decimal)
    write_folder(found, tmp_path / "c", home)
    (run,) = next(iter(open_source(tmp_path / "c")[1]))[0]
    assert set(run.samples["deviation_um"]) == {value}
    # The next file of this form is read so, too.
    assert understand(path, home, {}, {}).decimal == decimal
    with pytest.raises(InputError, match="comma or a point"):
        understand(path, home, {}, {}, "dot")


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    path = tmp_path / "k.csv"
    path.write_text(circle(), encoding="utf-8")
    (tmp_path / "file").write_text("", encoding="utf-8")
    for folder, home in ((tmp_path / "c", tmp_path / "file" / "home"), (tmp_path / "file" / "c", tmp_path / "home")):
        with pytest.raises(InputError, match="cannot be made"):
            write_folder(understand(path, Home(home), CIRCLE, {}), folder, Home(home))
    assert not (tmp_path / "c").exists()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(min_size=1, max_size=400), st.text(min_size=1, max_size=400).map(lambda t: t.encode())))
def test_hostile_files_are_refused_as_mistakes(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "h.csv"
    path.write_bytes(data)
    with pytest.raises(InputError):
        understand(path, Home(tmp_path / "home"), CIRCLE, {})


def test_a_table_on_its_side_is_imported_whole(tmp_path: Path) -> None:
    path, home = tmp_path / "side.csv", Home(tmp_path / "home")
    rows = [["Target position [mm]", "0", "", "5", ""], ["Direction", *"+-+-"]]
    rows += [[f"j={j} [µm]", "1", "2", "1,5", "2,5"] for j in (1, 2)]
    path.write_text("\n".join(map(";".join, rows)), encoding="utf-8")
    found = understand(path, home, {"axis": "X", "machine": "mill-7", "screw_pitch_mm": 10.0}, {})
    assert (found.kind, [count for _, count in found.runs]) == ("linear", [4, 4])
    write_folder(found, tmp_path / "c", home)
    campaign, sources, _ = open_source(tmp_path / "c")
    assert campaign.machine_geometry == {"screw_pitch_mm": 10.0}
    run = next(iter(sources))[0][0]
    assert run.meta.condition["screw_pitch_mm"] == 10.0
    assert run.samples["error_um"].tolist() == [1.0, 1.5, 2.5, 2.0]


@pytest.mark.parametrize(
    ("encoding", "heads"),
    [
        ("gbk", "时间\uff08s\uff09,angle\uff08°\uff09,deviation\uff08μm\uff09,室温\uff08℃\uff09"),
        ("cp932", "時間\uff3bms\uff3d,angle\uff3b°\uff3d,deviation\uff3bμm\uff3d,室温\uff3b℃\uff3d"),
        ("utf-16-le", "时间\uff08s\uff09,angle\uff08°\uff09,deviation\uff08μm\uff09,室温\uff08℃\uff09"),
    ],
)
def test_a_table_from_china_or_japan(tmp_path: Path, encoding: str, heads: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{0.9 * n},{0.1 * n},20.5" for n in range(400)]
    path.write_bytes("\n".join([heads, *rows]).encode(encoding))
    found = understand(path, Home(tmp_path / "home"), CIRCLE, {})
    assert [c.name for c in found.columns] in (["t_s", "angle_deg", "deviation_um", "room_temperature_c"], [])
    assert found.runs


def test_letters_of_the_west_are_not_taken_for_chinese() -> None:
    for text in ("Größe;Prüfung Übermaß;°;µ", "Weg [µm];Temp [°C]", "ÄÖ ÜBER", "“a” \u2013 b … \u2018c\u2019 €5"):
        assert decoded(text.encode("cp1252") + b"\x1a") == text


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("'1,5", 1.5),
        ("\u22121,5", -1.5),
        ("\u20131,5", -1.5),
        ("1\u00a0234,5\u00a0", 1234.5),
        ("1\u202f234", 1234.0),
        ("1\u2009234,5", 1234.5),
        ("1 234,5", 1234.5),
        ("1'234", 1234.0),
        (" +3,5 ", 3.5),
    ],
)
def test_numbers_as_spreadsheets_and_typesetters_write_them(cell: str, value: float) -> None:
    assert float(rows_of(f"a;b\n{cell};2\n")[1][0]) == value


@pytest.mark.parametrize("cell", ["2026-03-02 100", "1 2", "5\u20133", "it's", "\u2013", "12 34 567"])
def test_what_is_no_number_stays_as_it_is(cell: str) -> None:
    assert rows_of(f"a;b\n{cell};2\n")[1][0] == cell


def test_columns_parted_by_blanks_are_not_joined() -> None:
    assert rows_of("X Y\n100 200\n") == [["X Y"], ["100 200"]]


def test_groups_of_digits_leave_dates_and_numbers_of_the_other_sign_as_they_are() -> None:
    assert rows_of("d;a;b\n25.11.2026;1.234,5;0,5\n26.11.2026;1.200;7\n")[1:] == [
        ["25.11.2026", "1234.5", "0.5"],
        ["26.11.2026", "1200", "7"],
    ]
    # One number of each sign: neither is taken for groups.
    assert rows_of("a;b\n1.234,5;20.5\n3;1.234\n")[1:] == [["1.234.5", "20.5"], ["3", "1.234"]]


def test_first_rows_without_a_reading_hide_no_heads(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{0.9 * n},{'' if n < 3 else 0.1 * n}" for n in range(400)]
    path.write_text("\n".join(["angle [deg],deviation [µm]", *rows]), encoding="utf-8")
    assert understand(path, Home(tmp_path / "home"), CIRCLE, {}).runs == (("a-ccw1", 397),)


def test_conditions_of_another_kind_of_test_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{0.1 * np.cos(n / 50)},{0.1 * np.sin(n / 50)},20.1" for n in range(400)]
    path.write_text("\n".join(["time [s],X [mm],Y [mm],air [°C]", *rows]), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        open_source(path, CIRCLE)
    assert refused.value.code == "ingest.kind"


def test_a_log_with_one_line_a_reading_becomes_columns_that_hold_until_the_next(tmp_path: Path) -> None:
    path, home = tmp_path / "night.log", Home(tmp_path / "home")
    lines = ["IOC:State 2026-03-02 07:50:00.0 One", "IOC:T1-Act 2026-03-02 07:59:00.0 19.5"]
    for n in range(120):
        lines.append(f"IOC:Gauge-Act   2026-03-02 {8 + n // 60:02d}:{n % 60:02d}:00.250000 {0.5 * n:.2f}  ")
        if n % 2:
            lines.append(f"IOC:T1-Act 2026-03-02 {8 + n // 60:02d}:{n % 60:02d}:30.0 {20 + 0.1 * n:.1f}")
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        understand(path, home, {}, {})
    assert "IOC:Gauge-Act: no unit is told" in str(refused.value.got)
    assert "IOC:State" not in str(refused.value.got)
    answers = {"IOC:Gauge-Act": "displacement_um", "IOC:T1-Act": "temperature_frame_c"}
    found = understand(path, home, {"machine": "m"}, answers)
    assert found.kind == "drift"
    head, first, second, third, *_ = found.text.splitlines()
    assert head == "t_s,temperature_frame_c,displacement_um"
    assert (first, second, third) == ("0,19.5,0", "60,19.5,0.5", "89.75,20.1,0.5")


@pytest.mark.parametrize(
    ("heads", "told", "proposed"),
    [
        ("Winkel [deg],Wert [um],Zeit [s]", {}, '"Wert [um]=deviation_um"'),
        ("Weg,Wert", {"axis": "X"}, '"Weg=position_mm"'),
        ("Zeit [s],Taster [um]", CIRCLE, '"Taster [um]=deviation_um"'),
        # What counts the rows is no deviation.
        ("Nr.,Winkel [deg],Wert [um]", CIRCLE, '"Wert [um]=deviation_um"'),
        # Nor is what was commanded.
        ("X [mm],Y [mm],Z [mm],Nominal X [mm],dX [um]", {}, '"dX [um]=error_x_um"'),
        ("Time(msec),Wert [um],Winkel [deg]", {}, '"Wert [um]=deviation_um"'),
        ("A,B", {}, '"HEAD=NAME"'),
    ],
)
def test_the_hint_proposes_a_column_of_the_kind_that_is_meant(
    tmp_path: Path, heads: str, told: dict[str, Any], proposed: str
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([heads, *(",".join("12345"[: heads.count(",") + 1]) for _ in range(3))]))
    with pytest.raises(InputError) as refused:
        understand(path, Home(tmp_path / "home"), told, {})
    assert proposed in str(refused.value.hint)


@pytest.mark.parametrize("head", ["Radialabweichung", "radiale Abweichung", "Radial dev.", "Deviation"])
def test_names_of_a_radial_deviation(tmp_path: Path, head: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"Winkel: [°];{head} [µm]", *(f"{n};{n % 7}" for n in range(360))]), encoding="utf-8")
    assert understand(path, Home(tmp_path / "home"), CIRCLE, {}).runs == (("a-ccw1", 360),)


def test_two_runs_beside_each_other_under_the_same_heads_are_not_read_as_one(tmp_path: Path) -> None:
    path, home = tmp_path / "a.csv", Home(tmp_path / "home")
    rows = [f"{n};{n % 7};{(360 - n) % 360};{n % 5}" for n in range(360)]
    path.write_text("\n".join(["angle [deg];deviation [µm];angle [deg];deviation [µm]", *rows]), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        understand(path, home, CIRCLE, {})
    assert refused.value.code == "import.twice"
    # The same column twice is one.
    rows = [f"{n};{n % 7};{n}" for n in range(360)]
    path.write_text("\n".join(["angle [deg];deviation [µm];angle [deg]", *rows]), encoding="utf-8")
    assert understand(path, home, CIRCLE, {}).runs == (("a-ccw1", 360),)


def test_a_refused_text_is_sent_to_the_import_and_numbers_without_heads_are_not_sent_back(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("\n".join(f"{n} {n % 7} {n % 5}" for n in range(99)), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        open_source(path, {})
    assert str(refused.value.hint).startswith("dtwin import a.txt ")
    with pytest.raises(InputError) as refused:
        understand(path, Home(tmp_path / "home"), {}, {})
    assert str(refused.value.hint).startswith("write heads with units")


def test_a_second_circle_below_the_first_is_not_imported_as_its_second_turn(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    block = ["angle [deg],deviation [µm]", *(f"{n},{n % 7}" for n in range(360))]
    path.write_text("\n".join(["Part 1", *block, "Part 2", *block]), encoding="utf-8")
    with pytest.raises(InputError, match="second table"):
        understand(path, Home(tmp_path / "home"), CIRCLE, {})
    # Titles that tell the direction part them.
    path.write_text("\n".join(["G03", *block, "G02", *block]), encoding="utf-8")
    assert understand(path, Home(tmp_path / "home"), CIRCLE, {}).runs == (("a-ccw1", 360), ("a-cw1", 360))


def test_conditions_that_are_missing_are_asked_of_the_file_that_the_user_knows(tmp_path: Path) -> None:
    path = tmp_path / "my circle.csv"
    path.write_text("t_s,angle_deg,deviation_um\n" + "".join(f"{n / 10},{n},0.1\n" for n in range(360)))
    with pytest.raises(InputError) as refused:
        write_folder(understand(path, Home(tmp_path), {"machine": "m"}, {}), tmp_path / "out", Home(tmp_path))
    assert (refused.value.where, refused.value.code) == (str(path), "ingest.condition")
    assert (refused.value.hint or "").startswith(f"dtwin import '{path}' --out FOLDER --plane XY")


def test_tables_of_another_program_in_a_campaign_folder(tmp_path: Path) -> None:
    """One campaign of several runs, each in a file with heads that are not the house's."""
    runs = [(f"{way}{n}", way, n) for way in ("CCW", "CW") for n in (1, 2)]
    document = '[campaign]\nname = "c"\nmachine = "m"\nkind = "circular"\n'
    for name, way, n in runs:
        lines = circle(below=n == 1).splitlines()
        rows = lines[-400:] if way == "CCW" else lines[:-401:-1]
        (tmp_path / f"{name}.csv").write_text("\n".join([*lines[:-400], *rows]), "utf-8")
        document += f'[[run]]\nid = "{name}"\nfile = "{name}.csv"\nplane = "XY"\nradius_mm = 100.0\nfeed_mm_min = 1000.0\ndirection = "{way}"\nrepeat = {n}\n'
    (tmp_path / "campaign.toml").write_text(document, "utf-8")
    read = [run for found, _ in open_source(tmp_path)[1] for run in found]
    assert [(run.meta.direction, run.meta.repeat) for run in read] == [(way, n) for _, way, n in runs]
    assert {Path(run.source).name for run in read} == {f"{name}.csv" for name, _, _ in runs}
    assert all(np.ptp(run.samples["deviation_um"]) == pytest.approx(8.0, abs=0.01) for run in read)
    (tmp_path / "CW1.csv").write_text(circle().replace("Abweichung", "Kanal 1").replace("mm", "µm"), "utf-8")
    with pytest.raises(InputError, match="lacks columns") as refused:
        list(open_source(tmp_path)[1])
    assert "[campaign.instrument.columns]" in str(refused.value.hint)
    columns = '[campaign.instrument.columns]\n"Kanal 1" = "deviation_um"\n'
    (tmp_path / "campaign.toml").write_text(document.replace("[[run]]", f"{columns}[[run]]", 1), "utf-8")
    assert len([run for found, _ in open_source(tmp_path)[1] for run in found]) == 4


def test_a_foreign_table_without_a_clock_that_its_kind_needs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "tone.csv").write_text("cmd Z [um];act Z [um]\n" + "1,0;2,0\n" * 50, "utf-8")
    head = '[campaign]\nname = "c"\nmachine = "m"\nkind = "sinusoidal"\n[campaign.instrument.columns]\n'
    run = '[[run]]\nid = "r"\nfile = "tone.csv"\ncondition = { frequency_hz = 1.0, amplitude_um = 2.0 }\n'
    columns = '"cmd Z [um]" = "cmd_z_mm"\n"act Z [um]" = "act_z_mm"\n'
    (tmp_path / "campaign.toml").write_text(head + columns + run, "utf-8")
    with pytest.raises(InputError) as refused:
        list(open_source(tmp_path)[1])
    assert (refused.value.code, refused.value.where) == ("columns.missing", str(tmp_path / "tone.csv"))


@pytest.mark.parametrize(("answer", "factor"), [("deviation_um", 1.0), ("deviation_mm", 1000.0)])
def test_an_answer_has_the_unit_of_the_file(tmp_path: Path, answer: str, factor: float) -> None:
    path = tmp_path / "c.csv"
    path.write_text("Phi;d\n" + "".join(f"{n};{n % 7}\n" for n in range(360)), "utf-8")
    found = understand(path, Home(tmp_path / "home"), CIRCLE, {"Phi": "angle_deg", "d": answer})
    assert [(c.name, c.factor) for c in found.columns] == [("angle_deg", 1.0), ("deviation_um", factor)]


def test_a_table_of_a_width_that_none_has_is_refused_at_once(tmp_path: Path) -> None:
    wide = tmp_path / "wide.csv"
    wide.write_text("\n".join(",".join(f"{cell}{n}" for n in range(20_000)) for cell in ("c", "1", "2")))
    assert rows_of(wide.read_text()) == []
    with pytest.raises(InputError, match="no table is found"):
        understand(wide, Home(tmp_path), {}, {})


def test_a_log_of_very_many_channels_is_no_table(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    lines = [f"CH{n % 5000} 2026-01-02 {n // 3600:02d}:{n // 60 % 60:02d}:{n % 60:02d}.0 1.0\n" for n in range(10_000)]
    log.write_text("".join(lines))
    with pytest.raises(InputError, match="too many channels"):
        understand(log, Home(tmp_path), {}, {})
