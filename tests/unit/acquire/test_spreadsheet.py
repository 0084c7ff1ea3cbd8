"""Tables in a spreadsheet: the same as their CSV, and what is refused."""

from __future__ import annotations

import gzip
import os
import re
import zipfile
from datetime import datetime, time, timedelta
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dtwin.acquire._html_table import table_of_page
from dtwin.acquire.ingest import ingest, open_source
from dtwin.acquire.spreadsheet import table_bytes
from dtwin.errors import InputError
from dtwin.lake.store import Lake


def write(path: Path, rows: list[list[object]], *, above: int = 0, first_sheet_empty: bool = False) -> Path:
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    if first_sheet_empty:
        sheet = book.create_sheet("data")
    for number, row in enumerate(rows, start=1 + above):
        for column, value in enumerate(row, start=2):
            sheet.cell(number, column, value)
    book.save(path)
    return path


def circle(n: int = 400) -> list[list[object]]:
    angle = np.linspace(0.0, 360.0, n)
    error = 3.0 * np.sin(2 * np.radians(angle)) + 0.1 * np.random.default_rng(0).standard_normal(n)
    head: list[object] = ["t_s", "angle_deg", "deviation_um"]
    return [head, *([0.05 * i, float(a), float(e)] for i, (a, e) in enumerate(zip(angle, error, strict=True)))]


def require_alike(lake: Lake, one: str, other: str, runs: int) -> None:
    pairs = list(zip(lake.runs(one), lake.runs(other), strict=True))
    assert len(pairs) == runs
    for left, right in pairs:
        first, second = lake.load(left).samples, lake.load(right).samples
        assert set(first) == set(second)
        for name, values in first.items():
            if values.dtype.kind == "f":
                np.testing.assert_allclose(values, second[name], rtol=0.0, atol=1e-9)
            else:
                assert values.tolist() == second[name].tolist()


def test_a_circle_in_a_spreadsheet_is_the_same_run_as_its_csv(tmp_path: Path) -> None:
    rows = circle()
    told = {"plane": "XY", "radius_mm": 100.0, "feed_mm_min": 1000.0, "machine": "mill"}
    sheet = write(tmp_path / "sheet.xlsx", rows, above=3, first_sheet_empty=True)
    (tmp_path / "text.csv").write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    lake = Lake(tmp_path / "lake")
    ingest(sheet, lake, told=told)
    ingest(tmp_path / "text.csv", lake, told=told)
    require_alike(lake, "sheet", "text", 1)


def test_what_a_library_misses_in_the_styles_of_a_workbook_is_not_printed(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    whole, bare = write(tmp_path / "whole.xlsx", circle()), tmp_path / "bare.xlsx"
    with zipfile.ZipFile(whole) as read, zipfile.ZipFile(bare, "w") as written:
        for name in read.namelist():
            written.writestr(name, re.sub(rb"<cellStyles.*</cellStyles>", b"", read.read(name)))
    assert table_bytes(bare, 10**6) == table_bytes(whole, 10**6)
    assert not recwarn.list


def test_a_positioning_table_in_a_spreadsheet_is_recognised(tmp_path: Path) -> None:
    head: list[object] = ["target_mm", "forward 1 um", "reverse 1 um", "forward 2 um", "reverse 2 um"]
    rows = [head, *([10.0 * i, 0.1 * i, 0.1 * i + 2.0, 0.1 * i + 0.1, 0.1 * i + 2.1] for i in range(11))]
    lake = Lake(tmp_path / "lake")
    text = tmp_path / "text.csv"
    text.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")
    told = {"axis": "X", "machine": "mill"}
    ingest(text, lake, told=told)
    ingest(write(tmp_path / "sheet.xlsx", rows), lake, told=told)
    require_alike(lake, "sheet", "text", 2)


def test_the_table_behind_a_cover_is_read_and_two_tables_alike_are_refused(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    cover = book.active
    assert cover is not None
    for told in (("Customer", "A. Smith"), ("Temperature", 20.3), ("Day", "3 May")):
        cover.append(told)
    rows = [["target_mm", "forward 1 um"], [0.0, 1.0], [10.0, 2.0]]
    for name in ("X", "Y"):
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
        if name == "X":
            book.save(tmp_path / "x.xlsx")
            assert table_bytes(tmp_path / "x.xlsx", 10**6).startswith(b"target_mm,forward 1 um")
    book.save(tmp_path / "xy.xlsx")
    with pytest.raises(InputError) as refused:
        table_bytes(tmp_path / "xy.xlsx", 10**6)
    assert "X, Y" in str(refused.value.got)


def test_an_archive_that_is_a_bomb_is_refused(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.xlsx"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * (300 * 1024**2))
    with pytest.raises(InputError, match="the spreadsheet cannot be read"):
        table_bytes(bomb, 1)


def test_a_row_far_below_all_others_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its own word: for rows that a file leaves out empty ones are read."""
    monkeypatch.setattr("dtwin.acquire.spreadsheet._LAST_ROW", 1000)
    path = write(tmp_path / "sheet.xlsx", [["a", "b"], [1.0, 2.0], [2.0, 3.0]])
    book = openpyxl.load_workbook(path)
    assert book.active is not None
    book.active["B1002"] = 1.0
    book.save(path)
    with pytest.raises(InputError) as refused:
        table_bytes(path, 10**6)
    assert refused.value.got == "a row below 1000"


def test_a_long_text_in_very_many_cells_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "words.parquet"
    pq.write_table(pa.table({"a": [1.0] * 400, "b": ["x" * 3000] * 400}), path)
    assert len(table_bytes(path, 10**7)) > 1_200_000
    monkeypatch.setattr("dtwin.acquire.spreadsheet._MAX_UNPACKED", 10**6)
    with pytest.raises(InputError) as refused:
        table_bytes(path, 10**7)
    assert refused.value.got == "long texts in many cells"


def test_a_sheet_of_very_many_cells_is_refused_and_none_is_read_to_know_how_far_it_reaches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "many.xlsx", circle())
    monkeypatch.setattr("openpyxl.worksheet._reader.WorkSheetParser.parse_dimensions", None)
    assert table_bytes(path, 10**6)
    monkeypatch.setattr("dtwin.acquire.spreadsheet._MOST_CELLS", 100)
    os.utime(path, (0, 0))
    with pytest.raises(InputError, match="cannot be read") as caught:
        table_bytes(path, 10**6)
    assert caught.value.got == "more than 100 cells"


def test_xml_that_names_entities_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "sheet.xlsx", [["a", "b"], [1.0, 2.0]])
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    doctype = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY e SYSTEM "file:///etc/passwd">]>'
    parts["xl/workbook.xml"] = doctype + parts["xl/workbook.xml"].split(b"?>")[-1]
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match="the spreadsheet cannot be read"):
        table_bytes(path, 1)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.integers(0, 6000), byte=st.integers(0, 255), cut=st.integers(0, 6000))
def test_a_damaged_spreadsheet_is_read_or_refused_with_a_message(
    tmp_path: Path, where: int, byte: int, cut: int
) -> None:
    whole = write(tmp_path / "whole.xlsx", circle(20)).read_bytes()
    data = bytearray(whole)
    data[where % len(data)] = byte
    damaged = tmp_path / f"damaged-{where}-{byte}-{cut}.xlsx"
    damaged.write_bytes(bytes(data[: max(1, len(data) - cut)]))
    code = ""
    try:
        table_bytes(damaged, 1)
    except InputError as error:
        code = error.code
    # Where its first bytes are others, it is no form that is known.
    assert code in ("", "spreadsheet.unusable", "spreadsheet.form")


def test_a_hidden_sheet_is_not_read_and_heads_are_alike_in_any_letters(tmp_path: Path) -> None:
    heads = ["target [mm]", "forward 1 [µm]", "reverse 1 [µm]"]
    book = openpyxl.Workbook()
    book.active.title = "old"
    book.active.sheet_state = "hidden"
    shown = book.create_sheet("new")
    for sheet, size in ((book["old"], 10.0), (shown, 1.0)):
        sheet.append(heads)
        for target in (0.0, 100.0, 200.0):
            sheet.append([target, size, 2.0 * size])
    book.active = 1
    book.save(tmp_path / "a.xlsx")
    assert table_bytes(tmp_path / "a.xlsx", 10**6).decode().splitlines()[1] == "0,1,2"
    other = book.create_sheet("Y")
    for row in shown.iter_rows(values_only=True):
        other.append([str(cell).upper() if cell in heads else cell for cell in row])
    book.save(tmp_path / "b.xlsx")
    with pytest.raises(InputError, match="several sheets") as refused:
        table_bytes(tmp_path / "b.xlsx", 10**6)
    assert refused.value.got == "new, Y"


def test_a_formula_without_a_saved_value_is_refused_with_its_place(tmp_path: Path) -> None:
    rows = circle(50)
    rows[7][2] = "=2*3"
    with pytest.raises(InputError) as refused:
        table_bytes(write(tmp_path / "sheet.xlsx", rows), 1 << 20)
    assert refused.value.code == "spreadsheet.formula"
    assert "Sheet!D8" in str(refused.value.where)


def test_a_formula_whose_saved_value_is_an_empty_text_is_an_empty_cell(tmp_path: Path) -> None:
    rows = circle(50)
    rows[7][2] = "=2*3"
    written = write(tmp_path / "written.xlsx", rows)
    with zipfile.ZipFile(written) as source, zipfile.ZipFile(tmp_path / "saved.xlsx", "w") as saved:
        for entry in source.infolist():
            data = source.read(entry)
            saved.writestr(entry, data.replace(b'<c r="D8"><f>2*3</f><v />', b'<c r="D8" t="str"><f>2*3</f><v></v>'))
    lines = table_bytes(tmp_path / "saved.xlsx", 1 << 20).decode().splitlines()
    assert lines[7].endswith(",")
    assert len(lines) == 51


def test_numbers_that_were_typed_as_text_are_those_of_their_column(tmp_path: Path) -> None:
    rows: list[list[object]] = [["a", "b", "c", "d"]]
    rows += [[1.234, "0,5", "1,234", 800], [20.5, "1.234,5", "5", 1200.125], [3.5, "\u22121,250", "7", 2.5]]
    lines = table_bytes(write(tmp_path / "a.xlsx", rows), 1 << 20).decode().splitlines()
    assert lines == ["a,b,c,d", '1.234,0.5,"1,234",800', "20.5,1234.5,5,1200.125", "3.5,-1.250,7,2.5"]


def test_days_and_times_of_cells_are_stamps(tmp_path: Path) -> None:
    rows: list[list[object]] = [["Date", "Time", "Elapsed", "Z [µm]"]]
    rows += [[datetime(2026, 11, 25), time(14, 3, n), timedelta(hours=25, seconds=n), 0.5] for n in range(3)]
    lines = table_bytes(write(tmp_path / "a.xlsx", rows), 1 << 20).decode().splitlines()
    assert lines[2] == "2026-11-25,14:03:01,25:00:01.000000,0.5"


TABLE = "target [mm]{0}forward 1 [µm]{0}reverse 1 [µm]\n0{0}1{0}2\n100{0}2{0}3\n"
PAGE = (
    "<!DOCTYPE html>\n<html><head><title>Sign in</title></head><body><table><tr><td>1</td></tr></table></body></html>"
)


def page_of(text: str) -> str:
    rows = ("".join(f"<td><b>{cell}</b>\n</td>" for cell in line.split("\t")) for line in text.splitlines())
    table = "".join(f"<tr>{row}</tr>" for row in rows).replace("µ", "&micro;")
    return f"<html><head><title>Export</title><style>td {{}}</style></head><body><h1>X axis</h1><table>{table}</table></body></html>"


def test_a_cell_of_a_page_is_cut_where_it_is_no_reading_any_more() -> None:
    # Uncut, each part would copy all those before it.
    ((cell,),) = table_of_page("<table><tr><td>" + "<b>part " * 5000)
    assert cell.startswith("part part ")
    assert len(cell) < 2000


def packed(path: Path, members: dict[str, bytes]) -> bytes:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path.read_bytes()


@pytest.mark.parametrize("ending", [".xls", ".xlsx", ".zip", ".csv", ".csv.gz"])
def test_a_table_is_read_by_what_it_is_whatever_its_ending(tmp_path: Path, ending: str) -> None:
    text = TABLE.format("\t").encode()
    book = write(tmp_path / "book.xlsx", [["target [mm]", "forward 1 [µm]", "reverse 1 [µm]"], [0, 1, 2], [100, 2, 3]])
    contents = {
        "text": text,
        "utf-16": TABLE.format("\t").encode("utf-16"),
        "archive": packed(tmp_path / "a.zip", {"__MACOSX/._x": b"", "x/table.csv": text}),
        "packed": gzip.compress(text),
        "archive of a book": packed(tmp_path / "b.zip", {"book.xlsx": book.read_bytes()}),
        "book": book.read_bytes(),
        "page": page_of(TABLE.format("\t")).encode(),
    }
    for name, content in contents.items():
        path = tmp_path / f"{name}{ending}"
        path.write_bytes(content)
        runs = next(iter(open_source(path, {"axis": "X"})[1]))[0]
        assert [run.n_samples for run in runs] == [4], name


def test_rows_that_a_filter_hides_are_refused_and_empty_ones_are_not(tmp_path: Path) -> None:
    path = write(tmp_path / "book.xlsx", circle())
    book = openpyxl.load_workbook(path)
    sheet = book.active
    assert sheet is not None
    sheet.row_dimensions[900].hidden = True
    book.save(path)
    table_bytes(path, 10**6)
    sheet.row_dimensions[50].hidden = True
    book.save(path)
    with pytest.raises(InputError) as refused:
        table_bytes(path, 10**6)
    assert refused.value.code == "spreadsheet.hidden"
    sheet.row_dimensions[50].hidden = False
    # Columns beyond the table are nobody's.
    for letter, holds_numbers in (("Z", False), ("B", True)):
        sheet.column_dimensions[letter].hidden = True
        book.save(path)
        if holds_numbers:
            with pytest.raises(InputError, match="columns of the sheet are hidden"):
                table_bytes(path, 10**6)
        else:
            table_bytes(path, 10**6)


def test_a_packed_file_that_is_cut_or_grows_without_bounds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "table.csv.gz"
    whole = gzip.compress(TABLE.format("\t").encode())
    path.write_bytes(whole)
    assert open_source(path, {"axis": "X"})[0].name == "table"
    path.write_bytes(whole[:-9])
    with pytest.raises(InputError, match="the packed file cannot be read") as refused:
        open_source(path, {"axis": "X"})
    assert "cut short" in str(refused.value.hint)
    monkeypatch.setattr("dtwin.acquire.spreadsheet._MAX_UNPACKED", 10)
    path.write_bytes(whole)
    with pytest.raises(InputError) as refused:
        open_source(path, {"axis": "X"})
    assert refused.value.code == "spreadsheet.unusable"


@pytest.mark.parametrize("ending", [".csv", ".xls", ".xlsx", ".txt"])
@pytest.mark.parametrize(
    ("content", "got"),
    [
        (PAGE.encode(), "'Sign in'"),
        (PAGE.encode("utf-16"), "HTML"),
        # Of two tables, of merged and of hidden cells nobody knows which are meant.
        (page_of(TABLE.format("\t")).replace("</body>", "<table></table></body>").encode(), "'Export'"),
        (page_of(TABLE.format("\t")).replace("<td>", "<td rowspan=2>", 1).encode(), "'Export'"),
        (page_of(TABLE.format("\t")).replace("<td>", "<td style='display: none'>", 1).encode(), "'Export'"),
        (b'<?xml version="1.0"?><Workbook/>', "XML"),
        (bytes.fromhex("d0cf11e0a1b11ae1") + bytes(600), "Excel 97"),
        (b"PK\x05\x06" + bytes(18), "an archive"),
        (b"<html><title>" + b" " * 60_000, "HTML"),
    ],
)
def test_pages_and_old_workbooks_are_told_as_what_they_are(
    tmp_path: Path, content: bytes, got: str, ending: str
) -> None:
    path = tmp_path / f"table{ending}"
    path.write_bytes(content)
    with pytest.raises(InputError) as refused:
        open_source(path, {"axis": "X"})
    assert refused.value.code == "spreadsheet.form"
    assert got in str(refused.value.got)


def test_an_archive_of_several_tables_is_refused(tmp_path: Path) -> None:
    packed(tmp_path / "a.zip", {"x.csv": b"1", "y.csv": b"2"})
    with pytest.raises(InputError, match="no single table"):
        table_bytes(tmp_path / "a.zip", 10**6)


def test_a_packed_table_keeps_to_the_limit_of_its_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    packed(path, {"x.csv": b"0,0\n" * 1000})
    assert len(table_bytes(path, 4000)) == 4000
    with pytest.raises(InputError, match="cannot be read") as refused:
        table_bytes(path, 3999)
    assert "as text" in str(refused.value.got)
