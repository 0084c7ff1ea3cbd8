"""A recording in progress: what it has acknowledged outlives a killed process.

One Arrow IPC stream per device group. Every block carries its place on the device's clock and
a checksum, and is on disk when ``append`` returns. ``dtwin.acquire._recovery`` reads streams
back and seals them into Parquet.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import DTypeLike, NDArray

from dtwin.errors import InputError, StoreError
from dtwin.locks import take
from dtwin.schema import require_name
from dtwin.units import require_units

SUFFIX = ".arrows"
STREAM_KEY = b"dtwin.recording"
BLOCK_KEY = b"dtwin.block"
_LONGEST_GAP_S = 3600.0
_LONGEST_NAME, _LONGEST_TEXT = 80, 200


class Recorder:
    """Writes the signals of one device group, block by block.

    ``path``: stream to create; it must not exist yet.
    ``group``: device group, for example ``"accelerometers"``.
    ``rate_hz``: sample rate that the device really has.
    ``columns``: signals and how they are kept; names of floating-point columns end in their unit.
    ``start_s``: time of the first sample on the device's own clock.
    ``notes``: anything JSON-ready that belongs to the recording, such as the rate that was asked for.
    ``durable``: wait for the disk after every block, so that a power cut loses nothing acknowledged either. Without it
    a killed process still loses nothing.
    Raises ``InputError`` when a column has no unit, or is neither float nor signed integer.
    Raises ``StoreError`` when the stream exists already or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        group: str,
        rate_hz: float,
        columns: Mapping[str, DTypeLike],
        *,
        start_s: float = 0.0,
        notes: Mapping[str, Any] | None = None,
        durable: bool = True,
    ) -> None:
        require_name(group, "the device group")
        self.path, self.group, self.rate_hz = path, group, float(rate_hz)
        self._types = {name: np.dtype(kind) for name, kind in columns.items()}
        self._check_columns()
        self.n_samples = 0
        self._closed = False
        fields = [pa.field(name, pa.from_numpy_dtype(kind)) for name, kind in self._types.items()]
        head = {"group": group, "rate_hz": self.rate_hz, "start_s": start_s}
        self._schema = pa.schema(fields, metadata={STREAM_KEY: _header(head | {"notes": dict(notes or {})}, fields)})
        self._disk = _Disk(path, durable)
        self._stream = pa.ipc.new_stream(pa.PythonFile(self._disk, "w"), self._schema)
        self._empty = _batch([np.empty(0, kind) for kind in self._types.values()], self._schema)
        # The schema reaches the file with this first, empty block.
        self._write(self._empty, [], {})

    def append(self, block: Mapping[str, NDArray[Any]]) -> int:
        """Add samples that follow the last ones without a gap, and return the sample count.

        ``block`` (n,): every declared column.
        Returns samples since the start, lost ones included; all of them are safe now.
        Raises ``InputError`` when the block has other columns, lengths or types than declared.
        Raises ``StoreError`` when the disk is full; every block acknowledged before is safe, and the recording accepts
        nothing more.
        """
        self._require_open()
        arrays = self._arrays(block)
        batch = _batch(arrays, self._schema)
        self._write(batch, arrays, {})
        self.n_samples += batch.num_rows
        return self.n_samples

    def gap(self, n_lost: int, reason: str) -> None:
        """Record that samples were lost; nothing is ever put in their place.

        ``n_lost``: number of samples per channel that the device took and nobody read.
        Raises ``InputError`` when the number is not positive, or so large that a new recording should begin.
        Raises ``StoreError``: as for ``append``.
        """
        self._require_open()
        most = int(_LONGEST_GAP_S * self.rate_hz)
        if not 0 < n_lost <= most:
            raise InputError(
                "a gap of this length cannot be recorded",
                code="recording.gap",
                where=str(self.path),
                got=f"{n_lost} samples",
                allowed=f"1 to {most} samples",
                hint="end this recording and begin another",
            )
        self._write(self._empty, [], {"lost": int(n_lost), "why": reason[:200]})
        self.n_samples += int(n_lost)

    def say(self, events: Sequence[tuple[float, str, str, bool]]) -> None:
        """Record what the machine said: time since the first sample, name, text, whether it is an alarm.

        Raises ``StoreError``: as for ``append``.
        """
        self._require_open()
        kept = [[at_s, name[:_LONGEST_NAME], text[:_LONGEST_TEXT], alarm] for at_s, name, text, alarm in events]
        self._write(self._empty, [], {"events": kept})

    def close(self) -> None:
        """Mark the recording as complete; safe to call twice.

        A recording that failed, or whose process died before this, is incomplete.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._disk.failed:
                self._write(self._empty, [], {"end": True})
                self._stream.close()
                self._disk.commit()
        finally:
            self._disk.end()

    def abandon(self) -> None:
        """Stop writing without marking the recording as complete; safe to call twice."""
        if not self._closed:
            self._closed = True
            self._disk.end()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()

    def _write(self, batch: pa.RecordBatch, arrays: list[NDArray[Any]], more: Mapping[str, Any]) -> None:
        place = json.dumps({"first": self.n_samples, "lost": 0, **more})
        label = json.dumps({"place": place, "crc": checksum(place, arrays)})
        self._stream.write_batch(batch, custom_metadata={BLOCK_KEY: label})
        self._disk.commit()

    def _arrays(self, block: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        shapes = {np.shape(values) for values in block.values()}
        if set(block) != set(self._types) or len(shapes) != 1 or len(shapes.pop()) != 1:
            raise InputError(
                "the block does not fit the recording",
                code="recording.block",
                where=str(self.path),
                got=", ".join(f"{n}{np.shape(v)}" for n, v in block.items())[:300],
                allowed=f"one array of equal length for each of {', '.join(self._types)}",
            )
        try:
            return [
                np.ascontiguousarray(block[name]).astype(kind, casting="same_kind", copy=False)
                for name, kind in self._types.items()
            ]
        except TypeError as error:
            raise InputError(
                "a column has another type than declared",
                code="recording.type",
                where=str(self.path),
                got=str(error)[:200],
            ) from error

    def _check_columns(self) -> None:
        odd = [name for name, kind in self._types.items() if kind.kind not in "fi"]
        if odd or not self._types:
            raise InputError(
                "a recording needs columns of floats or signed integers",
                code="recording.columns",
                where=str(self.path),
                got=", ".join(odd)[:200] or "no column",
            )
        floats = [name for name, kind in self._types.items() if kind.kind == "f"]
        require_units(floats, str(self.path))

    def _require_open(self) -> None:
        if self._closed or self._disk.failed:
            raise StoreError(
                "the recording is closed", code="recording.closed", where=str(self.path), hint="begin another recording"
            )


class _Disk:
    """Collects what makes up a block, and puts all of it into the file or none."""

    def __init__(self, path: Path, durable: bool) -> None:
        self.closed = False
        self.failed = False
        self._path, self._durable = path, durable
        self._pending = bytearray()
        self._length = 0
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, flags, 0o644)
        except OSError as error:
            raise StoreError(
                "the recording cannot be created",
                code="recording.create",
                where=str(path),
                got=str(error),
                hint="recover or remove an earlier recording of this name; check permissions",
            ) from error
        # Released by the kernel when this process dies: tells a live recording from a dead one.
        take(self._file)

    def write(self, data: bytes) -> int:
        """Take bytes of the block in the making."""
        self._pending += data
        return len(data)

    def flush(self) -> None:
        """Do nothing: blocks are written whole by ``commit``."""

    def commit(self) -> None:
        """Put the collected block on disk."""
        rest = memoryview(bytes(self._pending))
        self._pending.clear()
        length = len(rest)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
            if self._durable:
                os.fdatasync(self._file)
        except OSError as error:
            self.failed = True
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._length)
            raise StoreError(
                "the recording cannot be continued; all blocks before this one are safe",
                code="recording.write",
                where=str(self._path),
                got=str(error),
                hint="free space, then recover the recording and begin another",
            ) from error
        self._length += length

    def end(self) -> None:
        """Release the file."""
        self.closed = True
        os.close(self._file)


def _batch(arrays: Sequence[NDArray[Any]], schema: pa.Schema) -> pa.RecordBatch:
    # Plain ``pa.array`` would import pandas, which takes over a second in mid-recording.
    columns = [
        pa.Array.from_buffers(field.type, len(array), [None, pa.py_buffer(array)])
        for array, field in zip(arrays, schema, strict=True)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _header(head: Mapping[str, Any], fields: Sequence[pa.Field]) -> str:
    """Return the stream's header: what it tells and a checksum of it and of the fields."""
    content = json.dumps(dict(head))
    return json.dumps({"head": content, "crc": header_checksum(content, fields)})


def header_checksum(content: str, fields: Sequence[pa.Field]) -> int:
    """Return the CRC-32 of a header's content and of the names and types of the columns."""
    columns = [[field.name, str(field.type)] for field in fields]
    return zlib.crc32(f"{content} {json.dumps(columns)}".encode())


def checksum(place: str, arrays: list[NDArray[Any]]) -> int:
    """Return the CRC-32 of a block's place and of its columns in order."""
    crc = zlib.crc32(place.encode())
    for array in arrays:
        crc = zlib.crc32(np.ascontiguousarray(array).data, crc)
    return crc
