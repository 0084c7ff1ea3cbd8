"""The lake: what was measured, kept for good, visible run by run or not at all."""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from numpy.typing import NDArray

from dtwin.delta import DeltaFiles
from dtwin.errors import InputError, StoreError
from dtwin.parquet import columns_of, table_of
from dtwin.run_rows import RUN_SCHEMA, content_sha256, meta_of, run_row
from dtwin.schema import Campaign, Encoded, Finding, Run, SignalGroup, require_name

TABLES = ("runs", "samples", "signals", "features", "rejects")


@dataclass(frozen=True)
class RejectedRows:
    """Rows of a source file that hold no usable value.

    Attributes
    ----------
    run_id, source : str
        Where they come from.
    rows : sequence of dict
        Each with ``row``, ``reason`` and ``values``.
    """

    run_id: str
    source: str
    rows: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class CommitReport:
    """What a commit did.

    Attributes
    ----------
    added, unchanged : tuple of str
        Run ids that are new, and those that were there with the same content.
    versions : dict of str to int
        Table versions after the commit.
    """

    added: tuple[str, ...]
    unchanged: tuple[str, ...]
    versions: Mapping[str, int]


class Lake:
    """Delta tables ``runs``, ``samples``, ``signals``, ``features`` and ``rejects``.

    Parameters
    ----------
    root : Path
        Folder of the lake; created with the first commit.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.tables = {name: DeltaFiles(root / name) for name in TABLES}

    def versions(self) -> dict[str, int]:
        """Return the version of every table, -1 for one that does not exist."""
        return {name: table.version() for name, table in self.tables.items()}

    def commit(
        self,
        campaign: Campaign,
        runs: Sequence[Run],
        rejected: Sequence[RejectedRows] = (),
    ) -> CommitReport:
        """Add runs; a run that is there with the same content is left alone.

        Data files are written and committed first, ``runs`` last and under a lock, so that a
        kill at any moment leaves a run whole or invisible. A run with a finding
        ``recording.incomplete`` is marked incomplete.

        Parameters
        ----------
        campaign : Campaign
            What the runs belong to.
        runs : sequence of Run
            Runs to add.
        rejected : sequence of RejectedRows
            Rows that were left out of their samples.

        Raises
        ------
        InputError
            When a run id is there with other content.
        StoreError
            When the lake cannot be written.
        """
        require_name(campaign.name, "the campaign name")
        for run in runs:
            require_name(run.meta.run_id, "the run id")
        hashes = {run.meta.run_id: content_sha256(run) for run in runs}
        if len(hashes) != len(runs):
            raise InputError(
                "a run id occurs twice",
                code="ingest.duplicate_run",
                where=campaign.name,
                hint="give every run of the campaign its own id",
            )
        fresh = self._fresh(campaign, runs, hashes)
        if not fresh:
            return CommitReport((), tuple(hashes), self.versions())
        rows, batches = self._write_data(campaign, fresh, hashes)
        with self._lock():
            for batch in batches:
                batch.commit()
            self._commit_rejects(campaign, rejected)
            still = {r.meta.run_id for r in self._fresh(campaign, fresh, hashes)}
            rows = [row for row in rows if row["run_id"] in still]
            if rows:
                table = pa.Table.from_pylist(rows, schema=RUN_SCHEMA)
                digest = hashlib.sha256("".join(hashes.values()).encode()).hexdigest()[:16]
                name = f"{campaign.name}-{digest}.parquet"
                self.tables["runs"].commit([self.tables["runs"].write(name, table)], RUN_SCHEMA)
        return CommitReport(
            added=tuple(row["run_id"] for row in rows),
            unchanged=tuple(sorted(set(hashes) - {row["run_id"] for row in rows})),
            versions=self.versions(),
        )

    def runs(self, campaign: str | None = None) -> list[dict[str, Any]]:
        """Return the visible runs in the order they were planned or read.

        Parameters
        ----------
        campaign : str, optional
            Only this campaign.
        """
        rows: list[dict[str, Any]] = self.tables["runs"].read().to_pylist()
        chosen = rows if campaign is None else [r for r in rows if r["campaign"] == campaign]
        return sorted(chosen, key=lambda r: (r["campaign"], r["started"] or "", r["run_id"]))

    def load(self, row: Mapping[str, Any], *, signals: bool = True) -> Run:
        """Return a run with its samples, and its signals when asked.

        Parameters
        ----------
        row : mapping
            A row from :meth:`runs`.
        signals : bool
            Whether to read the high-rate signals as well.
        """
        samples = self.tables["samples"].read([row["samples_file"]])
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

    def iterate(self, campaign: str, *, signals: bool = True) -> Iterator[Run]:
        """Yield the runs of a campaign one by one, never all in memory."""
        for row in self.runs(campaign):
            yield self.load(row, signals=signals)

    def campaigns(self) -> list[str]:
        """Return the names of all campaigns that have visible runs."""
        return sorted({row["campaign"] for row in self.runs()})

    def campaign(self, name: str) -> Campaign:
        """Return what is known of a campaign.

        Raises
        ------
        InputError
            When no visible run belongs to it.
        """
        rows = self.runs(name)
        if not rows:
            raise InputError(
                "no such campaign in the lake",
                code="campaign.unknown",
                got=name,
                allowed=", ".join(self.campaigns()) or "none yet",
                hint="dtwin ingest PATH; without measurements: dtwin examples",
            )
        first = rows[0]
        return Campaign(
            name=name,
            machine=first["machine"],
            kind=first["kind"],
            started=first["started"],
            machine_geometry=json.loads(first["geometry_json"]),
            instrument=json.loads(first["instrument_json"]),
        )

    def write_table(self, table_name: str, key: str, table: pa.Table) -> int:
        """Add one file of derived rows, for example features of a campaign.

        Parameters
        ----------
        table_name : str
            One of ``TABLES``.
        key : str
            What the rows are derived from; the same key is written once.
        table : pyarrow.Table
            The rows.

        Returns
        -------
        int
            Version of the table.
        """
        with self._lock():
            return self._add(table_name, key, table)

    def _add(self, table_name: str, key: str, table: pa.Table) -> int:
        files = self.tables[table_name]
        digest = hashlib.sha256(key.encode()).hexdigest()[:24]
        return files.commit([files.write(f"{digest}.parquet", table)], table.schema)

    def repair(self) -> dict[str, int]:
        """Drop what a killed ingest left behind, and return how many files per table."""
        with self._lock():
            rows = self.runs()
            wanted = {
                "samples": {row["samples_file"] for row in rows},
                "signals": {g["file"] for row in rows for g in json.loads(row["signals_json"])},
            }
            dropped = {}
            for name, keep in wanted.items():
                table = self.tables[name]
                orphans = [file for file in table.files() if file not in keep]
                if orphans:
                    table.remove(orphans)
                partial = [p for p in table.folder.rglob("*.partial")] if table.exists() else []
                for path in partial:
                    path.unlink(missing_ok=True)
                dropped[name] = len(orphans) + len(partial)
            return dropped

    def _fresh(
        self, campaign: Campaign, runs: Sequence[Run], hashes: Mapping[str, str]
    ) -> list[Run]:
        known = {r["run_id"]: r["content_sha256"] for r in self.runs(campaign.name)}
        clash = [i for i, sha in hashes.items() if i in known and known[i] != sha]
        if clash:
            raise InputError(
                f"{len(clash)} run(s) are in the lake with other content",
                code="ingest.duplicate_run",
                where=f"campaign {campaign.name}",
                got=", ".join(clash[:10]),
                allowed="new run ids; raw values are never changed",
                hint="use another campaign name or other run ids",
            )
        return [run for run in runs if run.meta.run_id not in known]

    def _write_data(
        self,
        campaign: Campaign,
        runs: Sequence[Run],
        hashes: Mapping[str, str],
    ) -> tuple[list[dict[str, Any]], tuple[_Batch, _Batch]]:
        samples, signals = _Batch(self.tables["samples"]), _Batch(self.tables["signals"])
        rows = []
        for run in runs:
            sha = hashes[run.meta.run_id]
            stem = f"{campaign.name}/{run.meta.run_id}-{sha[:16]}"
            sample_file = samples.write(f"{stem}.parquet", run.samples)
            groups = [
                {
                    "group": group.name,
                    "file": signals.write(
                        f"{stem}-{group.name}.parquet", group.columns, group.encoded
                    ),
                    "rate_hz": group.rate_hz,
                    "start_s": group.start_s,
                }
                for group in run.signals
            ]
            rows.append(run_row(campaign, run, sha, sample_file, groups))
        return rows, (samples, signals)

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
            self._add("rejects", json.dumps(flat), table)

    def _load_group(self, group: Mapping[str, Any]) -> SignalGroup:
        table = self.tables["signals"].read([group["file"]])
        return SignalGroup(group["group"], group["rate_hz"], columns_of(table), group["start_s"])

    @contextmanager
    def _lock(self) -> Iterator[None]:
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            handle = (self.root / ".lock").open("w")
        except OSError as error:
            raise StoreError(
                "the lake cannot be written",
                code="store.write",
                where=str(self.root),
                got=str(error),
                hint="check free space and permissions; nothing was committed",
            ) from error
        with handle:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield


class _Batch:
    """Files of one table that are written one by one and committed together."""

    def __init__(self, table: DeltaFiles) -> None:
        self.table = table
        self.written: list[tuple[str, int, int]] = []
        self.schemas: list[pa.Schema] = []

    def write(
        self, name: str, columns: Mapping[str, NDArray[Any]], encoded: Encoded | None = None
    ) -> str:
        # A file is one run, named after campaign, run and content; repeating these in every
        # row would double the time of an ingest.
        table = table_of(columns)
        if encoded is not None and encoded.columns is columns:
            self.written.append(self.table.write_encoded(name, encoded, table.num_rows))
        else:
            self.written.append(self.table.write(name, table))
        self.schemas.append(table.schema)
        return name

    def commit(self) -> None:
        if self.written:
            self.table.commit(self.written, pa.unify_schemas(self.schemas))
