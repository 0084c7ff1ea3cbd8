"""Columns of large tables: read in blocks, and the same as if read at once."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dtwin.acquire._lone_table import safe_name
from dtwin.acquire._parquet_file import require_moderate
from dtwin.acquire._tabular import kind_of_table, read_columns
from dtwin.acquire.ingest import open_source
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.acquire.xmlsafe import number_or_none
from dtwin.errors import InputError
from dtwin.lake.rows import columns_sha256
from dtwin.report.checking import check_source

# Some blocks of a megabyte.
ROWS = 150_000


def written(path: Path, last: str) -> Path:
    ways = ("forward", "reverse", "forward")
    rows = [f"{n},{n % 400},{ways[n % 3]},0" for n in range(ROWS)]
    path.write_text("\n".join(["t_s,position_mm,direction,error_um", *rows, last]) + "\n", encoding="utf-8")
    return path


def test_a_column_of_integers_that_ends_in_a_fraction_is_read(tmp_path: Path) -> None:
    columns, rejects = read_columns(written(tmp_path / "a.csv", f"{ROWS},1,reverse,0.25"), "linear")
    assert (columns["error_um"][0], columns["error_um"][-1]) == (0.0, 0.25)
    assert columns["direction"].dtype == object
    assert [columns["direction"][n] for n in (0, 1, 2, ROWS)] == ["forward", "reverse", "forward", "reverse"]
    assert rejects == []
    # One string a word, not one a row.
    assert len({id(word) for word in columns["direction"]}) == 2


def test_a_word_far_down_is_refused_with_its_row(tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_columns(written(tmp_path / "a.csv", f"{ROWS},1,reverse,lost"), "linear")
    assert refused.value.code == "columns.number"
    assert "lost" in str(refused.value.got)


def test_a_picture_under_the_name_of_a_table_is_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(bytes.fromhex("ffd8ffe000104a464946818f"))
    with pytest.raises(InputError) as refused:
        read_columns(tmp_path / "a.csv", "circular")
    assert refused.value.got == "bytes that are no text"


def test_a_number_is_one_to_others_than_python_too() -> None:
    assert [number_or_none(text) for text in ("1e3", "1_000", "inf", "nan", "")] == [1000.0, None, None, None, None]


def test_true_and_false_are_no_numbers(tmp_path: Path) -> None:
    columns = {"t_s": [0.0, 1.0], "angle_deg": [0.0, 1.0], "deviation_um": [True, False]}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    with pytest.raises(InputError) as refused:
        read_columns(tmp_path / "a.parquet", "circular")
    assert refused.value.code == "columns.number"


@pytest.mark.parametrize(("every", "severity"), [(10, "warning"), (1, "")])
def test_a_column_that_takes_most_rows_with_it_is_a_warning(tmp_path: Path, every: int, severity: str) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n / 10},{n},{n % 7},{'' if n % every else 20.1}" for n in range(361)]
    path.write_text("\n".join(["t_s,angle_deg,deviation_um,air_c", *rows]), encoding="utf-8")
    (run,) = check_source(path, told={"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1047.0})["runs"]
    found = [f["severity"] for f in run["findings"] if f["code"] == "rows.rejected"]
    assert found == ([severity] if severity else [])


@pytest.mark.parametrize("kind", [pa.timestamp("us", tz="Europe/Berlin"), pa.timestamp("ns"), pa.duration("ms")])
def test_times_that_parquet_holds_as_such_are_seconds(tmp_path: Path, kind: pa.DataType) -> None:
    begin = 0 if pa.types.is_duration(kind) else 1_774_000_000_000
    per = {"us": 1000, "ns": 1_000_000, "ms": 1}[kind.unit]
    t = pa.array([per * (begin + 5 * n) for n in range(9)]).cast(kind)
    numbers = np.arange(9.0)
    pq.write_table(pa.table({"t_s": t, "angle_deg": numbers, "deviation_um": numbers}), tmp_path / "a.parquet")
    columns, _ = read_columns(tmp_path / "a.parquet", "circular")
    assert columns["t_s"] == pytest.approx(0.005 * numbers, abs=1e-12)


@pytest.mark.parametrize("size", [0, 1, 3, 65_536, 65_537])
def test_the_hash_of_words_is_that_of_one_json_array(size: int) -> None:
    words = np.array([("forward", 'rück"wärts', None)[n % 3] for n in range(size)], dtype=object)
    whole = f"way |O {size};".encode() + json.dumps(words.tolist()).encode()
    assert columns_sha256({"way": words}) == hashlib.sha256(whole).hexdigest()


def test_separators_at_the_ends_of_lines_are_no_columns_and_one_name_for_two_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,angle_deg,deviation_um,,\n0,0,1,,\n1,1,2,,\n", encoding="utf-8")
    columns, rejects = read_columns(path, "circular")
    assert (set(columns), rejects) == ({"t_s", "angle_deg", "deviation_um"}, [])
    path.write_text("t_s,angle_deg,deviation_um,deviation_um\n0,0,1,3\n", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_columns(path, "circular")
    assert (refused.value.code, refused.value.got) == ("columns.twice", "deviation_um")


def test_directions_of_a_positioning_run_may_be_written_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = [f"{n},{n},{'Forward' if n < 5 else '-1'},0.1" for n in range(10)]
    path.write_text("\n".join(["t_s,position_mm,direction,error_um", *rows]), encoding="utf-8")
    (run,) = next(iter(open_source(path, {"axis": "X"})[1]))[0]
    assert run.samples["direction"].tolist() == ["forward"] * 5 + ["reverse"] * 5


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "cp1252"])
def test_a_table_is_read_in_the_encodings_of_windows(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.csv"
    # More than one block, so that letters of two bytes are cut, too.
    rows = [f"{n},{n},0.5" for n in range(60_000)]
    text = "\n".join(["# Prüfstand, µm", "# 2026", "t_s,angle_deg,deviation_um", *rows])
    path.write_bytes(text.encode(encoding))
    columns, rejects = read_columns(path, "circular")
    assert columns["angle_deg"].tolist() == list(range(60_000))
    assert rejects == []
    assert kind_of_table(path) == "circular"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize(
    ("name", "above", "between"), [("a.csv", "# ", ","), ("a.csv", "# mill 7\n#", ";"), ("a.txt", "% ", "  ")]
)
def test_heads_behind_the_mark_of_a_remark_are_read_as_numpy_writes_them(
    tmp_path: Path, name: str, above: str, between: str, encoding: str
) -> None:
    path = tmp_path / name
    rows = [between.join(map(str, row)) for row in ((0.25 * n, float(n), 0.5) for n in range(361))]
    heads = between.join(["time_s" if name == "a.txt" else "t_s", "angle_deg", "deviation_um"])
    path.write_text("\n".join([above + heads, *rows]), encoding=encoding)
    told = {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1000.0}
    (run,) = next(iter(open_source(path, told)[1]))[0]
    assert run.samples["angle_deg"] == pytest.approx(range(361))
    assert set(run.samples) == {"t_s", "angle_deg", "deviation_um"}


def test_a_table_of_numbers_alone_is_asked_for_heads(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("# made here\n1,  2296.497861,  -442.566334\n2,  2331.149279,  -547.654703\n", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        kind_of_table(path)
    assert (refused.value.code, refused.value.got) == ("columns.heads", "1,   2296.497861,   -442.566334")


def test_a_row_that_is_not_as_long_as_the_first_is_named_without_the_words_of_the_reader(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("foo;bar\nmessung 1\n1;2\n")
    with pytest.raises(InputError) as refused:
        read_columns(path, "rotary")
    assert refused.value.got == "row 2 has 1 cell, the first row 2: messung 1"


def test_pandas_is_not_read_for_a_table_of_numbers_and_text(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t_s,angle_deg,deviation_um,direction\n" + "".join(f"{a},{a},0.5,CW\n" for a in range(400)))
    code = (
        "import sys; from pathlib import Path; from dtwin.acquire._tabular import read_columns\n"
        f"columns, _ = read_columns(Path({str(path)!r}), 'circular')\n"
        "print(len(columns['angle_deg']), 'pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["400", "False"]


def test_a_file_of_parquet_that_unpacks_to_very_much_is_refused_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = np.arange(40.0)
    columns = {"t_s": numbers, "angle_deg": 9.0 * numbers, "deviation_um": numbers}
    for kind in (pa.string(), pa.large_string(), pa.dictionary(pa.int32(), pa.string())):
        note = pa.array(["x" * 40_000] * 40, kind)
        pq.write_table(pa.table({**columns, "note": note}), tmp_path / "word.parquet")
        with pytest.raises(InputError, match="too large when it is unpacked") as error:
            read_columns(tmp_path / "word.parquet", "circular")
        assert error.value.got == "a cell of 40000 bytes in 'note'"
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    assert len(read_columns(tmp_path / "a.parquet", "circular")[0]["t_s"]) == 40
    monkeypatch.setitem(require_moderate.__kwdefaults__, "most_values", 100)
    for reader in (lambda path: read_columns(path, "circular"), lambda path: table_bytes(path, 10**6)):
        with pytest.raises(InputError, match="too large when it is unpacked") as error:
            reader(tmp_path / "a.parquet")
        assert error.value.got == "120 values"


def test_a_file_of_parquet_that_would_end_the_process_is_refused(tmp_path: Path) -> None:
    """Records of columns that contradict the schema: to look at them aborts in the library of Parquet."""
    numbers = np.arange(40.0)
    table = pa.table({"t_s": numbers, "angle_deg": 9.0 * numbers, "deviation_um": numbers})
    path = tmp_path / "a.parquet"
    pq.write_table(table, path, store_schema=False)
    optional, required = b"\x25\x02\x18\x03t_s", b"\x25\x00\x18\x03t_s"
    whole = path.read_bytes()
    assert whole.count(optional) == 1
    path.write_bytes(whole.replace(optional, required))
    with pytest.raises(InputError) as refused:
        read_columns(path, "circular")
    assert refused.value.code == "table.malformed"
    pq.write_table(table.append_column("x_um", pa.array([[1.0, 2.0]] * 40)), path)
    with pytest.raises(InputError) as refused:
        read_columns(path, "circular")
    assert (refused.value.code, refused.value.where) == ("table.nested", f"{path} x_um")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Müller Straße.csv", "mueller-strasse"),
        ("Mu\u0308hle", "muehle"),
        ("a.b", "a.b"),
        ("...", "unnamed"),
        ("CON.csv", "table-con"),
    ],
)
def test_a_name_is_what_people_would_write_without_umlauts(text: str, name: str) -> None:
    assert safe_name(text) == name


def test_names_of_other_alphabets_are_not_one() -> None:
    names = [safe_name(text) for text in ("旋盤", "フライス盤", "旋盤1", "Ось")]
    assert len({*names}) == 4
    assert all(map(str.isascii, names))


def test_a_lone_line_without_an_end_is_told_as_that(tmp_path: Path) -> None:
    """numpy writes a vector so; it was called a first line of more than a megabyte."""
    (tmp_path / "a.csv").write_text("-6.02,-0.22,145.9", encoding="utf-8")
    with pytest.raises(InputError, match="one line without an end"):
        kind_of_table(tmp_path / "a.csv")
