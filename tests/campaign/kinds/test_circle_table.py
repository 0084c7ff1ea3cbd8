"""Circles as other programs write them: a column a direction, a radius, two coordinates."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from openpyxl import Workbook

from dtwin.acquire._lone_table import open_table
from dtwin.acquire.importing import understand
from dtwin.acquire.ingest import open_source
from dtwin.acquire.quality import judge_run
from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.circular._circle_table import is_circle_table, read_circle_runs
from dtwin.kinds.circular._circle_ways import way_of, way_of_title
from dtwin.kinds.circular._titles import told_above
from dtwin.schema import Campaign, Floats, Run

TOLD = {"plane": "XY", "radius_mm": 150.0, "feed_mm_min": 1000.0, "machine": "mill-7"}
CIRCLE_FOLDER = """[campaign]
name = "c"
machine = "m"
[[run]]
id = "a"
file = "a.csv"
plane = "XY"
radius_mm = 150.0
feed_mm_min = 1000.0
direction = "CCW"
"""
ANGLE: Floats = np.arange(720.0) * 0.5 + 0.25


def error_um(angle: Floats, way: float | Floats) -> Floats:
    """A scale error, and play that turns with the direction."""
    return np.asarray(4.0 * np.cos(2 * np.radians(angle)) + 3.0 * way * np.sign(np.sin(np.radians(angle))))


def read(path: Path, text: str, **told: Any) -> list[Run]:
    path.write_text(text, encoding="utf-8")
    sources = open_source(path, TOLD | told)[1]
    return [run for runs, _ in sources for run in runs]


def table(heads: str, *columns: Floats, by: str = ",") -> str:
    return "\n".join([heads, *(by.join(f"{v:.6f}" for v in row) for row in zip(*columns, strict=True))]) + "\n"


def test_a_column_for_each_direction_is_a_run_that_way_round(tmp_path: Path) -> None:
    ways = (1.0, -1.0, 1.0, -1.0)
    heads = "angle [deg],ccw 1 [µm],cw 1 [µm],ccw 2 [µm],cw 2 [µm],air [°C]"
    runs = read(tmp_path / "a.csv", table(heads, ANGLE, *(error_um(ANGLE, way) for way in ways), ANGLE * 0.0 + 20.0))
    assert [(r.meta.run_id, r.meta.direction, r.meta.repeat) for r in runs] == [
        ("a-ccw1", "CCW", 1),
        ("a-cw1", "CW", 1),
        ("a-ccw2", "CCW", 2),
        ("a-cw2", "CW", 2),
    ]
    turn_s = 2 * np.pi * 150.0 / (1000.0 / 60.0)
    for run, way in zip(runs, ways, strict=True):
        angle = run.samples["angle_deg"]
        assert np.all(np.diff(angle) * way > 0.0)
        assert run.samples["deviation_um"] == pytest.approx(error_um(angle, way), abs=1e-5)
        assert run.samples["t_s"][[0, -1]] == pytest.approx([0.0, turn_s * 719 / 720])
        assert run.samples["air_c"] == pytest.approx(20.0)
        assert [f.code for f in run.findings] == ["clock.assumed"]
    # 1.000 as a German types a thousand, or m/min.
    with pytest.raises(InputError, match="more than an hour"):
        read(tmp_path / "b.csv", table("angle [deg],ccw [µm]", ANGLE, error_um(ANGLE, 1.0)), feed_mm_min=1.0)


def test_a_radius_is_told_from_the_programmed_one(tmp_path: Path) -> None:
    down = ANGLE[::-1]
    (run,) = read(
        tmp_path / "a.csv",
        table("time [s];angle [deg];radius [mm]", ANGLE, down, 150.0 + error_um(down, -1.0) / 1e3, by=";"),
    )
    assert run.meta.direction == "CW"
    assert run.meta.sample_rate_hz == pytest.approx(2.0)
    assert run.samples["deviation_um"] == pytest.approx(error_um(down, -1.0), abs=2e-3)
    assert run.findings == ()
    (later,) = read(tmp_path / "b.csv", (tmp_path / "a.csv").read_text("utf-8"), repeat=3)
    assert later.meta.repeat == 3


@pytest.mark.parametrize(
    ("head", "per_deg"), [("Winkel [Grad]", 1.0), ("angle [gon]", 400.0 / 360.0), ("Winkel [gon]", 400.0 / 360.0)]
)
def test_degrees_in_german_and_gon(tmp_path: Path, head: str, per_deg: float) -> None:
    (run,) = read(tmp_path / "a.csv", table(f"{head},radius [mm]", ANGLE * per_deg, 150.0 + error_um(ANGLE, 1.0) / 1e3))
    assert run.samples["angle_deg"] == pytest.approx(ANGLE, abs=1e-5)


def test_a_turn_of_400_under_grad_is_asked_back(tmp_path: Path) -> None:
    turn = np.linspace(0.0, 360.0, 181)
    for head, angle in (("Winkel [Grad]", turn / 0.9), ("Winkel [Grad]", turn[:-1] / 0.9)):
        with pytest.raises(InputError, match="may be degrees or gon"):
            read(tmp_path / "a.csv", table(f"{head},ccw [µm]", angle, error_um(angle * 0.9, 1.0)))
    (run,) = read(tmp_path / "b.csv", table("Winkel [gon],ccw [µm]", turn / 0.9, error_um(turn, 1.0)))
    assert np.ptp(run.samples["angle_deg"]) == pytest.approx(360.0)


def test_a_column_of_radii_that_is_not_the_one_that_is_told_is_an_error(tmp_path: Path) -> None:
    text = table("t_s,angle_deg,deviation_um,radius_mm", ANGLE, ANGLE, error_um(ANGLE, 1.0), ANGLE * 0.0 + 100.0)
    (run,) = read(tmp_path / "a.csv", text)
    assert "radius.told" in {f.code for f in judge_run(run)}
    (right,) = read(tmp_path / "b.csv", text, radius_mm=100.0)
    assert "radius.told" not in {f.code for f in judge_run(right)}


@pytest.mark.parametrize(
    ("heads", "name", "by"),
    [("X [mm] Y [mm]", "a.txt", " "), ("x_mm,y_mm", "a.csv", ","), ("x [um];y [µm]", "b.csv", ";")],
)
def test_coordinates_there_and_back_are_two_runs_about_their_own_centre(
    tmp_path: Path, heads: str, name: str, by: str
) -> None:
    angle = np.concatenate([ANGLE, ANGLE[::-1]])
    way = np.repeat([1.0, -1.0], ANGLE.size)
    r_mm = 150.0 + error_um(angle, way) / 1e3
    x, y = (
        centre + r_mm * shape
        for centre, shape in ((812.5, np.cos(np.radians(angle))), (-40.0, np.sin(np.radians(angle))))
    )
    unit = 1e3 if "um" in heads else 1.0
    runs = read(tmp_path / name, table(heads, unit * x, unit * y, by=by))
    assert [run.meta.direction for run in runs] == ["CCW", "CW"]
    for run, sign in zip(runs, (1.0, -1.0), strict=True):
        # The play is odd in direction: about their common centre it stays.
        assert run.samples["deviation_um"] == pytest.approx(error_um(run.samples["angle_deg"], sign), abs=0.05)
        assert np.ptp(run.samples["angle_deg"]) == pytest.approx(359.5, abs=0.1)
        assert run.n_samples == ANGLE.size


def test_a_control_that_stands_before_and_after_its_circle_is_no_stuck_sensor(tmp_path: Path) -> None:
    angle = np.concatenate([np.full(30, ANGLE[0]), ANGLE, np.full(40, ANGLE[-1]), ANGLE[::-1], np.full(9, ANGLE[0])])
    x, y = (150.0 * np.cos(np.radians(angle)), 150.0 * np.sin(np.radians(angle)))
    runs = read(tmp_path / "a.csv", table("X [mm],Y [mm]", x, y))
    assert [run.meta.direction for run in runs] == ["CCW", "CW"]
    assert all(abs(run.n_samples - ANGLE.size) <= 1 for run in runs)
    assert all("circle_table.stands" in {f.code for f in run.findings} for run in runs)
    assert not any("circle_table.coarse" in {f.code for f in run.findings} for run in runs)
    (rough,) = read(tmp_path / "b.csv", table("X [mm],Y [mm]", *(np.round(v[30 : 30 + ANGLE.size], 2) for v in (x, y))))
    (told,) = (f for f in rough.findings if f.code == "circle_table.coarse")
    assert told.numbers["step_um"] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("text", "told", "got"),
    [
        (table("angle,ccw,cw", ANGLE, ANGLE, ANGLE), {}, "angle"),
        (table("angle [deg],ccw,cw", ANGLE, ANGLE, ANGLE), {}, "ccw"),
        (table("angle [deg],ccw [Nm],cw [Nm]", ANGLE, ANGLE, ANGLE), {}, "ccw [Nm]"),
        (
            table("x_mm,y_mm", 150 * np.cos(np.radians(ANGLE)), 150 * np.sin(np.radians(ANGLE))),
            {"radius_mm": 100.0},
            "a radius of 150 mm",
        ),
        (
            table("x_mm,y_mm", 150 * np.cos(np.radians(ANGLE)), 150 * np.sin(np.radians(ANGLE))),
            {"plane": "YZ"},
            "X and Y",
        ),
        (table("angle [deg],radius [mm]", ANGLE[:30], ANGLE[:30] * 0.0 + 150.0), {}, "30 rows"),
        (table("angle [deg],radius [mm]", ANGLE, ANGLE * 0.0 + 150.0), {"radius_mm": 100.0}, "a radius of 150 mm"),
        (table("angle [grad],radius [mm]", ANGLE, ANGLE * 0.0 + 150.0), {}, "1/400 of a turn"),
        (table("x_mm,y_mm", ANGLE[:20], ANGLE[:20]), {}, "20 rows"),
        (table("cycle,angle_deg,deviation_um", ANGLE, ANGLE * np.nan, ANGLE), {}, "720 rows"),
        (table("angle [deg],ccw simulated [µm]", ANGLE, ANGLE), {}, "simulated"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(tmp_path: Path, text: str, told: dict[str, Any], got: str) -> None:
    with pytest.raises(InputError) as refused:
        read(tmp_path / "a.csv", text, **told)
    assert refused.value.code == "circle_table.form"
    assert got in str(refused.value.got)


def test_run_in_and_run_out_within_the_figures_are_told(tmp_path: Path) -> None:
    angle = np.arange(-45.0, 405.5, 0.5)
    (run,) = read(tmp_path / "a.csv", table("angle [deg],ccw [µm]", angle, error_um(angle, 1.0)))
    assert [f.severity for f in judge_run(run) if f.code == "arc.long"] == ["warning"]
    (run,) = read(tmp_path / "a.csv", table("angle [deg],ccw [µm]", ANGLE, error_um(ANGLE, 1.0)))
    assert not any(f.code == "arc.long" for f in judge_run(run))


def test_rows_without_a_number_are_told_and_left_out(tmp_path: Path) -> None:
    lines = table("angle [deg],ccw [µm],cw [µm]", ANGLE, error_um(ANGLE, 1.0), error_um(ANGLE, -1.0)).splitlines()
    lines[11] = "5.25,lost,1.0"
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    runs, rejected = next(iter(open_source(path, TOLD)[1]))
    assert [run.n_samples for run in runs] == [719, 720]
    assert [(r["row"], r["values"]["ccw [µm]"]) for part in rejected for r in part.rows] == [(10, "lost")]


@pytest.mark.parametrize(
    "heads",
    [
        "t_s,angle_deg,deviation_um",
        "t_s,angle_deg,deviation_um,radius_mm",
        "t_s,x_mm,y_mm,z_mm,error_x_um",
        "target,forward 1,reverse 1",
        "angle_deg,x_um,y_um",
        "t_s,angle_deg,left probe [µm],right probe [µm]",
    ],
)
def test_tables_of_others_are_left_to_them(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"{heads}\n" + ",".join(str(n) for n in range(len(heads.split(",")))) + "\n", encoding="utf-8")
    assert not is_circle_table(path)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_no_file_ends_in_anything_but_a_refusal(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_bytes(b"angle [deg],ccw [um],cw [um]\n0,1,2\n" + content)
    if is_circle_table(path):
        with suppress(InputError):
            list(open_source(path, TOLD)[1])


@pytest.mark.parametrize("radius", ['"abc"', "[1]", "true", "-5", "1e400", "nan"])
def test_a_radius_that_is_no_number_is_refused(tmp_path: Path, radius: str) -> None:
    (tmp_path / "a.csv").write_text(table("angle [deg],ccw [µm]", ANGLE, ANGLE), encoding="utf-8")
    head = '[campaign]\nname = "c"\nmachine = "m"\nkind = "circular"\n[[run]]\nid = "r"\nfile = "a.csv"\nplane = "XY"\nfeed_mm_min = 1000\n'
    (tmp_path / "campaign.toml").write_text(f"{head}radius_mm = {radius}\n", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        list(open_source(tmp_path)[1])
    assert refused.value.code == "campaign.value"


@pytest.mark.parametrize(
    ("told", "code"),
    [
        ({"direction": "CW"}, "circle_table.form"),
        ({"axis": "X"}, "ingest.kind"),
        ({"screw_pitch_mm": 5.0}, "ingest.kind"),
    ],
)
def test_what_is_told_and_is_not_of_the_table_is_refused(tmp_path: Path, told: dict[str, object], code: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(table("angle_deg,deviation_um", ANGLE, ANGLE), encoding="utf-8")

    def read(told: dict[str, object]) -> Run:
        folder = open_table(path, {"plane": "XY", "radius_mm": 150.0, "feed_mm_min": 1000.0} | told)
        return folder.read(folder.entries[0])[0][0]

    with pytest.raises(InputError) as refused:
        read(told)
    assert refused.value.code == code
    assert read({"direction": "CCW"}).meta.direction == "CCW"


def test_a_plane_that_is_told_from_its_other_axis_turns_the_angle(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    x, z = (150.0 * shape(np.radians(ANGLE)) for shape in (np.cos, np.sin))
    found = []
    for heads, columns in (("X [mm],Z [mm]", (x, z)), ("angle [deg],ccw [µm]", (ANGLE, 0.1 * ANGLE))):
        path.write_text(table(heads, *columns), encoding="utf-8")
        folder = open_table(path, {"plane": "XZ", "radius_mm": 150.0, "feed_mm_min": 1000.0})
        (run,) = folder.read(folder.entries[0])[0]
        assert (run.meta.plane, run.meta.direction) == ("ZX", "CW")
        assert not any(f.code == "angle.direction" for f in judge_run(run))
        found.append(run.samples["angle_deg"])
    assert found[0] % 360.0 == pytest.approx(found[1] % 360.0, abs=1e-6)


@pytest.mark.parametrize(
    "heads",
    [
        "angle [deg],ccw [µm],cw [µm],ccw best fit [µm]",
        "angle [deg],ccw [µm],cw [µm],mean ccw [µm]",
        # What is read has heads that are not known.
        "angle [deg],forward [µm],cw predicted [µm],backward [µm]",
        "angle [deg],A [µm],ccw reference [µm],B [µm]",
        "angle [deg],ccw correction [µm],cw correction [µm],t [s]",
        "angle [deg],ccw diameter error [µm],cw diameter error [µm],t [s]",
        "angle [deg],ccw radius [mm],cw radius [mm],t [s]",
        "angle [deg],ccw [µm],cw [µm],ccw spindle [°C]",
        "angle [deg],ccw [µm],cw [µm],cw angle [deg]",
        "angle [deg],-ccw [µm],cw [µm],t [s]",
        "angle [deg],|ccw| [µm],cw [µm],t [s]",
        "angle [deg],ccw [µm],angle [deg],cw [µm]",
        "angle [deg],radius [mm],time [s],actual radius [mm]",
    ],
)
def test_what_is_no_deviation_of_a_run_is_not_read_as_one(tmp_path: Path, heads: str) -> None:
    deviation = error_um(ANGLE, 1.0)
    with pytest.raises(InputError, match=r"is no deviation|more than one column|one head and different readings"):
        read(tmp_path / "a.csv", table(heads, ANGLE, deviation, deviation, deviation))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("counterclockwise", "clockwise"),
        ("counter-clockwise run", "clockwise run"),
        ("Abweichung gegen den Uhrzeigersinn", "Abweichung im Uhrzeigersinn"),
        ("Gegenuhrzeigersinn", "Uhrzeigersinn"),
        ("Lauf entgegen dem Uhrzeigersinn", "Lauf im Uhrzeigersinn"),
        ("anti-clockwise", "clock-wise"),
        ("sens anti-horaire", "sens horaire"),
        ("antihoraire", "horaire"),
        ("senso antiorario", "senso orario"),
        ("links", "rechts"),
        ("Linkslauf 1", "Rechtslauf 1"),
        ("反時計回り", "時計回り"),
        ("左回り", "右回り"),
    ],
)
def test_directions_that_are_spelt_out(tmp_path: Path, left: str, right: str) -> None:
    text = table(f"angle [deg],{right} [µm],{left} [µm]", ANGLE, error_um(ANGLE, -1.0), error_um(ANGLE, 1.0))
    cw, ccw = read(tmp_path / "a.csv", text)
    assert (cw.meta.direction, ccw.meta.direction) == ("CW", "CCW")
    assert ccw.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0), abs=1e-5)


@pytest.mark.parametrize(
    ("title", "heads", "row"),
    [
        ("R100 {}", "angle [deg],radius [mm]", "{0},{2}"),
        ("Run 1 {},", "angle [deg],deviation_um", "{0},{1}"),
        ("", "angle [deg],deviation [µm],direction", "{0},{1},{3}"),
        ("direction,{}", "angle [deg],deviation [µm]", "{0},{1}"),
        ("CW42, right spindle", "Winkel [°],Abweichung [µm],Drehrichtung", "{0},{1},{3}"),
        ("", "Angolo [gradi],Scostamento [µm],Senso di rotazione", "{0},{1},{3}"),
        ("", "angle [deg],deviation [µm],program", "{0},{1},{3}"),
        ("", "angle_deg,deviation_um,direction", "{0},{1},{3}"),
        ("Machine: M5; Direction: {}; Feed: 1000", "angle [deg];radial error [µm]", "{0};{1}"),
        ("Bahn;{}", "Winkel in Grad;Kreisformabweichung in µm", "{0};{1}"),
        ("Bahn;{}", "Winkel °;Kreisformabweichung µm", "{0};{1}"),
    ],
)
def test_blocks_below_their_direction_and_rows_that_tell_it_are_runs_that_way_round(
    tmp_path: Path, title: str, heads: str, row: str
) -> None:
    lines: list[str] = []
    for way, deviation in (("CCW", error_um(ANGLE, 1.0)), ("CW", error_um(ANGLE, -1.0))):
        lines += [title.format(way), heads] if not lines or "{}" in title else []
        lines += [
            row.format(a, d, 150.0 + d / 1000.0, way) for a, d in zip(ANGLE.tolist(), deviation.tolist(), strict=True)
        ]
    ccw, cw = read(tmp_path / "a.csv", "\n".join(line for line in lines if line))
    assert (ccw.meta.direction, cw.meta.direction) == ("CCW", "CW")
    assert ccw.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0), abs=1e-5)
    assert cw.samples["deviation_um"] == pytest.approx(error_um(ANGLE, -1.0)[::-1], abs=1e-5)


def test_a_clock_and_a_title_that_tell_two_ways_are_an_error(tmp_path: Path) -> None:
    text = "Direction: CW\n" + table("t [s],angle [deg],deviation [µm]", ANGLE / 10.0, ANGLE, error_um(ANGLE, -1.0))
    (run,) = read(tmp_path / "a.csv", text)
    assert "angle.direction" in [finding.code for finding in judge_run(run)]
    both = "Run 1: CCW\nRun 2: CW\n" + text.partition("\n")[2]
    with pytest.raises(InputError, match="both directions"):
        read(tmp_path / "a.csv", both)
    (run,) = read(tmp_path / "a.csv", both, direction="CCW")
    assert run.meta.direction == "CCW"
    shaken = ANGLE + np.where(np.arange(720) % 2, 0.6, -0.6)
    (run,) = read(tmp_path / "b.csv", table("angle [deg],ccw [µm]", shaken, error_um(shaken, 1.0)))
    assert not judge_run(run)
    assert np.all(np.diff(run.samples["t_s"]) > 0.0)
    for head in ("-deviation [µm]", "|deviation| [µm]"):
        (tmp_path / "c.csv").write_text(table(f"t [s],angle [deg],{head}", ANGLE, ANGLE, ANGLE), encoding="utf-8")
        with pytest.raises(InputError, match="no kind of test") as refused:
            understand(tmp_path / "c.csv", Home(tmp_path / "home"), TOLD, {})
        assert "sign is turned round" in str(refused.value.got)


@pytest.mark.parametrize("head", ["direction", "run"])
def test_rows_of_both_directions_or_runs_in_turn_are_two_runs(tmp_path: Path, head: str) -> None:
    names = ("CCW", "CW") if head == "direction" else ("1", "2")
    pairs = zip(ANGLE, error_um(ANGLE, 1.0), error_um(ANGLE, -1.0), strict=True)
    rows = [f"{a},{d},{name}" for a, *both in pairs for d, name in zip(both, names, strict=True)]
    first, second = read(tmp_path / "a.csv", "\n".join([f"angle [deg],deviation [µm],{head}", *rows]))
    assert first.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0))
    order = -1 if head == "direction" else 1
    assert second.samples["deviation_um"] == pytest.approx(error_um(ANGLE, -1.0)[::order])
    assert (first.meta.direction, second.meta.direction) == ("CCW", "CW" if order < 0 else "CCW")


def test_a_column_of_weeks_is_no_direction(tmp_path: Path) -> None:
    rows = [f"{a},{d},CW18" for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["angle [deg],deviation [µm],week", *rows]), encoding="utf-8")
    assert understand(path, Home(tmp_path / "home"), TOLD, {}).runs == (("a-ccw1", 720),)
    (run,) = read(path, path.read_text(encoding="utf-8").replace("deviation", "ccw"))
    assert run.meta.direction == "CCW"


def test_a_remark_tells_the_direction_and_a_column_of_other_feeds_is_told(tmp_path: Path) -> None:
    clock = np.arange(1440) / 10.0
    (run,) = read(tmp_path / "a.csv", "# CW\n" + table("t_s,angle_deg,deviation_um", clock[:720], ANGLE[::-1], ANGLE))
    assert run.meta.direction == "CW"
    twice, feeds = np.tile(ANGLE, 2), np.repeat([1000.0, 2000.0], 720)
    text = table("t_s,angle_deg,deviation_um,feed_mm_min", clock, twice, error_um(twice, 1.0), feeds)
    (run,) = read(tmp_path / "b.csv", text)
    assert "feed.told" in [finding.code for finding in judge_run(run)]


def test_a_column_of_directions_that_names_none_is_refused(tmp_path: Path) -> None:
    rows = [f"{a},{d},{way}" for way in "+-" for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True)]
    with pytest.raises(InputError, match="which way round") as refused:
        read(tmp_path / "a.csv", "\n".join(["angle [deg],deviation [µm],direction", *rows]))
    assert refused.value.got == "+, -"


@pytest.mark.parametrize(
    ("head", "names"),
    [
        ("plane", ("XY", "YZ")),
        ("Vorschub [mm/min]", ("1000", "2000")),
        ("Zustand", ("kalt", "warm")),
        ("No", ("1", "2")),
    ],
)
@pytest.mark.parametrize("heads", ["Winkel [°],Abweichung [µm]", "angle [deg],ccw [µm]"])
def test_rows_of_several_circles_are_no_second_turn(
    tmp_path: Path, heads: str, head: str, names: tuple[str, str]
) -> None:
    rows = [f"{a},{d},{name}" for name in names for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join([f"{heads},{head}", *rows]), encoding="utf-8")
    with pytest.raises(InputError, match="several circles") as refused:
        understand(path, Home(tmp_path / "home"), TOLD, {})
    assert refused.value.got == ", ".join(names)
    both = [f"{a},{d},{name}" for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True) for name in ("in", "out")]
    path.write_text("\n".join([f"{heads},Kanal", *both]), encoding="utf-8")
    with pytest.raises(InputError, match="several axes, channels"):
        understand(path, Home(tmp_path / "home"), TOLD, {})
    # Beside parts of one turn words may change.
    rows = [f"{a},{d},{names[int(a > 180.0)]}" for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True)]
    path.write_text("\n".join([f"{heads},{head}", *rows]), encoding="utf-8")
    assert len(understand(path, Home(tmp_path / "home"), TOLD, {}).runs) == 1


@pytest.mark.parametrize("head", ["run", "Messung Nr.", "repeat"])
def test_a_column_that_counts_runs_parts_them(tmp_path: Path, head: str) -> None:
    rows = [f"{n},{a},{d + n}" for n in (1, 2, 3) for a, d in zip(ANGLE, error_um(ANGLE, 1.0), strict=True)]
    runs = read(tmp_path / "a.csv", "\n".join([f"{head},angle_deg,deviation_um", *rows]))
    assert [run.meta.repeat for run in runs] == [1, 2, 3]
    for n, run in enumerate(runs, start=1):
        assert run.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0) + n)
    # What counts rows counts no runs.
    rows = [f"{n},{a},{a % 7}" for n, a in enumerate(ANGLE)]
    assert len(read(tmp_path / "b.csv", "\n".join([f"{head},angle_deg,deviation_um", *rows]))) == 1


@pytest.mark.parametrize(
    "heads",
    [
        "angle [deg],ccw Soll-Ist [µm]",
        "nominal - actual\nangle [deg],ccw [µm]",
        "positive = smaller radius\nangle [deg],ccw [µm]",
        "Vorzeichen: invertiert\nangle [deg],ccw [µm]",
        "Soll - Ist\nangle [deg],deviation [µm]",
    ],
)
def test_deviations_of_the_opposite_sign_are_refused(tmp_path: Path, heads: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(table(heads, ANGLE, error_um(ANGLE, 1.0)), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        understand(path, Home(tmp_path / "home"), TOLD, {})
    assert refused.value.code == "table.sign"


@pytest.mark.parametrize("unit", ["µ", "Mikron", "1/1000 mm"])
def test_names_of_a_micrometre(tmp_path: Path, unit: str) -> None:
    (run,) = read(tmp_path / "a.csv", table(f"angle [deg],ccw [{unit}]", ANGLE, error_um(ANGLE, 1.0)))
    assert run.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0), abs=1e-5)


@pytest.mark.parametrize(
    "heads",
    [
        "time [s],X cmd [mm],Y cmd [mm],X act [mm],Y act [mm]",
        "time [s],cmd X [mm],cmd Y [mm],act X [mm],act Y [mm]",
        "t [s],Xsoll [mm],Ysoll [mm],Xist [mm],Yist [mm]",
        "t [s],Command position X1 [mm],Command position Y1 [mm],Actual position X1 [mm],Actual position Y1 [mm]",
        "Zeit [s],X1 Sollposition [mm],Y1 Sollposition [mm],X1 Istposition [mm],Y1 Istposition [mm]",
    ],
)
def test_what_a_control_commanded_beside_its_coordinates_is_not_used(tmp_path: Path, heads: str) -> None:
    x, y = 150.0 * np.cos(np.radians(ANGLE)), 150.0 * np.sin(np.radians(ANGLE))
    grow = 1.0 + error_um(ANGLE, 0.0) / 150e3
    (run,) = read(tmp_path / "a.csv", table(heads, ANGLE, x, y, grow * x, grow * y))
    assert set(run.samples) == {"t_s", "angle_deg", "deviation_um"}
    assert run.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 0.0), abs=0.05)


@pytest.mark.parametrize(
    "title",
    [
        *(
            "Radius: 50,000 mm",
            "Kreisformtest, radius 50 mm",
            "Radius [mm];50",
            "Vorschub;2000 mm/min",
            "Feed: 2 m/min",
        ),
        *("Feed;2000;mm/min", "Plane: YZ", "ZX-Ebene", "G18 plane", "YZ circle", "Kreisdurchmesser: 150 mm"),
        *("0° = +Y", "Angles counted clockwise", "Winkel ab Y, im Uhrzeigersinn"),
        *("Nennradius (mm);50,000", "Länge der Kugelstange: 50 mm", "Vorschub F: 2 m/min", "# radius 50 mm"),
    ],
)
def test_a_condition_that_the_titles_tell_otherwise_is_refused(tmp_path: Path, title: str) -> None:
    text = table("angle [deg],ccw [µm]", ANGLE, error_um(ANGLE, 1.0)).replace(",", ";")
    right = "Radius: 150,0 mm, Vorschub: 1000 mm/min, R=150, plane Y-X, 0° = X, angle at my lathe, angles counted counterclockwise from X to Y"
    (run,) = read(tmp_path / "a.csv", f"{right}\n{text}")
    assert run.meta.direction == "CCW"
    with pytest.raises(InputError, match="another condition"):
        read(tmp_path / "a.csv", f"{title}\n{text}")


def test_what_titles_and_remarks_tell_need_not_be_stated_again(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    heads = "# Vorschub: 1,5 m/min\nEbene: G18\nRadius: 150,000 mm\nangle [deg];ccw [µm]"
    path.write_text(table(heads, ANGLE, error_um(ANGLE, 1.0), by=";"), encoding="utf-8")
    told = {"plane": "ZX", "radius_mm": 150.0, "feed_mm_min": 1500.0}
    assert open_table(path, {"machine": "m"}).entries[0].stated.items() >= told.items()
    understood = understand(path, Home(tmp_path / "home"), {}, {})
    assert (understood.told, understood.missing) == (told, ())
    for title, radius in {
        "Radius [mm];100": 100.0,
        "Tool radius: 25 mm": None,
        "R = 12,5 µm": None,
        "R=100": None,
    }.items():
        path.write_text(f"{title}\nVorschub: 1.000 mm/min\nangle [deg];ccw [µm]\n0;1\n1;2", encoding="utf-8")
        assert (told_above(path).get("radius_mm"), told_above(path)["feed_mm_min"]) == (radius, 1000.0)
    path.write_text(table(heads, ANGLE, error_um(ANGLE, 1.0), by=";"), encoding="utf-8")
    # Of two radii neither is taken.
    path.write_text("Radius: 100 mm\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    assert understand(path, Home(tmp_path / "home"), {}, {}).missing == ("radius_mm",)


def test_a_second_table_below_the_first_is_refused(tmp_path: Path) -> None:
    first = table("angle [deg],cw [µm]", ANGLE[::-1], error_um(ANGLE, -1.0))
    with pytest.raises(InputError, match="second table"):
        read(tmp_path / "a.csv", first + table("angle [deg],ccw [µm]", ANGLE, error_um(ANGLE, 1.0)))


def test_a_radius_beside_deviations_is_no_measurement(tmp_path: Path) -> None:
    text = table("angle_deg,radius_mm,deviation_um", ANGLE, ANGLE * 0.0 + 150.0, error_um(ANGLE, 1.0))
    (run,) = read(tmp_path / "a.csv", text)
    assert run.samples["deviation_um"] == pytest.approx(error_um(ANGLE, 1.0), abs=1e-5)
    path = tmp_path / "b.csv"
    path.write_text(text.replace("deviation_um", "deviation [µm]"), encoding="utf-8")
    assert not is_circle_table(path)


def test_both_directions_in_one_run_and_a_bar_that_is_fed_in_are_errors(tmp_path: Path) -> None:
    angle = np.arange(0.0, 360.0)
    there = np.concatenate([angle, angle[::-1]])
    (run,) = read(tmp_path / "both.csv", table("t_s,angle_deg,deviation_um", np.arange(720.0), there, np.sin(there)))
    assert "angle.both_ways" in {f.code for f in judge_run(run)}
    fed = np.concatenate([np.zeros(20), angle, np.full(20, 359.0)])
    ramp = np.linspace(-1500.0, 0.0, 20)
    moved = np.concatenate([ramp, np.sin(np.radians(2.0 * angle)), ramp[::-1]])
    (run,) = read(tmp_path / "fed.csv", table("t_s,angle_deg,deviation_um", np.arange(400.0), fed, moved))
    assert "angle.fed" in {f.code for f in judge_run(run)}
    (run,) = read(
        tmp_path / "still.csv",
        table("t_s,angle_deg,deviation_um", np.arange(400.0), fed, np.sin(np.radians(2.0 * fed))),
    )
    assert not {"angle.fed", "angle.both_ways"} & {f.code for f in judge_run(run)}


@pytest.mark.parametrize(
    ("heads", "runs"),
    [
        ("ccw 1000 [µm],cw 1000 [µm],ccw 5000 [µm],cw 5000 [µm]", 0),
        ("XY ccw [µm],XY cw [µm],YZ ccw [µm],YZ cw [µm]", 0),
        ("before ccw [µm],after ccw [µm]", 0),
        ("run 1 ccw [µm],run 1 cw [µm],run 2 ccw [µm],run 2 cw [µm]", 4),
        ("Abweichung ccw1 [µm],Abweichung cw1 [µm]", 2),
    ],
)
def test_columns_of_several_conditions_are_no_repeats(tmp_path: Path, heads: str, runs: int) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{t}," + ",".join(f"{n}.5" for n, _ in enumerate(heads.split(","))) for t in range(0, 361, 3)]
    path.write_text("\n".join([f"angle [deg],{heads}", *rows]), encoding="utf-8")
    stated = {"plane": "XY", "radius_mm": 150.0, "feed_mm_min": 1000.0}
    if runs:
        assert len(read_circle_runs(path, Campaign("a", "m"), stated)[0]) == runs
        return
    with pytest.raises(InputError, match="several planes, feeds, radii or machines"):
        read_circle_runs(path, Campaign("a", "m"), stated)


@pytest.mark.parametrize("step_deg", [15.0, 30.0, 45.0])
def test_far_steps_of_the_angle_are_no_turns(tmp_path: Path, step_deg: float) -> None:
    angle_deg = np.arange(20.0, 381.0, step_deg)
    rows = "".join(f"{k},{a % 360.0:.1f},{np.cos(np.radians(a)):.4f}\n" for k, a in enumerate(angle_deg))
    (tmp_path / "a.csv").write_text("t_s,angle_deg,deviation_um\n" + rows, encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(CIRCLE_FOLDER, encoding="utf-8")
    ((run,), _), *_ = open_source(tmp_path)[1]
    assert np.diff(run.samples["angle_deg"]) == pytest.approx(step_deg)
    assert not {f.code for f in judge_run(run)} & {"angle.direction", "arc.long", "angle.jump"}


@pytest.mark.parametrize(
    ("head", "way"),
    [("left1", "CCW"), ("rechts2", "CW"), ("guzs", "CCW"), ("左回り", "CCW"), ("lefthand", None), ("upright1", None)],
)
def test_a_side_with_a_number_is_a_direction(head: str, way: str | None) -> None:
    assert way_of_title(["Program", "O0123 (G02 I-150.)"]) == "CW"
    assert way_of(head) == way


def test_rows_of_numbers_that_stand_apart_below_the_table_are_no_readings(tmp_path: Path) -> None:
    angle = np.arange(360.0)
    text = table("angle [deg],ccw [µm],cw [µm]", angle, error_um(angle, 1.0), error_um(angle, -1.0))
    workbook = Workbook()
    for line in [*text.splitlines(), "", "360,12.5,14.1"]:
        workbook.active.append([float(cell) if line[0].isdigit() else cell for cell in line.split(",")] if line else [])
    workbook.save(tmp_path / "a.xlsx")
    for name, below in (("a.csv", "\n360,12.5,14.1\n"), ("b.csv", ",,\n1,2,3\n4,5,6\n"), ("a.xlsx", "")):
        if below:
            (tmp_path / name).write_text(text + below, encoding="utf-8")
        with pytest.raises(InputError, match="stand apart below") as refused:
            [*open_source(tmp_path / name, TOLD)[1]]
        assert refused.value.code == "circle_table.apart"
    # An end of the turn, a block of another direction, words, and empty rows everywhere are as before.
    assert len(read(tmp_path / "c.csv", text + "360,1.0,2.0\n\n,,\n")[0].samples["t_s"]) == 361
    assert len(read(tmp_path / "d.csv", text + "\nmean,12.5,14.1\n")[0].samples["t_s"]) == 360
    assert len(read(tmp_path / "e.csv", text.replace("\n", "\n\n"))[0].samples["t_s"]) == 360


def test_circles_side_by_side_are_parted_by_who_knows_which_is_which(tmp_path: Path) -> None:
    """The refusal spoke of a column that is no deviation."""
    heads = "angle [deg],ccw [µm],cw [µm],,angle [deg],ccw [µm],cw [µm]"
    one, other = error_um(ANGLE, 1.0), 2.0 * error_um(ANGLE, 1.0)
    with pytest.raises(InputError, match="one head and different readings") as refused:
        read(tmp_path / "a.csv", table(heads, ANGLE, one, one, ANGLE * 0.0, ANGLE, other, other))
    assert "a file for each" in str(refused.value.hint)


def test_a_file_of_another_program_is_sent_to_import(tmp_path: Path) -> None:
    (tmp_path / "a.lvm").write_text(table("angle [deg],ccw [µm]", ANGLE, error_um(ANGLE, 1.0)), encoding="utf-8")
    with pytest.raises(InputError, match=r"dtwin import a\.lvm"):
        open_source(tmp_path / "a.lvm")
