from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dtwin.acquire._readings import parse_readings
from dtwin.acquire.b5r import read_b5r, write_b5r
from dtwin.acquire.ingest import ingest
from dtwin.acquire.quality import judge_run
from dtwin.errors import InputError
from dtwin.lake.store import Lake


def test_real_file_is_read_as_it_states(real_recording: Path) -> None:
    test = read_b5r(real_recording)
    assert [run.meta.direction for run in test.runs] == ["CCW", "CW"]
    assert [run.n_samples for run in test.runs] == [3182, 2976]
    assert [run.window for run in test.runs] == [(795, 2385), (766, 2208)]
    ccw = test.runs[0]
    assert ccw.samples["deviation_um"][0] == pytest.approx(-248.42)
    assert ccw.meta.vendor == pytest.approx(
        {
            "centre_a_um": -78.0,
            "centre_b_um": 1.6,
            "best_radius_mm": 99.9954,
            "circularity_um": 393.3,
            "feed_mm_min": 4742.0,
        }
    )
    assert test.instrument["calibrated_mm"] == 100.0015
    assert test.instrument["calibrated_on"] == "2021-10-11"
    assert test.instrument["expansion_um_per_m_k"] == 11.7
    assert test.instrument["calibrator_temperature_c"] == 20.0
    # The file limits the best radius to 99.95 to 100.05 mm.
    assert test.instrument["tolerances"] == {"D": {"low": -50.0, "high": 50.0}}
    assert test.diagnostics["AF_BACKLASH_B_GLOBAL"] == -66.1


def _with_limits(source: Path, path: Path, limits: str) -> Path:
    """Write the file with other limits of the best radius."""
    text = source.read_text(encoding="utf-8")
    begin = text.index('<FEATURE_SPEC NAME="AF_BEST_RADIUS"')
    path.write_text(text[:begin] + limits + text[text.index("</RUN_SPEC>", begin) :], encoding="utf-8")
    return path


def test_of_several_levels_the_widest_is_the_tolerance(real_recording: Path, tmp_path: Path) -> None:
    levels = "".join(
        f'<TOLERANCE LEVEL="{name}"><LOWER_LIMIT>0</LOWER_LIMIT><UPPER_LIMIT>{high}</UPPER_LIMIT></TOLERANCE>'
        for name, high in (("WARNING", 0.02), ("FAIL", 0.03))
    )
    limits = f'<FEATURE_SPEC NAME="AF_CIRCULARITY" DT="UT_LENGTH_MM">{levels}</FEATURE_SPEC>'
    found = read_b5r(_with_limits(real_recording, tmp_path / "a.b5r", limits)).instrument["tolerances"]
    assert found == {"G(CCW)": {"high": 30.0}, "G(CW)": {"high": 30.0}}


@pytest.mark.parametrize(
    ("unit", "low", "high"),
    [("UT_LENGTH_MM", "50.0", "nan"), ("UT_LENGTH_MM", "100.1", "99.9"), ("UT_ANGLE", "99.9", "100.1")],
)
def test_a_tolerance_that_is_none_is_left_away(
    real_recording: Path, tmp_path: Path, unit: str, low: str, high: str
) -> None:
    level = f'<TOLERANCE LEVEL="WARNING"><LOWER_LIMIT>{low}</LOWER_LIMIT><UPPER_LIMIT>{high}</UPPER_LIMIT></TOLERANCE>'
    limits = f'<FEATURE_SPEC NAME="AF_BEST_RADIUS" DT="{unit}">{level}</FEATURE_SPEC>'
    assert "tolerances" not in read_b5r(_with_limits(real_recording, tmp_path / "a.b5r", limits)).instrument


def test_a_scale_factor_and_a_temperature_that_may_be_in_fahrenheit_are_told(
    real_recording: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.b5r"
    text = real_recording.read_bytes().replace(b"<SCALE_FACTOR>1<", b"<SCALE_FACTOR>1.25<")
    path.write_bytes(text.replace(b"<RUN_TEMPERATURE>20.0<", b"<RUN_TEMPERATURE>68.0<"))
    run = read_b5r(path).runs[0]
    assert [finding.code for finding in run.findings] == ["b5r.scale"]
    told = {finding.code: finding.message for finding in judge_run(run)}
    assert "as °F that is 20.0 °C" in told["run.temperature"]
    assert "run.temperature" not in [finding.code for finding in judge_run(read_b5r(real_recording).runs[0])]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'VIEW="+A+B"', b'VIEW="-A+B"'),
        (b'TEST_PLANE="XY"', b'TEST_PLANE="YX"'),
        (b"<A_AXIS_NAME>X", b"<A_AXIS_NAME>Z"),
        (b"<A_AXIS_NAME>X", b"<A_AXIS_NAME>U"),
    ],
)
def test_a_plane_that_is_not_that_of_its_axes_is_told(
    real_recording: Path, tmp_path: Path, old: bytes, new: bytes
) -> None:
    assert not read_b5r(real_recording).runs[0].findings
    path = tmp_path / "a.b5r"
    path.write_bytes(real_recording.read_bytes().replace(old, new))
    told = [finding.code for finding in read_b5r(path).runs[0].findings]
    # Other letters are names that somebody gave.
    assert told == ([] if new.endswith(b"U") else ["b5r.plane"])


def test_angles_follow_the_indices_and_the_direction(real_recording: Path) -> None:
    for run in read_b5r(real_recording).runs:
        assert run.window is not None
        start, end = run.window
        angle = run.samples["angle_deg"]
        turned = angle[end - 1] - angle[start]
        expected = 360.0 * (end - start - 1) / (end - start)
        assert angle[start] == 0.0
        assert turned == pytest.approx(expected if run.meta.direction == "CCW" else -expected)


def test_part_of_a_circle_is_run_back_over_the_same_part(real_recording: Path, tmp_path: Path) -> None:
    data = real_recording.read_bytes()
    path = _with(tmp_path / "half.b5r", real_recording, b"<END_ANGLE>360<", b"<END_ANGLE>180<")
    for run in read_b5r(path).runs:
        assert run.window is not None
        angle = run.samples["angle_deg"]
        begin, last = angle[run.window[0]], angle[run.window[1] - 1]
        assert (begin, round(last)) == ((0.0, 180) if run.meta.direction == "CCW" else (180.0, 0))
    # From X towards Z is from Z towards X the other way round, told from the other axis.
    path.write_bytes(data.replace(b'TEST_PLANE="XY"', b'TEST_PLANE="XZ"'))
    for before, run in zip(read_b5r(real_recording).runs, read_b5r(path).runs, strict=True):
        assert (run.meta.plane, run.meta.direction) == ("ZX", "CW" if before.meta.direction == "CCW" else "CCW")
        assert np.array_equal(run.samples["angle_deg"], 90.0 - before.samples["angle_deg"])


def test_written_file_is_read_back_the_same(real_recording: Path, tmp_path: Path) -> None:
    runs = read_b5r(real_recording).runs
    copy = tmp_path / "copy.b5r"
    write_b5r(copy, runs, name='<a & "b">', machine="m & n")
    again = read_b5r(copy)
    assert again.machine == "m & n"
    for before, after in zip(runs, again.runs, strict=True):
        assert after.window == before.window
        assert after.meta.direction == before.meta.direction
        np.testing.assert_array_equal(after.samples["deviation_um"], before.samples["deviation_um"])
        np.testing.assert_allclose(after.samples["angle_deg"], before.samples["angle_deg"])


def test_runs_of_different_tests_are_not_written_together(real_recording: Path, tmp_path: Path) -> None:
    one, two = read_b5r(real_recording).runs
    other = replace(two, meta=replace(two.meta, feed_mm_min=1.0))
    with pytest.raises(InputError, match="share plane, radius and feed"):
        write_b5r(tmp_path / "x.b5r", [one, other], name="x", machine="m")
    assert not (tmp_path / "x.b5r").exists()


@pytest.mark.parametrize("torn", ["+0.1\n2345 -0.00001", "+0.12345 -\n0.00001", "+0.12345-0.00001"])
def test_torn_numbers_are_joined(torn: str) -> None:
    np.testing.assert_array_equal(parse_readings(torn, "x"), [0.12345, -0.00001])


def test_unsigned_numbers_are_separated_by_space() -> None:
    np.testing.assert_array_equal(parse_readings("0.1 0.25\n3", "x"), [0.1, 0.25, 3.0])
    np.testing.assert_array_equal(parse_readings("1, 2, 3", "x"), [1.0, 2.0, 3.0])


def test_decimal_commas_are_read_as_such() -> None:
    np.testing.assert_array_equal(parse_readings("+0,12\n345 -\n0,00001", "x"), [0.12345, -0.00001])
    np.testing.assert_array_equal(parse_readings("0,1 -0,25\n3,0", "x"), [0.1, -0.25, 3.0])


@pytest.mark.parametrize("bad", ["nan 1.0", "+1.0 inf", "0.1 abc"])
def test_what_is_no_finite_number_is_refused(bad: str) -> None:
    with pytest.raises(InputError):
        parse_readings(bad, "x")


def _with(path: Path, real: Path, old: bytes, new: bytes) -> Path:
    data = real.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        (b"<START_INDEX>796<", b"<START_INDEX>99999<", "b5r.window"),
        (b"<START_INDEX>796<", b"<START_INDEX>-4<", "b5r.field"),
        (b"<END_INDEX>2385<", b"<END_INDEX>1e9<", "b5r.field"),
        (b"<SAMPLE_RATE>200.000<", b"<SAMPLE_RATE>0<", "b5r.field"),
        (b"<SAMPLE_RATE>200.000<", b"<SAMPLE_RATE>nan<", "b5r.field"),
        (b"<TEST_RADIUS>100<", b"<TEST_RADIUS><", "b5r.field"),
        (b"-0.29488", b"-0.2x488", "readings.number"),
        (b"<TEST_DOCUMENT>", b"<OTHER_DOCUMENT>", "xml.malformed"),
        (b'TEST_PLANE="XY"', b'TEST_PLANE="QQ"', "run.plane"),
    ],
)
def test_impossible_fields_are_named(real_recording: Path, tmp_path: Path, old: bytes, new: bytes, code: str) -> None:
    broken = _with(tmp_path / "x.b5r", real_recording, old, new)
    with pytest.raises(InputError) as caught:
        read_b5r(broken)
    assert caught.value.code == code
    assert str(broken) in (caught.value.where or "") or code == "run.plane"


def test_missing_direction_is_named(real_recording: Path, tmp_path: Path) -> None:
    data = real_recording.read_bytes()
    run = data.index(b"<BALLBAR_RUN>")
    cut = data[:run] + data[run:].replace(b"<RUN_DIRECTION>CCW</RUN_DIRECTION>", b"", 1)
    path = tmp_path / "x.b5r"
    path.write_bytes(cut)
    with pytest.raises(InputError, match="does not say its direction"):
        read_b5r(path)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999])
def test_truncation_is_noticed_wherever_it_is(real_recording: Path, tmp_path: Path, share: float) -> None:
    data = real_recording.read_bytes()
    path = tmp_path / "cut.b5r"
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError):
        read_b5r(path)


BOMB = b"""<?xml version="1.0"?><!DOCTYPE z [<!ENTITY a "aaaaaaaaaa">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>
<TEST_DOCUMENT>&c;</TEST_DOCUMENT>"""
OUTSIDE = b"""<?xml version="1.0"?><!DOCTYPE z [<!ENTITY x SYSTEM "file:///etc/passwd">]>
<TEST_DOCUMENT>&x;</TEST_DOCUMENT>"""


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (BOMB, "xml.hostile"),
        (OUTSIDE, "xml.hostile"),
        (b"<a>" * 200_000, "xml.absurd"),
        (b"<TEST_DOCUMENT>" + b"<a/>" * 300_000 + b"</TEST_DOCUMENT>", "xml.absurd"),
        (b"<TEST_DOCUMENT " + b'a="1" ' * 100_000 + b"/>", "xml.absurd"),
        (("<TEST_DOCUMENT>" + "<é/>" * 300_000 + "</TEST_DOCUMENT>").encode(), "xml.absurd"),
        (b"<TEST_DOCUMENT>" + b"&" * 3_000_000 + b"</TEST_DOCUMENT>", "xml.malformed"),
        (b"PK\x03\x04\x00\x00", "xml.binary"),
        (b"", "file.empty"),
        (b"   \n", "file.empty"),
        (b"<TEST_DOCUMENT></TEST_DOCUMENT>", "b5r.no_runs"),
        (b"<html><body>404</body></html>", "b5r.root"),
    ],
)
def test_hostile_and_foreign_files_are_refused_cheaply(tmp_path: Path, data: bytes, code: str) -> None:
    path = tmp_path / "hostile.b5r"
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read_b5r(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert caught.value.code == code
    assert peak < 200e6


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.b5r"
    with path.open("wb") as handle:
        handle.truncate(10 * 1024**3)
    with pytest.raises(InputError, match="too large"):
        read_b5r(path)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_b5r(tmp_path / "nothing.b5r")


def test_a_file_of_another_machine_of_the_lake_is_told(real_recording: Path, tmp_path: Path) -> None:
    (run, _) = read_b5r(real_recording).runs
    lake = Lake(tmp_path / "lake")
    told = []
    for machine in ("mill-6", "mill-5"):
        folder = tmp_path / machine
        folder.mkdir()
        write_b5r(folder / "a.b5r", [run], name="a", machine="mill-6")
        head = f'[campaign]\nname = "of-{machine}"\nmachine = "{machine}"\n'
        (folder / "campaign.toml").write_text(head + '[[run]]\nid = "a"\nfile = "a.b5r"\n', "utf-8")
        told.append("run.other_machine" in {finding.code for _, finding in ingest(folder, lake).findings})
    assert told == [False, True]
    (folder / "campaign.toml").write_text(
        head.replace("mill-5", "Mill-5") + '[[run]]\nid = "a"\nfile = "a.b5r"\n', "utf-8"
    )
    (alike,) = [f for run, f in ingest(folder, lake).findings if not run and f.code == "campaign.machine_alike"]
    assert "--set machine=mill-5" in alike.message
