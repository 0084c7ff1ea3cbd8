"""The report of a twin: of what machine and test it is and what was found, then the whole story."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.documents import read_document
from dtwin.errors import InputError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import by_campaign
from dtwin.lake.store import Lake
from dtwin.physics.effect import Effect
from dtwin.physics.twin import Twin
from dtwin.pipeline.campaign_certificate import facts_of
from dtwin.pipeline.kept import sheet_of_campaign, stamp_of, variation_of
from dtwin.report.campaign import sheet_section
from dtwin.report.faults import faults, found_faults
from dtwin.report.html import Section, Table, page
from dtwin.report.language import Language
from dtwin.report.pdf import write_document
from dtwin.report.text import VERDICTS
from dtwin.report.twin_of_kind import report_of, with_nan
from dtwin.twins.of_kind import AnyTwin, AnyTwins
from dtwin.twins.registration import diagnosis_path


def twin_report(
    home: Home,
    shelf: AnyTwins,
    library: Mapping[str, Effect],
    twin: AnyTwin,
    comparison: Any,
    compared: Mapping[str, Any],
    language: str = "en",
) -> str:
    """Return the whole story of a twin as one page that needs nothing else.

    ``shelf``: where the twin is.
    ``comparison``, ``compared``: with what it was fitted to, and its ``as_dict``; of the former None where only that is kept.
    """
    version, diagnosis = diagnosed(shelf, twin)
    report = report_of(twin.as_dict())
    sections = [
        _head(home, library, twin, version, diagnosis),
        *_sheets(home, twin),
        report.twin_section(twin),
        *report_of(compared).comparison_sections(comparison, compared),
        *([report_of(diagnosis).diagnosis_section(twin.name, diagnosis)] if diagnosis else []),
        report.history_section(shelf.history(twin.name)),
    ]
    about = f"version {twin.version} of campaign {twin.campaign}, made by dtwin"
    return page(f"Machine {twin.machine}: twin {twin.name}", about, sections, Language(language, twin.campaigns))


def write_report(
    path: Path, home: Home, shelf: AnyTwins, library: Mapping[str, Effect], twin: AnyTwin, language: str = "en"
) -> None:
    """Diagnose the newest version of a twin, compare it, and write its report.

    Raises ``InputError`` for an older version.
    """
    newest = shelf.newest(twin.name).version
    if twin.version != newest:
        raise InputError(
            "a report is of the newest version",
            code="twin.report",
            where=f"twin {twin.name}",
            got=f"--version {twin.version}",
            allowed=str(newest),
            hint=f"dtwin twin restore {twin.name} --version {twin.version} makes it the newest",
        )
    # It is kept beside the version, where the report finds it.
    shelf.diagnose(twin.name)
    comparison = shelf.compare(twin.name)
    write_document(
        path, twin_report(home, shelf, library, twin, comparison, comparison.as_dict(), language), "the report"
    )


def _head(
    home: Home, library: Mapping[str, Effect], twin: AnyTwin, version: int, diagnosis: dict[str, Any] | None
) -> Section:
    """Return the verdict, the faults in the words of the shop, and the facts of the test."""
    facts = [facts_of(home, Lake(home.lake).runs(test, left_out=True)) for test in twin.campaigns]
    named = [name for name in facts[0] if name not in ("campaign", "test") and any(one[name] for one in facts)]
    said = VERDICTS.get((diagnosis or {}).get("verdict", ""), "Not diagnosed yet")
    other = [f"As version {version} was diagnosed, which has the same effects."] if version != twin.version else []
    groups = found_faults(diagnosis or {}, library)
    missing = [f"{_one_of(group)}: {fault.sentence}" for group in groups for fault in group]
    known = [fault.sentence for fault in faults(twin, diagnosis, library)] if isinstance(twin, Twin) else []
    return Section(
        said,
        [*other, *missing, *known],
        [],
        [Table(("test", *twin.campaigns), [(name, *(one[name] or "-" for one in facts)) for name in named])],
    )


def _sheets(home: Home, twin: AnyTwin) -> list[Section]:
    """Return the test sheet of each campaign whose kind has one."""
    every = Lake(home.lake).runs(left_out=True, machine=twin.machine)
    variation = variation_of(home, twin.machine, every)
    made = []
    for name, rows in by_campaign(every).items():
        if name in twin.campaigns and kind_named(rows[0]["kind"]).offers("sheet"):
            sheet = sheet_of_campaign(home, name, twin.machine, stamp_of(rows), variation)
            made.append(sheet_section(sheet, name if len(twin.campaigns) > 1 else ""))
    return made


def _one_of(group: Sequence[object]) -> str:
    """Return what a name in a group is called, whose members these runs cannot tell apart."""
    return "Missing" if len(group) == 1 else f"Missing, one or several of these {len(group)}"


def diagnosed(shelf: AnyTwins, twin: AnyTwin) -> tuple[int, dict[str, Any] | None]:
    """Return the newest version with these effects that was diagnosed, and its diagnosis: a roll back loses none."""
    if (shelf.unkept.get("twin"), shelf.unkept.get("version")) == (twin.name, twin.version):
        return twin.version, dict(shelf.unkept)
    for version in range(twin.version, 0, -1):
        file = diagnosis_path(shelf.newest_document(twin.name, version)[1])
        if file.exists() and shelf.newest(twin.name, version).labels == twin.labels:
            return version, with_nan(read_document(file))
    return twin.version, None
