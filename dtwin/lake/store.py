"""The lake: what was measured, kept for good, visible run by run or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from dtwin.errors import InputError
from dtwin.home_file import Bucket
from dtwin.lake._admission import accepted, fresh, require_same_statements
from dtwin.lake._file_batch import (
    Batch,
    campaign_named,
    machine_named,
    names_of,
    of_machines,
    samples_part,
    signal_parts,
)
from dtwin.lake._folders import Place, writing
from dtwin.lake._log import content_hash
from dtwin.lake.delta import DeltaFiles, Moved, file_of, part_of
from dtwin.lake.parquet import columns_of, table_of
from dtwin.lake.rows import AMENDMENT_SCHEMA, RUN_SCHEMA, amended, campaign_of, meta_of, sealed, unsealed
from dtwin.schema import Campaign, Finding, Run, SignalGroup, require_name

TABLES = ("runs", "samples", "signals", "features", "rejects", "amendments")


@dataclass(frozen=True)
class RejectedRows:
    """Rows of a source file that hold no usable value.

    ``rows``: each with ``row``, ``reason`` and ``values``.
    """

    run_id: str
    source: str
    rows: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class _CommitReport:
    """What a commit did.

    ``added``, ``unchanged``: run ids that are new, and those that were there with the same content.
    ``versions``: table versions after the commit.
    """

    added: tuple[str, ...]
    unchanged: tuple[str, ...]
    versions: Mapping[str, int]


class Lake:
    """Delta tables ``runs``, ``samples``, ``signals``, ``features``, ``rejects``, ``amendments``.

    The folder is created with the first commit.
    """

    def __init__(self, root: Place) -> None:
        self.root = root
        self.tables = {name: DeltaFiles(root / name) for name in TABLES}

    def versions(self) -> dict[str, int]:
        """Return the version of every table, -1 for one that does not exist."""
        return {name: table.version() for name, table in self.tables.items()}

    def commit(self, campaign: Campaign, runs: Sequence[Run], rejected: Sequence[RejectedRows] = ()) -> _CommitReport:
        """Add runs; a run that is there with the same content is left alone.

        Data files are written and committed first, ``runs`` last and under a lock, so that a
        kill at any moment leaves a run whole or invisible. A run with a finding
        ``recording.incomplete`` is marked incomplete.

        Args:
            rejected: Rows that were left out of their samples.

        Raises:
            InputError: When a run id is there with other content.
            StoreError: When the lake cannot be written.
        """
        rows = accepted(campaign, runs)
        with self._writing():
            known = self._known(campaign)
            new = fresh(campaign.name, known, rows)
            self._heal([(run, known[run.meta.run_id]) for run in runs if run.meta.run_id in known])
            if not new:
                return _CommitReport((), tuple(rows), self.versions())
            batches = self._write_data([run for run in runs if run.meta.run_id in new], rows)
            with self._lock():
                for batch in batches:
                    batch.commit()
                self._commit_rejects(campaign, rejected)
                while True:
                    # Another writer may have been faster.
                    at = self._at("runs", RUN_SCHEMA)
                    new = fresh(campaign.name, self._known(campaign), new)
                    with suppress(Moved):
                        if new:
                            self._add_rows("runs", f"{campaign.name}/{campaign.machine}", new.values(), RUN_SCHEMA, at)
                        break
        return _CommitReport(added=tuple(new), unchanged=tuple(sorted(set(rows) - set(new))), versions=self.versions())

    def _known(self, campaign: Campaign) -> dict[str, dict[str, Any]]:
        return {row["run_id"]: row for row in self.runs(campaign.name, left_out=True)}

    def require_same_statements(self, campaign: Campaign) -> None:
        """Refuse a campaign whose machine or instrument is stated otherwise than in the lake, unless that was amended."""
        require_same_statements(campaign, self._known(campaign))

    def amend(self, campaign: str, records: Sequence[Mapping[str, Any]]) -> int:
        """Keep records of what is stated anew of runs, and return the version of the campaign's metadata.

        The runs themselves are not touched.

        Args:
            records: ``run_id``, ``who``, ``when``, ``because`` and ``changes``: fields of the run's row, or ``left_out``.
        """
        with self._lock():
            while True:
                at = self._at("amendments", AMENDMENT_SCHEMA)
                version = 1 + max((r["metadata_version"] for r in self.runs(campaign, True)), default=0)
                rows = [
                    {
                        **{name: str(record[name]) for name in ("run_id", "who", "when", "because")},
                        "campaign": campaign,
                        "version": version,
                        "changes_json": json.dumps(dict(record["changes"]), sort_keys=True),
                    }
                    for record in records
                ]
                with suppress(Moved):
                    self._add_rows(
                        "amendments", require_name(campaign, "the campaign name"), rows, AMENDMENT_SCHEMA, at
                    )
                    break
        return version

    def runs(
        self,
        campaign: str | Collection[str] | None = None,
        left_out: bool = False,
        at: Mapping[str, int] | None = None,
        *,
        machine: str | Collection[str] | None = None,
    ) -> list[dict[str, Any]]:
        """Return the runs as they are stated now, in the order they were planned or read.

        Every row was compared with its hash, and carries its amendments. Files of other campaigns, and of other machines,
        are not read.

        Args:
            campaign: Only this campaign, or these.
            machine: Only this machine, or these.
            left_out: Whether runs that a user left out are returned too.
            at: Table versions to read, as :meth:`versions` returned them; the newest by default.

        Raises:
            StoreError: When the log, a file or a row is not what was written.
        """
        wanted, machines = names_of(campaign), names_of(machine)

        def rows_of(name: str, schema: pa.Schema, anew: Collection[str] | None = None) -> list[dict[str, Any]]:
            table = self.tables[name]
            files = table.files(None if at is None else at.get(name, -1))
            if wanted is not None:
                files = [f for f in files if campaign_named(f) in wanted]
            if machines is not None and anew is not None:
                files = of_machines(files, machines, anew)
            return unsealed(table.read(files), schema, str(self.root / name))

        told = rows_of("amendments", AMENDMENT_SCHEMA)
        rows = amended(rows_of("runs", RUN_SCHEMA, {row["campaign"] for row in told}), told)
        chosen = [
            row
            for row in rows
            if (wanted is None or row["campaign"] in wanted)
            and (machines is None or row["machine"] in machines)
            and (left_out or row["left_out"] is None)
        ]
        return sorted(chosen, key=lambda r: (r["campaign"], r["started"] or "", r["run_id"]))

    def load(self, row: Mapping[str, Any], *, signals: bool = True) -> Run:
        """Return a run with its samples, and its high-rate signals when asked; ``row`` is one from :meth:`runs`."""
        samples = self.tables["samples"].read_file(row["samples_file"])
        groups = json.loads(row["signals_json"]) if signals else []
        window = None if row["window_start"] is None else (row["window_start"], row["window_end"])
        return Run(
            meta=meta_of(row),
            samples=columns_of(samples),
            window=window,
            signals=tuple(self._load_group(group) for group in groups),
            source=row["source"],
            findings=tuple(Finding(**f) for f in json.loads(row["findings_json"])),
        )

    def provenance(self, rows: Iterable[Mapping[str, Any]], n_runs: int) -> dict[str, Any]:
        """Return what a twin was fitted to: versions of the lake, and a hash of what the rows hold."""
        contents = "".join(str(row["content_sha256"]) for row in rows)
        return {**self.versions(), "runs_sha256": hashlib.sha256(contents.encode()).hexdigest(), "n_runs": n_runs}

    def iterate(self, campaign: str) -> Iterator[Run]:
        """Yield the runs of a campaign one by one, never all in memory."""
        for row in self.runs(campaign):
            yield self.load(row)

    def campaigns(self) -> list[str]:
        """Return the names of all campaigns that have visible runs."""
        return sorted({campaign_named(file) for file in self.tables["runs"].files()})

    def files_by_campaign(self, machine: str | None = None) -> dict[str, list[str]]:
        """Return the files that say what the runs of each campaign are: others say the same only of the same rows.

        ``machine``: without other campaigns than those that are, or may be, of this one.
        """
        by_campaign: dict[str, list[str]] = {}
        told = self.tables["amendments"].files()
        runs = self.tables["runs"].files()
        if machine is not None:
            runs = of_machines(runs, {machine}, {campaign_named(file) for file in told})
        for file in [*runs, *told]:
            by_campaign.setdefault(campaign_named(file), []).append(file)
        return by_campaign

    def machines_by_campaign(self) -> dict[str, str | None]:
        """Return the machine of each campaign by the names of its files, which are not read; None where they do not say."""
        files = self.tables["runs"].files()
        told = {campaign_named(file): machine_named(file) for file in files}
        return told | dict.fromkeys(map(campaign_named, self.tables["amendments"].files()))

    def campaign(self, name: str) -> Campaign:
        """Return what is known of a campaign. Raises ``InputError`` when no visible run belongs to it."""
        rows = self.runs(name, left_out=True)
        if not rows:
            raise InputError(
                "no such campaign in the lake",
                code="campaign.unknown",
                got=name,
                allowed=", ".join(self.campaigns()) or "none yet",
                hint="dtwin ingest PATH; without measurements: dtwin examples",
            )
        return campaign_of(rows)

    def write_table(self, table_name: str, key: str, table: pa.Table) -> int:
        """Add one file of derived rows, for example features of a campaign.

        Args:
            table_name: One of ``TABLES``.
            key: What the rows are derived from; the same key is written once.

        Returns:
            Version of the table.
        """
        with self._lock():
            return self._add(table_name, content_hash(key.encode())[:24], table)

    def _at(self, table_name: str, schema: pa.Schema) -> int | None:
        """Return the version that a commit must follow; None where a lock keeps other writers away."""
        table = self.tables[table_name]
        return table.ready(table.accepted([schema])) if isinstance(self.root, Bucket) else None

    def _add(self, table_name: str, stem: str, table: pa.Table, only_at: int | None = None) -> int:
        files = self.tables[table_name]
        schema = files.accepted([table.schema])
        return files.commit([files.write(stem, table)], schema, only_at=only_at)

    def _add_rows(
        self, table_name: str, stem: str, rows: Iterable[Mapping[str, Any]], schema: pa.Schema, only_at: int | None
    ) -> None:
        self._add(table_name, stem, sealed(list(rows), schema), only_at)

    def repair(self) -> dict[str, Any]:
        """Drop what a killed ingest or a power cut left behind.

        Returns:
            Files dropped per table, and ``log``: empty log entries that were set aside.
        """
        with self.at_rest():
            cut = [
                f"{name}/_delta_log/{entry}"
                for name, table in self.tables.items()
                if (entry := table.log.set_aside_cut_entry()) is not None
            ]
            for table in self.tables.values():
                table.log.drop_summaries()
            rows = self.runs(left_out=True)
            wanted = {
                "samples": {file_of(row["samples_file"]) for row in rows},
                "signals": {file_of(g["file"]) for row in rows for g in json.loads(row["signals_json"])},
            }
            dropped: dict[str, Any] = {}
            for name, table in self.tables.items():
                orphans = [f for f in table.files() if f not in wanted[name]] if name in wanted else []
                if orphans:
                    table.remove(orphans)
                dropped[name] = len(orphans) + table.sweep()
            return {**dropped, "log": cut}

    def _heal(self, runs: Sequence[tuple[Run, Mapping[str, Any]]]) -> None:
        """Write those files of runs again that are missing or damaged: their source has the content."""
        samples, signals = [], []
        for run, row in runs:
            samples.append((row["samples_file"], samples_part(run, row)))
            by_group = dict(zip((g.name for g in run.signals), signal_parts(run, row), strict=True))
            kept = {g["group"]: g["file"] for g in json.loads(row["signals_json"])}
            signals += [(kept[name], part) for name, part in by_group.items() if name in kept]
        for table, named in ((self.tables["samples"], samples), (self.tables["signals"], signals)):
            for file in {file_of(name) for name, _ in named}:
                if not table.intact(file):
                    # In the order in which they lie in the file.
                    parts = sorted(
                        ((part_of(name), part) for name, part in named if file_of(name) == file),
                        key=lambda pair: pair[0],
                    )
                    Batch(table, [part for _, part in parts]).write()

    def _write_data(self, runs: Sequence[Run], rows: Mapping[str, dict[str, Any]]) -> tuple[Batch, Batch]:
        """Write the files of runs and enter their names into the rows."""
        stated = [(run, rows[run.meta.run_id]) for run in runs]
        samples = Batch(self.tables["samples"], [samples_part(run, row) for run, row in stated])
        signals = Batch(self.tables["signals"], [part for run, row in stated for part in signal_parts(run, row)])
        files, kept = samples.write(), iter(signals.write())
        for (run, row), file in zip(stated, files, strict=True):
            row["samples_file"] = file
            row["signals_json"] = json.dumps(
                [
                    {"group": group.name, "file": next(kept), "rate_hz": group.rate_hz, "start_s": group.start_s}
                    for group in run.signals
                ]
            )
        return samples, signals

    def _commit_rejects(self, campaign: Campaign, rejected: Sequence[RejectedRows]) -> None:
        flat = [
            {
                "campaign": campaign.name,
                "run_id": part.run_id,
                "source": part.source,
                "row": int(row["row"]),
                "reason": str(row["reason"]),
                "values_json": json.dumps(row["values"]),
            }
            for part in rejected
            for row in part.rows
        ]
        if flat:
            table = table_of({name: [row[name] for row in flat] for name in flat[0]})
            self._add("rejects", campaign.name, table)

    def _load_group(self, group: Mapping[str, Any]) -> SignalGroup:
        table = self.tables["signals"].read_file(group["file"])
        return SignalGroup(group["group"], group["rate_hz"], columns_of(table), group["start_s"])

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        """Keep every writer of this computer waiting; those of others at a shared store do not wait."""
        with self._writing(alone=True), self._lock():
            yield

    def _lock(self) -> AbstractContextManager[None]:
        """Return the lock that one writer holds while it commits."""
        return writing(self.root, ".lock")

    def _writing(self, *, alone: bool = False) -> AbstractContextManager[None]:
        """Return the lock that writers of data files share, and a sweep holds alone."""
        return writing(self.root, ".writing", shared=not alone)
