"""Tables in a spreadsheet (.xlsx), or packed (.zip, .gz), in Parquet under foreign names or as the one table of a page in HTML, read as the CSV that they would be saved as; files that are no tables, whatever their ending."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
import zipfile
from collections.abc import Collection, Iterator, Sequence
from datetime import date, datetime, time, timedelta
from functools import lru_cache
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any

import pyarrow as pa

from dtwin.acquire._html_table import table_of_page
from dtwin.acquire._parquet_file import foreign_table
from dtwin.acquire.axis_titles import axis_of, require_axis
from dtwin.acquire.foreign_columns import is_number
from dtwin.acquire.table_dialect import decoded, points_of, rows_of
from dtwin.acquire.xmlsafe import read_bounded, require_bounded
from dtwin.errors import InputError

SUFFIXES = (".xlsx", ".xlsm", ".xls", ".zip", ".gz")
LEFT_BY_SYSTEMS = re.compile(r"(^|/)(\.(?!\.)|__MACOSX/|Thumbs\.db$)")
"""Names in archives of what systems of computers keep beside files."""
_ZIP, _GZIP, _PARQUET, _OLE = b"PK\x03\x04", b"\x1f\x8b", b"PAR1", bytes.fromhex("d0cf11e0a1b11ae1")
_MARKUP = re.compile(r"\s*(<(!doctype|html|head|meta|body|table|style|\?xml|!--)|mime-version:)", re.I)
_TITLE = re.compile(r"<title[^>]{0,200}>([^<]{1,200})", re.I)
_MAX_BYTES = 32 * 1024**2
# Unpacked: a small archive may be a bomb.
_MAX_UNPACKED = 256 * 1024**2
_IN_ARCHIVES = (".csv", ".tsv", ".txt", ".dat", ".md", ".xlsx", ".xlsm", ".xls")
_SNIFFED, _FIRST_LINES = 65_536, 100
_LOOKED_AT = 200
_MOST_ROWS, _MOST_COLUMNS, _MOST_CELLS = 200_000, 512, 4_000_000
# Of a sheet of Excel; for rows that a file leaves out empty ones are read.
_LAST_ROW = 1_048_576
_FORMULA = re.compile(rb"<(\w+:)?f[ />]")
_HIDDEN_ROW = re.compile(
    rb'<(?:\w+:)?row\b[^>]*\bhidden="(?:1|true)"[^>]*(?<!/)>(?:<(?:\w+:)?c\b[^>]*/>)*<(?:\w+:)?c\b[^>]*(?<!/)>'
)
"""A row that is not shown, as a filter leaves it, with a cell that holds something."""
_HIDDEN_COLUMNS = re.compile(
    rb'<(?:\w+:)?col\b(?=[^>]*\bhidden="(?:1|true)")(?=[^>]*\bmin="(\d{1,5})")[^>]*\bmax="(\d{1,5})"'
)
_CHUNK, _BLOCK = 1024**2, 1000


def is_spreadsheet(path: Path) -> bool:
    """Tell by its ending, or its first bytes, whether a file is a spreadsheet or packed."""
    return path.suffix.lower() in SUFFIXES or (path.is_file() and _begin(path, len(_ZIP)).startswith((_ZIP, _GZIP)))


def _begin(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        return file.read(size)


def ending_as_table(path: Path) -> str:
    """Return the ending of a file in lower case; a spreadsheet counts as the CSV that is made of it."""
    return ".csv" if is_spreadsheet(path) else path.suffix.lower()


def table_bytes(path: Path, max_bytes: int, axis: str = "") -> bytes:
    """Return a table of text; of a spreadsheet its first sheet that holds a table and is not hidden, as CSV.

    ``axis``: the sheet that is called so, ``X``, ``X axis`` or by any name, is taken where there is one. A sheet without numbers below names, such as a
    cover, is none where another one has them. Two sheets with the same heads are refused otherwise: one axis would be read for the other.
    Formulas count as what the spreadsheet program last saved of them; one without a saved value is refused. Empty rows and columns are left
    out.

    Raises ``InputError`` when the file cannot be read, or is larger than ``max_bytes`` or than the limits of this
    module.
    """
    if not is_spreadsheet(path):
        return _table_of_text(path, read_bounded(path, max_bytes))
    require_bounded(path, _MAX_BYTES)
    data = _converted(path, path.stat().st_mtime_ns, axis)[0]
    if len(data) > max_bytes:
        raise _refused(path, f"{len(data) / 1e6:z.0f} MB as text", f"up to {max_bytes / 1e6:z.0f} MB")
    return data


def has_other_axes(path: Path, axis: str) -> bool:
    """Return whether a sheet is taken of several because it is called as an axis is."""
    return is_spreadsheet(path) and _converted(path, path.stat().st_mtime_ns, axis)[1]


def first_text(path: Path, max_bytes: int) -> str:
    """Return the beginning of a table as text, by which its form is known; ``max_bytes``: limit of a spreadsheet."""
    if is_spreadsheet(path):
        require_bounded(path, _MAX_BYTES)
        # Sheets of several axes are of one form.
        return decoded(_converted(path, path.stat().st_mtime_ns, None)[0][:_SNIFFED])
    text = decoded(_table_of_text(path, _begin(path, _SNIFFED)))
    # A line that is cut is no row.
    return text[: text.rfind("\n")] if path.stat().st_size > _SNIFFED and "\n" in text else text


def first_rows(path: Path, max_bytes: int) -> list[list[str]]:
    """Return the first rows of a table, by whose heads its form is known; arguments as :func:`first_text`."""
    return rows_of("\n".join(first_text(path, max_bytes).splitlines()[:_FIRST_LINES]))


@lru_cache(maxsize=4)
def _converted(path: Path, _changed_ns: int, axis: str | None) -> tuple[bytes, bool]:
    """Return a sheet as CSV, or the table of text that is there in its place or packed; and whether others were left for the axis.

    ``axis``: None takes the first of those with the same heads: they are of one form.
    """
    data: bytes = path.read_bytes()
    try:
        if data.startswith(_GZIP):
            with gzip.open(io.BytesIO(data)) as packed:
                data = packed.read(_MAX_UNPACKED + 1)
            if len(data) > _MAX_UNPACKED:
                raise _refused(path, "a large file unpacked", f"up to {_MAX_UNPACKED / 1e6:z.0f} MB")
        if data.startswith(_ZIP) and not _is_workbook(data):
            data = _only_table(path, data)
        if not _is_workbook(data):
            return _table_of_text(path, data), False
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            small = unpacked <= _MAX_UNPACKED
            # Few hold formulas, and to look for their values takes as long as to read the workbook twice.
            calculated = small and bool(_sheets_with(_FORMULA, archive))
            filtered = _sheets_with(_HIDDEN_ROW, archive) if small else set()
            folded = _hidden_columns(archive) if small else {}
        if unpacked > _MAX_UNPACKED:
            raise _refused(path, f"{unpacked / 1e6:z.0f} MB unpacked", f"up to {_MAX_UNPACKED / 1e6:z.0f} MB")
        book = _opened(data, data_only=True)
        try:
            # What is hidden is not what its reader sees.
            shown = [sheet for sheet in book.worksheets if sheet.sheet_state == "visible"]
            for sheet in shown:
                # How far it reaches by its own word is not believed.
                sheet.reset_dimensions()
            if calculated:
                _require_saved(path, data, shown)
            heads = {
                sheet.title: _heads(_rows(path, islice(sheet.iter_rows(values_only=True), _LOOKED_AT)))
                for sheet in shown
            }
            tables = [title for title, headed in heads.items() if headed]
            alike = [title for title in tables if heads[title] == heads[tables[0]]]
            wanted = (axis or "").strip().casefold()
            called = [title for title in tables if wanted and axis_of(title, bare=True) == wanted.upper()]
            called = called or [title for title in tables if wanted and title.strip().casefold() == wanted]
            others = len(called) == 1 < len(tables)
            if len(called) == 1:
                tables = called
            elif len(alike) > 1 and axis is not None:
                raise _several(path, alike)
            told = [named for title in tables[:1] if axis and (named := axis_of(title, bare=True))]
            require_axis(told, axis or "", path)
            sheets = [sheet for sheet in shown if sheet.title in tables[:1]] or shown
            for sheet in sheets:
                rows = _rows(path, sheet.iter_rows(values_only=True))
                if sum(map(len, rows)) > 1:
                    _require_shown(path, sheet, filtered, folded.get(sheet._worksheet_path, ()))
                    return _as_csv(rows), others
        finally:
            book.close()
    except InputError:
        raise
    # What a damaged or hostile archive raises is not documented: zlib, XML, keys and types.
    except Exception as error:
        still_packed = data.startswith(_GZIP)
        allowed = "a whole packed file" if still_packed else "a whole workbook of Excel 2007 or later"
        got = f"{type(error).__name__}: {error}"[:160]
        raise _refused(path, got, allowed, "packed file" if still_packed else "spreadsheet") from error
    raise _refused(path, "no sheet holds a table", "a sheet with a row of names and rows of values")


def _is_workbook(data: bytes) -> bool:
    if not data.startswith(_ZIP):
        return False
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return any(name.startswith("xl/") for name in archive.namelist())


def _only_table(path: Path, data: bytes) -> bytes:
    """Return the only file of an archive; refuse those of several: one would be read for all."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = [entry for entry in archive.infolist() if not entry.is_dir()]
        files = [entry for entry in files if not LEFT_BY_SYSTEMS.search(entry.filename)]
        small = len(files) == 1 and files[0].file_size <= _MAX_UNPACKED
        if small and Path(files[0].filename).suffix.lower() in _IN_ARCHIVES:
            return archive.read(files[0])
    raise InputError(
        "the archive is no single table",
        code="spreadsheet.archive",
        where=str(path),
        got=", ".join(entry.filename for entry in files)[:160] or "no file",
        allowed=f"one file, {', '.join(_IN_ARCHIVES)}, of up to {_MAX_UNPACKED / 1e6:z.0f} MB",
        hint="unpack it, and bring the folder with its campaign.toml, or each table",
    )


def _table_of_text(path: Path, data: bytes) -> bytes:
    """Return a text as it is, and the one table of a page in HTML with tabs between its cells, or of a file of Parquet; refuse what is none of these."""
    if data.startswith(_PARQUET):
        return _of_parquet(path, data)
    begin = decoded(data[:_SNIFFED])
    got = "a workbook of Excel 97 to 2003" if data.startswith(_OLE) else "an archive" if data.startswith(b"PK") else ""
    if _MARKUP.match(begin):
        rows = table_of_page(decoded(data))
        if _heads(rows):
            return "\n".join(map("\t".join, rows)).encode()
        title = _TITLE.search(begin)
        got = "a page in HTML or XML" + (f", {title[1].strip()[:60]!r}" if title else "")
    if not got:
        return data
    raise InputError(
        "the file is no table of text, whatever its ending",
        code="spreadsheet.form",
        where=str(path),
        got=got,
        allowed="text with commas, semicolons or tabs between columns; .xlsx; a page in HTML with one plain table",
        hint="open it in a spreadsheet program, look whether it shows the table, and save it as .xlsx or .csv",
    )


def _of_parquet(path: Path, data: bytes) -> bytes:
    """Return the cells of a file of Parquet as they would be written by hand."""
    try:
        table = foreign_table(path, pa.BufferReader(data))
        if table.num_rows <= _MOST_ROWS:
            blocks = ((column.to_pylist() for column in block.columns) for block in table.to_batches(_BLOCK))
            rows = chain.from_iterable(zip(*columns, strict=True) for columns in blocks)
            return _as_csv(_rows(path, chain([table.column_names], rows)))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _refused(path, str(error)[:160], "a whole file of Parquet") from error
    raise _refused(path, f"{table.num_rows} rows", f"up to {_MOST_ROWS} rows")


def _sheets_with(form: re.Pattern[bytes], archive: zipfile.ZipFile) -> set[str]:
    """Return in which sheets of a workbook, by their names in its archive, something of a form stands."""
    titles = set()
    for entry in archive.infolist():
        if entry.filename.startswith("xl/worksheets/"):
            with archive.open(entry) as sheet:
                end = b""
                while block := sheet.read(_CHUNK):
                    if form.search(end + block):
                        titles.add(entry.filename)
                        break
                    end = block[-_LOOKED_AT:]
    return titles


def _hidden_columns(archive: zipfile.ZipFile) -> dict[str, list[range]]:
    """Return which columns of each sheet are not shown, from 0; they stand before its cells."""
    hidden: dict[str, list[range]] = {}
    for entry in archive.infolist():
        if entry.filename.startswith("xl/worksheets/") and not entry.is_dir():
            with archive.open(entry) as sheet:
                told = _HIDDEN_COLUMNS.findall(sheet.read(_SNIFFED))
            hidden[entry.filename] = [range(int(first) - 1, int(last)) for first, last in told]
    return hidden


def _opened(data: bytes, *, data_only: bool = False) -> Any:
    """Open a workbook. One that does not say how far its sheets reach would be read to its end for that, which is not believed anyway."""
    import openpyxl
    from openpyxl.worksheet._read_only import ReadOnlyWorksheet

    setattr(ReadOnlyWorksheet, "_get_size", lambda sheet: None)  # noqa: B010
    # Of styles, names and dates beyond its calendar, which are nothing that is read here.
    warnings.filterwarnings("ignore", module="openpyxl")
    return openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=data_only, keep_links=False)


def _require_shown(path: Path, sheet: Any, filtered: Collection[str], folded: Sequence[range]) -> None:
    """Refuse a sheet with rows, or columns of numbers, that are not shown: figures would be of others than those that its reader sees."""
    rows = islice(sheet.iter_rows(values_only=True), _LOOKED_AT) if folded else ()
    numbers = any(
        isinstance(row[i], int | float) for row in rows for one in folded for i in one[: len(row)] if i < len(row)
    )
    if numbers or sheet._worksheet_path in filtered:
        what = "columns" if numbers else "rows"
        raise InputError(
            f"{what} of the sheet are hidden" + ", as by a filter" * (not numbers),
            code="spreadsheet.hidden",
            where=f"{path} {sheet.title}",
            got=f"{what} with values that the spreadsheet program does not show",
            allowed=f"a table of which all {what} are shown",
            hint=f"clear the filter and show all {what}; or copy those that are meant to a file of their own",
        )


def _require_saved(path: Path, data: bytes, sheets: Sequence[Any]) -> None:
    """Refuse a formula whose value was never calculated, as programs write it: it would count as a cell without a reading."""
    book = _opened(data)
    try:
        for sheet in sheets:
            book[sheet.title].reset_dimensions()
            for told, read in zip(book[sheet.title].iter_rows(), islice(sheet.iter_rows(), _LAST_ROW), strict=False):
                for formula, cell in zip(told, read, strict=False):
                    # A saved empty text has its type.
                    if formula.data_type == "f" and cell.value is None and cell.data_type != "str":
                        raise InputError(
                            "a cell holds a formula without a saved value",
                            code="spreadsheet.formula",
                            where=f"{path} {sheet.title}!{formula.coordinate}",
                            got=str(formula.value)[:60],
                            allowed="formulas with the value that a spreadsheet program saved",
                            hint="open the file in the spreadsheet program, save it there, and bring that; or write values instead",
                        )
    finally:
        book.close()


def _heads(rows: list[list[str]]) -> list[str]:
    """Return the row of names, in small letters, above the first of two rows with numbers; empty where a sheet, such as a cover, has no such table."""
    rows = [row for row in rows if any(row)]
    numbers = [n for n, row in enumerate(rows) if sum(is_number(cell.replace(",", ".")) for cell in row) > 1]
    return [cell.casefold() for cell in rows[numbers[0] - 1]] if len(numbers) > 1 and numbers[0] > 0 else []


def _rows(path: Path, cells: Iterator[Sequence[object]]) -> list[list[str]]:
    rows: list[list[str]] = []
    size = count = 0
    for number, row in enumerate(cells):
        if number == _LAST_ROW:
            raise _refused(path, f"a row below {_LAST_ROW}", "rows of a sheet of Excel")
        texts = [_text(cell) for cell in row]
        if not any(texts):
            # What stands apart below an empty row may be no reading.
            if rows and rows[-1]:
                rows.append([])
            continue
        rows.append(texts)
        # One long text may be that of many cells.
        size += sum(map(len, texts))
        if size > _MAX_UNPACKED:
            raise _refused(path, "long texts in many cells", f"up to {_MAX_UNPACKED / 1e6:z.0f} MB as text")
        count += len(texts)
        if count > _MOST_CELLS:
            raise _refused(
                path, f"more than {_MOST_CELLS} cells", f"up to {_MOST_CELLS} cells: keep the columns that are meant"
            )
        if len(rows) > _MOST_ROWS or len(texts) > _MOST_COLUMNS:
            raise _refused(
                path, f"{len(rows)} rows of {len(texts)} cells", f"up to {_MOST_ROWS} rows and {_MOST_COLUMNS} columns"
            )
    columns = (points_of(column) for column in zip_longest(*rows, fillvalue=""))
    return [list(row) for row in zip(*(column for column in columns if any(column)), strict=True)]


def _text(cell: object) -> str:
    if cell is None:
        return ""
    if isinstance(cell, datetime) and cell.time() == time():
        return cell.date().isoformat()
    if isinstance(cell, datetime | date):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        seconds = cell.total_seconds()
        return f"{int(seconds // 3600)}:{int(seconds // 60) % 60:02d}:{seconds % 60:z09.6f}"
    return repr(cell) if isinstance(cell, float) else str(cell).strip()


def _as_csv(rows: list[list[str]]) -> bytes:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(row if any(row) else [] for row in rows)
    return out.getvalue().encode()


def _several(path: Path, titles: Sequence[str]) -> InputError:
    named = next((axis for title in titles if (axis := axis_of(title, bare=True))), f'"{titles[0]}"')
    return InputError(
        "several sheets hold tables with the same heads",
        code="spreadsheet.sheets",
        where=str(path),
        got=", ".join(titles)[:160],
        allowed="one of them",
        hint=f"--axis {named} takes the sheet that is called so, in a positioning test; else save the sheet that is meant as CSV and bring that",
    )


def _refused(path: Path, got: str, allowed: str, what: str = "spreadsheet") -> InputError:
    return InputError(
        f"the {what} cannot be read",
        code="spreadsheet.unusable",
        where=str(path),
        got=got,
        allowed=allowed,
        hint="it may be cut short or damaged: copy it again; else save the table that is meant as CSV and bring that",
    )
