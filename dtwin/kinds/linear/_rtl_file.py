"""Files ``.rtl`` and ``.pos`` of laser interferometers: targets in mm, and deviations in um, run by run.

The form is known from public programs that read or write it, not from a file of a real instrument: sections as ``TARGET DATA::``,
keys as ``Target-count:``, the positions after ``Targets :``, and after ``Run Target Data:`` lines of run, target and deviation.
Forward runs count the targets up, reverse runs down. A second number of ``Flags:`` that is 1 means one direction only; a program
fills the runs between with zeros then. A ``.pos`` may hold means by direction instead, in mm, as ``Position  Forward ... Error``.
German keys are from memory.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtwin.acquire.axis_titles import axis_of, require_axis
from dtwin.acquire.table_dialect import decoded
from dtwin.acquire.xmlsafe import number_or_none, read_bounded
from dtwin.errors import InputError
from dtwin.positioning.assignments import Reading
from dtwin.positioning.position_runs import runs_of
from dtwin.positioning.position_table import matrix_of
from dtwin.positioning.table_heads import OTHER_TEST, TURNS
from dtwin.schema import Campaign, Finding, Run
from dtwin.units import UM_PER_MM

SUFFIXES = (".rtl", ".pos")
_MAX_BYTES = 8 * 1024 * 1024
_MOST_TARGETS = 2000
# Of lines without blanks at their ends: of two parts that both take them, a long line has no end.
_SECTION = re.compile(r"^([^:]{1,40}?)\s*::$")
_KEY = re.compile(r"^([^:]{1,40}?)\s*:\s*(.*)$")
_MEANS = re.compile(r"^position\s+(\w+)\b.*error$", re.I)
_TARGETS = {"targets", "ziele", "zielpositionen"}
_DATA = {"run target data", "lauf ziel daten", "lauf-ziel-daten"}
_COUNTS = {"target-count": "targets", "zielanzahl": "targets", "run-count": "runs", "laufanzahl": "runs"}
_FLAGS = {"flags", "merker"}
_SAID = (
    "machine",
    "maschine",
    "serial no",
    "seriennr",
    "date",
    "datum",
    "by",
    "von",
    "axis",
    "achse",
    "title",
    "titel",
)
_OTHER = re.compile(
    rf"{OTHER_TEST.pattern}|\b(yaw|gier\w*|theta|rotary|arc ?sec)\b|^(unit|einheit)\w*:.*\b(in|inch(es)?|zoll|deg|[mu]?rad)\b",
    re.I,
)
"""A key with its value that is of another test, or of lengths in other units."""
_WAYS = {"forward": "forward", "reverse": "reverse", "backward": "reverse"}


@dataclass
class _Content:
    """What a file says; deviations by run in the order of the lines: number of the target from 1, um."""

    targets_mm: list[float] = field(default_factory=list)
    runs: dict[int, list[tuple[int, float]]] = field(default_factory=dict)
    means: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    one_way: bool = False
    said: list[str] = field(default_factory=list)


def read_rtl_runs(path: Path, campaign: Campaign, stated: Mapping[str, Any]) -> tuple[list[Run], list[dict[str, Any]]]:
    """Read a file as runs, each one cycle of both directions.

    ``stated``: the ``[[run]]`` entry; repeats count on from the one that it states.

    Raises ``InputError`` when a line is not of the form, the axis turns or is another one than the file says, or targets and deviations do not belong together.
    """
    content = _content(path)
    axis = str(stated.get("condition", {}).get("axis", ""))
    told = [axis_of(said.partition(" ")[2], bare=True) for said in content.said if said.startswith(("axis", "achse"))]
    require_axis([one for one in told if one], axis, path)
    if TURNS.fullmatch(axis):
        raise InputError(
            "such files are read as lengths, and by its name the axis turns: nobody knows what the units of its file are",
            code="rtl.axis",
            where=str(path),
            got=f"axis {axis}",
            allowed="an axis that moves along, such as X",
            hint="a table with units, such as target [°], forward 1 [″], is read as one of a rotary axis",
        )
    findings = [
        Finding("rtl.untried", "info", "this form was never tried with a file of a real instrument: compare a figure")
    ]
    if content.said:
        findings.append(Finding("rtl.said", "info", "the file says: " + "; ".join(content.said)[:300]))
    readings = _readings(content, findings, path) if content.runs else _of_means(content, findings)
    if not readings:
        raise _wrong("the file holds no deviations", path, f"{len(content.targets_mm)} targets")
    return runs_of(matrix_of(readings, path), path, stated, findings), []


def _content(path: Path) -> _Content:
    content, collecting = _Content(), ""
    for number, line in enumerate(decoded(read_bounded(path, _MAX_BYTES)).splitlines(), start=1):
        where = Path(f"{path} line {number}")
        line = line.strip()
        key, means = _KEY.match(line), _MEANS.match(line)
        if not line:
            continue
        if _SECTION.match(line):
            collecting = ""
        elif means:
            collecting = means[1].lower()
            content.means.setdefault(collecting, [])
        elif key:
            if _OTHER.search(line):
                raise _wrong("the file says that it is of another test, or in other units", where, line[:60])
            collecting = _keyed(content, " ".join(key[1].lower().split()), key[2].strip(), where)
            if collecting == "targets":
                content.targets_mm += _numbers(key[2], where)
        elif collecting == "targets":
            content.targets_mm += _numbers(line, where)
        elif collecting == "data":
            cells = _numbers(line, where)
            if len(cells) != 3 or not all(cell.is_integer() and cell >= 1 for cell in cells[:2]):
                raise _wrong("a line of deviations is not run, target, deviation", where, line.strip()[:60])
            content.runs.setdefault(int(cells[0]), []).append((int(cells[1]), cells[2]))
        elif collecting:
            cells = _numbers(line, where)
            if len(cells) != 2:
                raise _wrong("a line of means is not position, error", where, line.strip()[:60])
            content.means[collecting].append((cells[0], cells[1]))
        if len(content.targets_mm) > _MOST_TARGETS:
            raise _wrong("too many targets", path, f"more than {_MOST_TARGETS}")
    return content


def _keyed(content: _Content, key: str, value: str, where: Path) -> str:
    """Keep what a key says, and return what the lines below it are: targets, data or nothing."""
    if key in _COUNTS:
        numbers = _numbers(value, where)
        content.counts[_COUNTS[key]] = int(numbers[0]) if numbers else 0
    elif key in _FLAGS:
        content.one_way = value.split()[1:2] == ["1"]
    elif key in _SAID and value:
        content.said.append(f"{key} {value[:60]}")
    return "targets" if key in _TARGETS else "data" if key in _DATA else ""


def _readings(content: _Content, findings: list[Finding], path: Path) -> list[Reading]:
    targets, told = content.targets_mm, content.counts
    most = max(number for rows in content.runs.values() for number, _ in rows)
    if told.get("targets", len(targets)) != len(targets) or most > len(targets):
        said = f"{told.get('targets', most)} told, {len(targets)} positions, number {most} read"
        raise _wrong("the number of targets is not what the file says", path, said)
    runs = dict(content.runs)
    if content.one_way:
        padding = [run for run, rows in runs.items() if run % 2 == 0 and not any(value for _, value in rows)]
        runs = {run: rows for run, rows in runs.items() if run not in padding}
        if padding:
            findings.append(Finding("rtl.padding", "info", f"one direction: {len(padding)} runs of zeros are left out"))
    down = {run for run, rows in runs.items() if targets[rows[-1][0] - 1] < targets[rows[0][0] - 1]}
    if not content.one_way and not down and len(runs) > 1:
        down = {run for run in runs if run % 2 == 0}
        text = "no run counts its targets down: every second one is taken for a reverse run"
        findings.append(Finding("rtl.directions", "warning", text))
    if len(content.runs) < told.get("runs", 0):
        text = f"the file tells {told['runs']} runs and holds {len(content.runs)}"
        findings.append(Finding("rtl.short", "warning", text))
    cycles = {"forward": 0, "reverse": 0}
    readings: list[Reading] = []
    for run in sorted(runs):
        way = "reverse" if run in down else "forward"
        cycles[way] += 1
        readings += [(targets[number - 1], way, cycles[way], value, False) for number, value in runs[run]]
    return readings


def _of_means(content: _Content, findings: list[Finding]) -> list[Reading]:
    findings.append(Finding("rtl.means", "warning", "the file holds means alone: repeatability cannot be told"))
    return [
        (at, _WAYS[name], 1, error * UM_PER_MM, False)
        for name, rows in content.means.items()
        if name in _WAYS
        for at, error in rows
    ]


def _numbers(text: str, where: Path) -> list[float]:
    values = [number_or_none(word.replace(",", ".")) for word in text.split()]
    numbers = [value for value in values if value is not None and abs(value) < 1e7]
    if len(numbers) < len(values):
        raise _wrong("not a number", where, text.strip()[:60])
    return numbers


def _wrong(message: str, where: Path, got: str) -> InputError:
    return InputError(
        message,
        code="rtl.form",
        where=str(where),
        got=got,
        allowed="Targets : positions in mm; Run Target Data: lines of run, target and deviation in µm",
        hint="docs/how-to/positioning-table.md",
    )
