"""Tables of text as programs of many countries write them: encodings, marks between columns, columns of aligned text, decimal commas."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator, Sequence
from itertools import takewhile, zip_longest

STATISTICS = r"avg|average|mean|std|stdev|sigma|range|mittel\w*|spannweite|streuung|moyenne|media|promedio|平均"
SUMMARY = re.compile(rf"({STATISTICS}|min|max)\b", re.I)
"""A cell of a row that sums up the rows above it."""
_SNIFFED_LINES, _BELOW_HEADS = 100, 3
_SNIFFED_BYTES = 65_536
_LONGEST_CELL, _MOST_CELLS = 500, 10_000
# How each is read, how it is known, and the first bytes of its usual letters: what Windows writes in the West has few of these in pairs.
_EAST_ASIAN = (("cp932", "cp932", range(0x81, 0xA0)), ("gb18030", "gb2312", range(0xA1, 0xD8)))
DECIMALS = ("comma", "point")
# Digits, perhaps in groups, perhaps with an exponent.
_NUMBER = re.compile(r"[+-]?\d[\d.,]*(e[+-]?\d+)?", re.I)
# Both signs in one number leave no doubt.
_GROUPS = {"comma": re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+"), "point": re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d+")}
_SIMPLE = re.compile(r"[+-]?\d+[.,]\d+")
# A whole number in groups, by the decimal sign of its table; and one that needs none.
_WHOLE = {"comma": re.compile(r"[+-]?[1-9]\d{0,2}(\.\d{3})+"), "point": re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")}
_WHOLE_EITHER = re.compile("|".join(form.pattern for form in _WHOLE.values()))
# Signs, groups and marks of text as typesetters and spreadsheets write them.
_TYPESET = re.compile("['\u2019\u2212\u2013\u00a0\u2009\u202f]|\\d \\d")
_MINUS = {ord("\u2212"): "-", ord("\u2013"): "-"}
_PARTED = re.compile("(?<=\\d)['\u2019\u00a0\u2009\u202f ](?=\\d{3}(?!\\d))")
_HUNDREDS = re.compile(r"[+-]?[1-9]\d\d")
_SEPARATOR = re.compile(r'\A"?sep=."?[;,\t]*\r?\n', re.I)
_COMMENT = re.compile(r"\s*#(?!([;,])\s*[^;,\s][^;,]*\1)")
"""A line of remarks; where heads follow the mark at once, it is the head of a column that counts."""
_MARK = re.compile(r"\s*(#+|%+|//+)\s*")
_OF_READING = re.compile(r"\s*([+\-\u2212]?[.,]?\d.*|nan|[+-]?inf)?\s*", re.I)
"""A cell of a row of readings: a number, a stamp, or nothing."""
_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


def encoding_of(data: bytes) -> str:
    """Return the encoding of a text: by its first bytes, by zeros between letters, UTF-8, of China or Japan, else that of Windows."""
    for mark, name in _BOMS:
        if data.startswith(mark):
            return name
    begin = data[:2000]
    if begin[1::2].count(0) > len(begin) // 4:
        return "utf-16-le"
    if begin[::2].count(0) > len(begin) // 4:
        return "utf-16-be"
    try:
        # What was read in part may end within a letter.
        codecs.getincrementaldecoder("utf-8")().decode(data)
    except UnicodeDecodeError:
        return next((name for name, strict, leads in _EAST_ASIAN if _is_of(data, strict, leads)), "cp1252")
    return "utf-8"


def _is_of(data: bytes, strict: str, leads: range) -> bool:
    """Return whether a text is all of an encoding of two bytes a letter, and most of its letters begin with bytes of these."""
    try:
        text = codecs.getincrementaldecoder(strict)().decode(data[:_SNIFFED_BYTES])
    except UnicodeDecodeError:
        return False
    letters = [letter.encode(strict) for letter in set(text) if not letter.isascii()]
    return bool(letters) and 2 * sum(letter[0] in leads and len(letter) > 1 for letter in letters) > len(letters)


def decoded(data: bytes) -> str:
    """Return a text of any of the encodings; a letter that is none becomes a question mark. A spreadsheet's line ``sep=;``, the end mark of DOS and
    the mark before heads are left away.
    """
    text = data.decode(encoding_of(data), errors="replace").rstrip("\x1a")
    text = _SEPARATOR.sub("", text, count=1)
    lines = text[:_SNIFFED_BYTES].splitlines(keepends=True)
    if (marked := marked_heads(lines)) is None:
        return text
    at, heads = marked[0], marked[2]
    above = "".join(lines[:at])
    return f"{above}{heads}\n{text[len(above) + len(lines[at]) :]}"


def is_comment(line: str) -> bool:
    """Return whether a line is a remark and no row."""
    return _COMMENT.match(line) is not None


def marked_heads(lines: Sequence[str]) -> tuple[int, int, str] | None:
    """Return the line of heads that stand behind the mark of a remark, that of the first row below, and the heads; None where no such heads are.

    numpy and Klipper write ``# t_s,angle_deg,deviation_um`` so, and nothing but numbers below.
    """
    first = next((n for n, line in enumerate(lines) if line.strip() and not _is_marked(line)), 0)
    at = next((n for n in range(first - 1, -1, -1) if lines[n].strip()), None)
    if at is None:
        return None
    heads = _MARK.sub("", lines[at], count=1).strip()
    below = [line.strip() for line in lines[first : first + _BELOW_HEADS] if line.strip()]
    mark = next((mark for mark in (";", "\t", ",") if mark in below[0]), "")
    parted = [line.split(mark) for line in (heads, *below)] if mark else _aligned_rows([heads, *below], ",")
    alike = len({len(row) for row in parted}) == 1 and len(parted) > 1
    named = alike and not any(map(_OF_READING.fullmatch, parted[0]))
    return (at, first, heads) if named and all(map(_OF_READING.fullmatch, parted[1])) else None


def _is_marked(line: str) -> bool:
    return is_comment(line) or line.lstrip().startswith(("%", "//"))


def remarks_of(text: str) -> list[list[str]]:
    """Return the remarks that stand above a table, as titles of a cell each."""
    lines = (line for line in text.splitlines()[:_SNIFFED_LINES] if line.strip())
    return [
        [line.strip(" #\t")]
        for line in takewhile(lambda line: is_comment(line) or not _LONE_NUMBER.match(line), lines)
        if is_comment(line)
    ]


def mark_of(lines: list[str]) -> str:
    """Return what parts the columns: semicolons or tabs when half of the first lines have them, a blank where blanks do, else commas."""
    mark = _typed_mark(lines)
    return " " if _aligned_rows(lines, mark) else mark


def _typed_mark(lines: list[str]) -> str:
    first = lines[:_SNIFFED_LINES]
    return next((mark for mark in (";", "\t") if 2 * sum(mark in line for line in first) >= max(len(first), 1)), ",")


def rows_of(text: str, decimal: str = "") -> list[list[str]]:
    """Return the cells of a table without comments and empty lines; a decimal comma becomes a point. None of what has no table's width.

    ``decimal``: ``comma`` or ``point`` where it is told: the other one parts digits into groups. Empty: a comma is one where
    semicolons, tabs or blanks part the columns, or where it is quoted and no point stands in a number.
    """
    lines = [line for line in text.splitlines() if line.strip() and not is_comment(line)]
    mark = _typed_mark(lines)
    aligned = _aligned_rows(lines, mark)
    try:
        rows = aligned or list(csv.reader(lines, delimiter=mark))
    except csv.Error:
        return []
    if max(map(len, rows), default=0) > _MOST_CELLS:
        return []
    if len(rows) < len(lines) or max(map(len, lines), default=0) > _LONGEST_CELL:
        # What is longer is a remark, perhaps of several lines: heads are looked through for many words.
        rows = [[cell[:_LONGEST_CELL] for cell in row] for row in rows]
    mark = " " if aligned else mark
    rows = [row for row in rows if any(map(str.strip, row))]
    if _TYPESET.search(text):
        # Of a lone cell a blank may part columns.
        rows = [[typed(cell) for cell in row] if len(row) > 1 else row for row in rows]
    decimal = decimal or _grouped(rows)
    if decimal:
        return [[_plain(cell, decimal) for cell in row] for row in rows]
    # Quoted, a decimal comma stands among commas, too.
    if mark != "," or _quoted_commas(rows):
        return [[cell.replace(",", ".") for cell in row] for row in rows]
    return rows


def _quoted_commas(rows: list[list[str]]) -> bool:
    """Return whether numbers among commas hold decimal commas, and none a point."""
    commas = (cell for cell in _having(",", rows) if _NUMBER.fullmatch(cell))
    if all(map(_WHOLE["point"].fullmatch, commas)):
        return False
    return not any(map(_NUMBER.fullmatch, _having(".", rows)))


def _having(sign: str, rows: list[list[str]]) -> Iterator[str]:
    """Return the cells that have a sign: most tables have it in no cell, or tell by the first ones what is asked."""
    return (cell.strip() for row in rows for cell in row if sign in cell)


def typed(cell: str) -> str:
    """Return a number as a keyboard types it, with a hyphen for minus and without what parts its digits; anything else as it is."""
    if not _TYPESET.search(cell):
        return cell
    plain = _PARTED.sub("", cell.strip().lstrip("'\u2019").strip().translate(_MINUS))
    plain = re.sub(r"^([+-])\s", r"\1", plain)
    return plain if _NUMBER.fullmatch(plain) else cell


def _grouped(rows: list[list[str]]) -> str:
    """Return the decimal sign that digits in groups tell; nothing where none are, or both.

    ``1.234,5`` and ``1,234.5`` tell it alone. So do ``1.200`` in a column with ``800`` where no point stands elsewhere, and ``2.000`` and
    ``4.500``, where the table writes decimals by the other sign, too.
    """
    both = (cell for cell in _having(",", rows) if "." in cell)
    told = {sign for cell in both for sign, form in _GROUPS.items() if form.fullmatch(cell)}
    if told:
        sign = told.pop()
        # A number such as 20.5 beside 1.234,5 says that the other sign parts decimals, too.
        other = "." if sign == "comma" else ","
        mixed = any(_SIMPLE.fullmatch(cell) and not _WHOLE[sign].fullmatch(cell) for cell in _having(other, rows))
        return "" if told or mixed else sign
    for sign, form in _WHOLE.items():
        mark, other = (",", ".") if sign == "comma" else (".", ",")
        if any(_NUMBER.fullmatch(cell) and not form.fullmatch(cell) for cell in _having(other, rows)):
            continue
        parted = [cell for cell in _having(other, rows) if form.fullmatch(cell)]
        if parted:
            decimals = any(
                _NUMBER.fullmatch(cell) and not _WHOLE_EITHER.fullmatch(cell) for cell in _having(mark, rows)
            )
            columns = (list(map(str.strip, column)) for column in zip_longest(*rows, fillvalue=""))
            among = any(
                any(map(form.fullmatch, column)) and any(map(_HUNDREDS.fullmatch, column)) for column in columns
            )
            if among or (decimals and all(number.endswith("00") for number in parted)):
                return sign
    return ""


def points_of(column: Sequence[str]) -> list[str]:
    """Return a column of a spreadsheet, whose numbers have points, with the numbers that were typed as text in the same form.

    A text such as ``1,234`` stays as it is where no other text of the column tells its decimal sign.
    """
    texts = [typed(cell) for cell in column]
    commas = [text for text in texts if "," in text and _NUMBER.fullmatch(text)]
    comma = any(
        _GROUPS["comma"].fullmatch(text) or (_SIMPLE.fullmatch(text) and not _WHOLE["point"].fullmatch(text))
        for text in commas
    )
    point = any(_GROUPS["point"].fullmatch(text) for text in commas)
    if comma == point:
        return texts
    return [_plain(text, "comma" if comma else "point") if "," in text else text for text in texts]


def _plain(cell: str, decimal: str) -> str:
    """Return a number with a point and without groups; anything else as it is, a date or a number of the other sign, too."""
    text, (mark, other) = cell.strip(), (",", ".") if decimal == "comma" else (".", ",")
    grouped = _GROUPS[decimal].fullmatch(text) or _WHOLE[decimal].fullmatch(text)
    if not _NUMBER.fullmatch(text) or (other in text and not grouped):
        return cell
    return text.replace(other, "").replace(mark, ".")


_LONE_NUMBER = re.compile(r"[+\-\u2212]?(\d[\d.,]*(?<![.,])|\.\d+)(e[+-]?\d+)?", re.I)
_GAP = re.compile(r"\s*\t\s*|\s{2,}")
# A unit belongs to the head in front of it.
_BLANK = re.compile(r"\s+(?![\[(])")
_RULE = re.compile(r"[-=_+\s]+")
_BLANK_GROUPS = re.compile(r"\d \d{3}(?!\d)")
_OTHER_MARKS = re.compile(r"[;|=]")
_FIRST = 100


def _aligned_rows(lines: Sequence[str], mark: str) -> list[list[str]]:
    """Return the rows of a table that blanks part, titles as rows of one cell; empty where another mark parts it, or where it is in doubt.

    ``mark``: what parts the columns otherwise. Every row of numbers, and the heads above, have as many cells; two words with one blank between
    them are one head, unless all heads and numbers are parted so.
    """
    if len(lines) > _FIRST and not _aligned_rows(lines[:_FIRST], mark):
        return []
    lines = [line.strip() for line in lines if not _RULE.fullmatch(line)]
    numbers = [n for n, line in enumerate(lines) if _holds_numbers(line)]
    leading = [n for n in numbers if _LONE_NUMBER.fullmatch(lines[n].split()[0])]
    # Below a number stand numbers: a head may be Target 1 2 3, and a last row Mean 1.2 1.3.
    body = set(leading if len(leading) > 1 else numbers)
    begin = min(body, default=0)
    if len(body) < 2 or begin == 0 or any(_OTHER_MARKS.search(lines[n]) for n in body):
        return []
    told = [lines[n] for n in (begin - 1, *sorted(body))]
    if min(line.count(mark) for line in told) == max(line.count(mark) for line in told) > 0:
        return []
    for part in (_GAP, _BLANK):
        widths = {len(part.split(line)) for line in told[1:]}
        # A lone blank may stand within the digits of a number.
        doubt = part is _BLANK and any(map(_BLANK_GROUPS.search, told[1:])) and any(map(_GAP.search, told[1:]))
        heads = next((h for p in (_GAP, _BLANK) if len(h := p.split(told[0])) in widths), [])
        if len(widths) == 1 and heads and len(heads) > 1 and not doubt:
            rows = [part.split(line) if n in body else _GAP.split(line) for n, line in enumerate(lines)]
            rows[begin - 1] = heads
            return [row if len(row) == len(heads) else [line] for row, line in zip(rows, lines, strict=True)]
    return []


def _holds_numbers(line: str) -> bool:
    cells = line.split()
    numbers = [_LONE_NUMBER.fullmatch(cell) is not None for cell in cells]
    return sum(numbers) > 1 and 2 * sum(numbers) >= len(cells) and (numbers[0] or numbers[-1])
