"""From files to the lake, in batches that are whole or absent."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dtwin.acquire._lone_table import open_table, safe_name
from dtwin.acquire.b5r import read_b5r
from dtwin.acquire.campaign_folder import open_campaign
from dtwin.acquire.quality import judge_campaign, judge_copies, judge_pasted, judge_run, without_samples
from dtwin.acquire.spreadsheet import ending_as_table
from dtwin.errors import InputError
from dtwin.kinds.registry import kinds
from dtwin.lake.rows import columns_sha256
from dtwin.lake.store import Lake, RejectedRows
from dtwin.progress import Progress, silent
from dtwin.schema import Campaign, Finding, Run

_BATCH_RUNS = 24


@dataclass(frozen=True)
class IngestReport:
    """What an ingest brought into the lake.

    ``added``, ``unchanged``: run ids.
    ``findings``, (str, Finding): data-quality findings with the run they belong to; ``""`` for the whole campaign.
    ``rejected_rows``: rows kept in ``rejects`` instead of ``samples``.
    ``versions``: table versions afterwards.
    """

    campaign: str
    added: tuple[str, ...]
    unchanged: tuple[str, ...]
    findings: tuple[tuple[str, Finding], ...]
    rejected_rows: int
    versions: dict[str, int]


def ingest(path: Path, lake: Lake, progress: Progress = silent, told: Mapping[str, Any] | None = None) -> IngestReport:
    """Bring a campaign folder, a bare ``.b5r`` or a table that lies alone into the lake.

    Safe to repeat: runs that are there with the same content are left alone, so an
    interrupted ingest continues where it stopped.

    ``path``, ``told``: as for :func:`open_source`.
    ``progress``: called with (done, total, what) after every source file.

    Raises ``InputError`` when a file cannot be used; batches committed before stay.
    """
    campaign, sources, total = open_source(path, told)
    added: list[str] = []
    unchanged: list[str] = []
    findings: list[tuple[str, Finding]] = []
    judged: list[Run] = []
    n_rejected = 0
    versions = lake.versions()
    others = {name for name in lake.machines_by_campaign().values() if name and name != campaign.machine}
    samples = {r["run_id"]: r["samples_sha256"] for r in lake.runs(campaign.name, left_out=True)}
    for batch, rejected, done in _batches(sources):
        samples |= {run.meta.run_id: columns_sha256(run.samples) for run in batch}
        copies = judge_pasted(batch) | judge_copies(samples)
        runs = [_of_its_machine(_judged(run, copies), campaign.machine, others) for run in batch]
        report = lake.commit(campaign, runs, rejected)
        versions = dict(report.versions)
        added += report.added
        unchanged += report.unchanged
        findings += [(run.meta.run_id, finding) for run in runs for finding in run.findings]
        n_rejected += sum(len(part.rows) for part in rejected)
        judged += map(without_samples, runs)
        progress(done, total, batch[-1].meta.run_id if batch else "")
    findings += [("", finding) for finding in (*_alike(campaign.machine, others), *judge_campaign(judged))]
    return IngestReport(campaign.name, tuple(added), tuple(unchanged), tuple(findings), n_rejected, versions)


def open_source(
    path: Path, told: Mapping[str, Any] | None = None
) -> tuple[Campaign, Iterable[tuple[list[Run], list[RejectedRows]]], int]:
    """Return the campaign of a path, its runs file by file, and the number of files.

    ``path``: a campaign folder, its ``campaign.toml``, a ``.b5r`` file, or a table.
    ``told``: what is told of a table that lies alone; see :func:`open_table`.
    """
    suffix = path.suffix.lower()
    if path.is_file() and (
        ending_as_table(path) in (".csv", ".parquet") or any(kind.takes_alone(path) for kind in kinds())
    ):
        table = open_table(path, told or {})
        return table.campaign, table, 1
    folder_or_test = path.is_dir() or suffix in (".toml", ".b5r")
    if folder_or_test and any(value is not None for value in (told or {}).values()):
        raise InputError(
            "conditions are told of a table that lies alone only",
            code="ingest.told",
            where=str(path),
            got=", ".join(name for name, value in (told or {}).items() if value is not None),
            allowed="a .csv, .parquet or .xlsx file",
            hint="leave the options away: the file itself, or campaign.toml, says it",
        )
    if path.is_dir() or suffix == ".toml":
        folder = open_campaign(path)
        return folder.campaign, folder, len(folder.entries)
    if suffix == ".b5r":
        test = read_b5r(path)
        campaign = Campaign(
            name=safe_name(path.stem),
            machine=safe_name(test.machine or "unknown"),
            started=test.started,
            instrument=test.instrument,
        )
        return campaign, [(list(test.runs), [])], 1
    if not path.exists():
        raise InputError(
            "no such file or folder",
            code="file.missing",
            where=str(path),
            hint="check the path; without measurements: dtwin examples",
        )
    raise InputError(
        "no table of a known form is in the file",
        code="ingest.type",
        where=str(path),
        got=path.suffix or "no ending",
        allowed="a campaign folder, campaign.toml, .b5r, .csv, .parquet or .xlsx; text or Markdown with a positioning table",
        hint=f"dtwin import {path.name} reads tables that other programs wrote as text; else save the table as .csv, "
        "or name the file in a campaign.toml: it says plane, radius, feed and direction, or axis and "
        "length_unit of a laser's ASCII file (docs/reference/laser-file.md); what to bring of the circularity test of a control is in "
        "docs/how-to/coming-from.md",
    )


def _batches(
    sources: Iterable[tuple[list[Run], list[RejectedRows]]],
) -> Iterator[tuple[list[Run], list[RejectedRows], int]]:
    runs: list[Run] = []
    rejected: list[RejectedRows] = []
    done = 0
    for done, (more, rows) in enumerate(sources, start=1):
        runs += more
        rejected += rows
        if len(runs) >= _BATCH_RUNS:
            yield runs, rejected, done
            runs, rejected = [], []
    if runs:
        yield runs, rejected, done


def _judged(run: Run, copies: Mapping[str, Finding]) -> Run:
    copied = [copies[run.meta.run_id]] if run.meta.run_id in copies else []
    return replace(run, findings=(*run.findings, *judge_run(run), *copied))


def _of_its_machine(run: Run, machine: str, others: Collection[str]) -> Run:
    """Return the run; it has a warning when its file names another machine of the lake."""
    named = safe_name(run.machine) if run.machine else ""
    if named not in others:
        return run
    said = f"the file names machine {named}, of which the lake has tests, and is brought in as {machine}: is it in the wrong folder? Then leave the run out, and bring it in as {named}"
    return replace(run, findings=(*run.findings, Finding("run.other_machine", "warning", said)))


def _alike(machine: str, others: Collection[str]) -> Iterator[Finding]:
    """Yield a warning when a machine of the lake is called as this one but for capitals: its history would be of two."""
    for other in sorted(others):
        if other.casefold() == machine.casefold():
            said = f"{machine} and {other}, of which the lake has tests, count as two machines: if they are one, dtwin amend states it anew, with --set machine={other}"
            yield Finding("campaign.machine_alike", "warning", said)


def worst(findings: Sequence[tuple[str, Finding]]) -> str:
    """Return the worst severity among findings, ``"none"`` when there are none."""
    order = ("error", "warning", "info")
    present = {finding.severity for _, finding in findings}
    return next((severity for severity in order if severity in present), "none")
