"""How a report of a twin begins: of what machine and test it is, and what was found."""

from __future__ import annotations

from typing import Any

from dtwin.physics.twin import Twin
from dtwin.pipeline.certificate import facts_of
from dtwin.report.faults import faults, found_faults
from dtwin.report.html import Section, Table
from dtwin.workbench import _reading as reading
from dtwin.workbench._bench import Bench
from dtwin.workbench._pages import VERDICTS


def head_section(bench: Bench, twin: Any) -> Section:
    """Return the verdict, the faults in the words of the shop, and the facts of the test."""
    tests = list(getattr(twin, "campaigns", ()) or [twin.campaign])
    facts = [facts_of(bench.home, bench.run_rows(test)) for test in tests]
    named = [name for name in facts[0] if name not in ("campaign", "test") and any(one[name] for one in facts)]
    version, diagnosis = diagnosed(bench, twin)
    said = VERDICTS.get((diagnosis or {}).get("verdict", ""), "Not diagnosed yet")
    other = [f"As version {version} was diagnosed, which has the same effects."] if version != twin.version else []
    missing = [fault.sentence for group in found_faults(diagnosis or {}, bench.library) for fault in group]
    known = [fault.sentence for fault in faults(twin)] if isinstance(twin, Twin) else []
    return Section(
        said,
        [*other, *(f"Missing: {line}" for line in missing), *known],
        [],
        [Table(("test", *tests), [(name, *(one[name] or "-" for one in facts)) for name in named])],
    )


def diagnosed(bench: Bench, twin: Any) -> tuple[int, dict[str, Any] | None]:
    """Return the newest version with these effects that was diagnosed, and its diagnosis: a roll back loses none."""
    for version in range(twin.version, 0, -1):
        found = reading.diagnosis_of(bench, twin.name, version)
        if found is not None and bench.twins_with(twin.name).newest(twin.name, version).labels == twin.labels:
            return version, found
    return twin.version, None
