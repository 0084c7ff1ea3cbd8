"""Read a recording back, whether it was closed or its process died, and seal it into Parquet; what the machine said meanwhile, as intervals."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dtwin.acquire._recording import BLOCK_KEY, STREAM_KEY, SUFFIX, checksum, header_checksum
from dtwin.errors import StoreError
from dtwin.lake.parquet import unit_metadata, write_parquet
from dtwin.locks import take
from dtwin.schema import Finding
from dtwin.units import shown_number

# The header of signal files, which ``dtwin.acquire.signal_files`` reads.
_SIGNALS_KEY = b"dtwin.signals"


@dataclass(frozen=True)
class _Gap:
    """Samples that the device took and nobody read.

    ``first_sample``, ``n_lost``: place on the device's clock, and number per channel.
    """

    first_sample: int
    n_lost: int
    reason: str


@dataclass(frozen=True)
class Sealed:
    """A recording that became a signal file.

    ``n_samples``, ``n_bytes``: samples per channel with the lost ones, and size of the file.
    ``complete``: whether the recording was closed in order.
    ``findings``: gaps, and that it is incomplete.
    """

    path: Path
    n_samples: int
    n_bytes: int
    complete: bool
    findings: tuple[Finding, ...]


@dataclass
class _Content:
    head: dict[str, Any]
    table: pa.Table
    gaps: tuple[_Gap, ...]
    events: tuple[list[Any], ...]
    complete: bool


def seal(path: Path, target: Path) -> Sealed:
    """Turn a closed or broken-off recording into a signal file, then remove the stream.

    The signal file appears whole or not at all; lost samples are null in it, or -1 in columns
    of whole numbers, and its header tells the gaps and whether the recording is complete.

    ``path``: stream written by ``Recorder``.
    Raises ``StoreError``: when the recording is being written, empty or damaged, or the file cannot be written; the
    stream stays then.
    """
    with _read(path) as content:
        head = content.head | {
            "complete": content.complete,
            "gaps": [[g.first_sample, g.n_lost, g.reason] for g in content.gaps],
        }
        if content.events:
            head |= {"events": list(content.events), "length_s": content.table.num_rows / head["rate_hz"]}
        table = content.table.replace_schema_metadata({_SIGNALS_KEY: json.dumps(head)})
        size = write_parquet(target, table)
        path.unlink()
    findings = _findings(content.complete, content.gaps, head["rate_hz"])
    return Sealed(target, table.num_rows, size, content.complete, findings)


def recover_folder(folder: Path) -> list[Sealed]:
    """Seal every recording that a dead process left in a folder, and return them.

    Recordings that are being written are left alone; an empty one is removed.

    ``folder``: where the streams are; each becomes ``<name>.parquet`` beside it.
    """
    sealed, problems = [], []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        try:
            sealed.append(seal(path, path.with_suffix(".parquet")))
        except StoreError as error:
            if error.code == "recording.empty":
                path.unlink()
            elif error.code != "recording.live":
                problems.append(error)
    if problems:
        raise problems[0]
    return sealed


def covariates_of(path: Path) -> dict[str, float]:
    """Return the means of the columns of a sealed signal file that count as covariates of its run.

    Raises ``StoreError`` when the file cannot be read.
    """
    with _readable(path):
        head = json.loads((pq.read_schema(path).metadata or {}).get(_SIGNALS_KEY, b"{}"))
        names = [str(name) for name in (head.get("notes") or {}).get("covariates", [])]
        table = pq.read_table(path, columns=names) if names else None
    covariates = {}
    for name in names:
        assert table is not None
        values = table.column(name).to_numpy()
        known = values[np.isfinite(values)]
        if known.size:
            covariates[name] = float(known.mean())
    return covariates


def signal_findings(path: Path) -> tuple[Finding, ...]:
    """Return what the header of a sealed signal file says is wrong with it.

    ``path``: Parquet file; one without such a header has no findings.
    """
    with _readable(path):
        metadata = pq.read_schema(path).metadata or {}
        head = json.loads(metadata.get(_SIGNALS_KEY, b"{}"))
        gaps = tuple(_Gap(int(a), int(n), str(why)) for a, n, why in head.get("gaps", []))
        findings = _findings(bool(head.get("complete", True)), gaps, float(head.get("rate_hz", 1.0)))
        return (*findings, *_event_findings(head.get("events", []), float(head.get("length_s", 0.0))))


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, pa.ArrowException, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise StoreError(
            "a signal file is missing or damaged", code="store.damaged", where=str(path), got=str(error)[:200]
        ) from error


@contextmanager
def _read(path: Path) -> Iterator[_Content]:
    """Hold the stream against writers and yield its content, mapped rather than copied."""
    try:
        with path.open("rb") as held:
            if not take(held, shared=True):
                raise StoreError(
                    "the recording is still being written",
                    code="recording.live",
                    where=str(path),
                    hint="end the recording first",
                )
            yield _content(path)
    except OSError as error:
        raise StoreError(
            "the recording cannot be read", code="recording.unreadable", where=str(path), got=str(error)
        ) from error


def _open(path: Path) -> tuple[pa.ipc.RecordBatchStreamReader, dict[str, Any]]:
    if path.stat().st_size == 0:
        raise StoreError(
            "the recording's process died before anything was recorded", code="recording.empty", where=str(path)
        )
    try:
        stream = pa.ipc.open_stream(pa.memory_map(str(path)))
        label = json.loads(stream.schema.metadata[STREAM_KEY])
        if header_checksum(label["head"], list(stream.schema)) != label["crc"]:
            raise ValueError("the checksum of the header is wrong")
        return stream, json.loads(label["head"])
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise StoreError(
            "the header of the recording is damaged",
            code="recording.damaged",
            where=str(path),
            got=str(error)[:200],
            hint="restore the file from a backup",
        ) from error


def _content(path: Path) -> _Content:
    stream, head = _open(path)
    parts: list[pa.RecordBatch] = []
    gaps: list[_Gap] = []
    events: list[list[Any]] = []
    complete, first = False, 0
    for batch, place in _blocks(stream):
        if place["first"] != first:
            break
        if place["lost"]:
            gaps.append(_Gap(first, place["lost"], place["why"]))
            parts.append(_nothing(stream.schema, place["lost"]))
        elif batch.num_rows:
            parts.append(batch)
        events += place.get("events", [])
        first += batch.num_rows + place["lost"]
        complete = place.get("end", False)
    schema = pa.schema([field.with_metadata(unit_metadata(field.name)) for field in stream.schema])
    plain = [pa.RecordBatch.from_arrays(part.columns, schema=schema) for part in parts]
    return _Content(head, pa.Table.from_batches(plain, schema), tuple(gaps), tuple(events), complete)


def _blocks(stream: pa.ipc.RecordBatchStreamReader) -> Iterator[tuple[pa.RecordBatch, Any]]:
    """Yield blocks up to the first that is torn or damaged."""
    while True:
        try:
            batch, metadata = stream.read_next_batch_with_custom_metadata()
            label = json.loads(metadata[BLOCK_KEY])
            arrays = [column.to_numpy() for column in batch.columns] if batch.num_rows else []
            if checksum(label["place"], arrays) != label["crc"]:
                return
            place = json.loads(label["place"])
        except (StopIteration, pa.ArrowException, OSError, ValueError, KeyError, TypeError, RecursionError):
            return
        yield batch, place


def _nothing(schema: pa.Schema, n: int) -> pa.RecordBatch:
    """Return lost samples: null, and -1 in whole numbers, whose type must stay what it is."""
    bare = pa.schema([pa.field(field.name, field.type) for field in schema])
    columns = [
        pa.repeat(pa.scalar(-1, field.type), n) if pa.types.is_integer(field.type) else pa.nulls(n, field.type)
        for field in schema
    ]
    return pa.RecordBatch.from_arrays(columns, schema=bare)


def _findings(complete: bool, gaps: tuple[_Gap, ...], rate_hz: float) -> tuple[Finding, ...]:
    findings = []
    if not complete:
        findings.append(
            Finding("recording.incomplete", "error", "the recording broke off; all blocks before that are here")
        )
    if gaps:
        lost = sum(gap.n_lost for gap in gaps)
        reasons = ", ".join(sorted({gap.reason for gap in gaps}))
        findings.append(
            Finding(
                "recording.gap",
                "warning",
                f"{lost} samples ({shown_number(lost / rate_hz)} s) were lost in {len(gaps)} gaps: {reasons}",
                {"gaps": float(len(gaps)), "lost": float(lost), "lost_s": lost / rate_hz},
            )
        )
    return tuple(findings)


_MOST_TOLD = 20
_MOST_IN_A_LINE = 6


@dataclass(frozen=True)
class _Interval:
    """``from_s``, ``to_s``: since the first sample; the end of the recording where it had not ended."""

    name: str
    text: str
    from_s: float
    to_s: float
    alarm: bool

    def __str__(self) -> str:
        return f"{self.text} {self.from_s:z.1f} to {self.to_s:z.1f} s"


def _intervals(events: Sequence[Sequence[Any]], length_s: float) -> list[_Interval]:
    """Return intervals by their beginning; a text of one name ends the one before.

    An empty one ends its name, and all whose names begin with it and a space.
    """
    intervals: list[_Interval] = []
    held: dict[str, tuple[float, str, bool]] = {}
    for at_s, name, text, alarm in sorted(events, key=lambda e: float(e[0])):
        if text and name in held and held[name][1] == text:
            continue
        for other in [n for n in held if n == name or (not text and n.startswith(f"{name} "))]:
            from_s, said, was_alarm = held.pop(other)
            intervals.append(_Interval(other, said, from_s, float(at_s), was_alarm))
        if text:
            held[str(name)] = (float(at_s), str(text), bool(alarm))
    for name, (from_s, text, alarm) in held.items():
        intervals.append(_Interval(name, text, from_s, max(length_s, from_s), alarm))
    return sorted(intervals, key=lambda i: (i.from_s, i.name))


def _event_findings(events: Sequence[Sequence[Any]], length_s: float) -> tuple[Finding, ...]:
    """Return alarms one by one, and what else a machine said by name.

    ``events``: time since the first sample, name, text (empty: it is over), whether it is an alarm.
    ``length_s``: of the recording.
    """
    findings = []
    intervals = _intervals(events, length_s)
    alarms = [i for i in intervals if i.alarm]
    for one in alarms[:_MOST_TOLD]:
        numbers = {"from_s": one.from_s, "to_s": one.to_s}
        findings.append(Finding("machine.alarm", "warning", f"the machine reported {one.name}: {one}", numbers))
    if len(alarms) > _MOST_TOLD:
        text = f"the machine reported {len(alarms) - _MOST_TOLD} alarms more"
        findings.append(Finding("machine.alarm", "warning", text))
    for name in dict.fromkeys(i.name for i in intervals if not i.alarm):
        here = [str(i) for i in intervals if i.name == name and not i.alarm]
        more = f", and {len(here) - _MOST_IN_A_LINE} more" if len(here) > _MOST_IN_A_LINE else ""
        findings.append(Finding("machine.state", "info", f"{name}: {', '.join(here[:_MOST_IN_A_LINE])}{more}"))
    return tuple(findings)
