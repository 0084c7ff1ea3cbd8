"""What a serving loop shows while it runs: the newest ticks in memory that other processes read.

The loop writes a row and never waits for a reader. The memory belongs to no disk, so that no write
of a tick waits for one.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import stat
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtwin.config import Home
from dtwin.links import layout
from dtwin.schema import Floats
from dtwin.serve import safety
from dtwin.serve._machine_file import machine_folder
from dtwin.serve.safety import REASONS

COLUMNS = (
    "stamp_s",
    "interval_s",
    "age_s",
    "window_age_s",
    "correction_x_um",
    "correction_y_um",
    "correction_z_um",
    "reason",
    "actual_x_mm",
    "actual_y_mm",
    "actual_z_mm",
    "centre_x_mm",
    "centre_y_mm",
    "centre_z_mm",
    "radius_mm",
    "segment",
    "band_x_um",
    "band_y_um",
    "band_z_um",
)
"""Columns of a row, in their order."""

_FORMAT = 2030.0
_CAPACITY = 16384
_HEADER = 32
_FORMAT_AT, _PID, _CORRECTS, _ROWS, _LATE, _MISSED, _CLAMP, _PERIOD = range(8)
_REASONS = 8
_TICKS, _SHOWN = 30, 31
_SHAPE = (_HEADER + _CAPACITY * len(COLUMNS),)
_BYTES = 8 * _SHAPE[0]
_MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Seen:
    """What a board shows.

    ``corrects``: whether its corrections are sent; a dry run sends zeros in their place.
    ``ticks``, ``late``, ``missed``: since the start.
    ``clamp_um``, ``period_s``: longest correction that is allowed, and nominal period.
    ``reasons``: how often each reason of the guard acted.
    ``shown_s``: when the newest tick was shown, by this computer's ``time.monotonic()``.
    ``rows``, shape (n, columns): the newest ticks, oldest first, in the order of ``COLUMNS``.
    """

    pid: int
    corrects: bool
    ticks: int
    late: int
    missed: int
    clamp_um: float
    period_s: float
    reasons: Mapping[str, int]
    shown_s: float
    rows: Floats

    def column(self, name: str) -> Floats:
        """Return one column of the rows, shape (n,)."""
        return np.asarray(self.rows[:, COLUMNS.index(name)])

    def newest(self, span_s: float) -> NDArray[np.bool_]:
        """Tell which rows are of the newest seconds of the controller's clock, shape (n,); the last one always is.

        What is before a step back of that clock, as when the controller restarts, is not: its stamps are of another time.
        """
        stamps = self.column("stamp_s")
        begin = np.flatnonzero(np.diff(stamps) < 0.0)[-1:] + 1
        kept = ~(stamps < stamps[-1] - span_s)
        kept[: int(begin.sum())] = False
        return np.asarray(kept)


class LiveBoard:
    """The writing end.

    ``memory``, (words,): shared memory.
    ``clamp_um``, ``period_s``, ``corrects``: as in ``Seen``.
    """

    def __init__(self, memory: Floats, clamp_um: float, period_s: float, corrects: bool) -> None:
        self._head = memory[:_HEADER]
        self._rows = memory[_HEADER:].reshape(_CAPACITY, len(COLUMNS))
        self._row = np.zeros(len(COLUMNS))
        self._count = 0
        self._head[_PID], self._head[_CORRECTS] = os.getpid(), corrects
        self._head[_CLAMP], self._head[_PERIOD] = clamp_um, period_s
        self._head[_FORMAT_AT] = _FORMAT

    def show(
        self,
        state: Floats,
        correction_um: Floats,
        reason: int,
        times_s: tuple[float, float, float],
        counts: tuple[int, int],
        band_um: Floats,
        since_start: NDArray[np.int64] | None = None,
    ) -> None:
        """Show a tick.

        ``state``, (N,): newest state of the controller.
        ``correction_um``, (3,): what was sent for it.
        ``times_s``: interval since the tick before, age of the state, age of the window.
        ``counts``: late and missed ticks so far.
        ``band_um``, (3,): half width of the correction that the model asked for; NaN where it has none.
        ``since_start``, (reasons,): how often each reason of the guard acted, where not every tick is shown.
        """
        row = self._row
        row[0] = state[layout.TIMESTAMP]
        row[1:4] = times_s
        row[4:7] = correction_um
        row[7] = reason
        row[8:11] = state[layout.ACTUAL_TCP : layout.ACTUAL_TCP + 3]
        row[11:14] = state[layout.CENTRE : layout.CENTRE + 3]
        row[14] = state[layout.RADIUS]
        row[15] = state[layout.SEGMENT_ID]
        row[16:19] = band_um
        self._rows[self._count % _CAPACITY] = row
        self._count += 1
        head = self._head
        if since_start is None:
            head[_REASONS + reason] += 1
            head[_TICKS] = self._count
        else:
            head[_REASONS : _REASONS + len(since_start)] = since_start
            head[_TICKS] = since_start.sum()
        head[_LATE], head[_MISSED] = counts
        head[_SHOWN] = time.monotonic()
        head[_ROWS] = self._count


@contextlib.contextmanager
def live_board(
    machine: str, home: Home, *, clamp_um: float, period_s: float, corrects: bool
) -> Iterator[LiveBoard | None]:
    """Open the board of a machine while the block runs; None where there is no memory for it.

    ``home``: state folder; two of them have two boards.
    ``clamp_um``, ``period_s``, ``corrects``: as in ``Seen``.
    """
    path = _path(machine, home)
    try:
        path.unlink(missing_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except OSError:
        yield None
        return
    try:
        os.posix_fallocate(file, 0, _BYTES)
        shared = mmap.mmap(file, _BYTES)
    except OSError:
        path.unlink(missing_ok=True)
        yield None
        return
    finally:
        os.close(file)
    memory: Floats = np.frombuffer(shared, dtype=np.float64)
    # Every page is touched now, none for the first time in a tick.
    memory[:] = 0.0
    try:
        yield LiveBoard(memory, clamp_um, period_s, corrects)
    finally:
        path.unlink(missing_ok=True)


def read_board(machine: str, home: Home) -> Seen | None:
    """Return what the board of a machine shows; None when there is none.

    A board of another user, or of another version, is none.
    """
    try:
        file = os.open(_path(machine, home), os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        status = os.fstat(file)
        mine = status.st_uid == os.getuid() and stat.S_ISREG(status.st_mode)
        if not mine or status.st_size != _BYTES:
            return None
        with mmap.mmap(file, _BYTES, prot=mmap.PROT_READ) as shared:
            memory = np.frombuffer(bytes(shared), dtype=np.float64)
    finally:
        os.close(file)
    head, rows = memory[:_HEADER], memory[_HEADER:].reshape(_CAPACITY, len(COLUMNS))
    if head[_FORMAT_AT] != _FORMAT:
        return None
    shown = int(head[_ROWS])
    # The oldest row of a full board may be half overwritten.
    kept = min(shown, _CAPACITY - 1)
    order = np.arange(shown - kept, shown) % _CAPACITY
    counts = head[_REASONS : _REASONS + len(REASONS)]
    return Seen(
        pid=int(head[_PID]),
        corrects=bool(head[_CORRECTS]),
        # Of a first tick that is being shown there is no row yet.
        ticks=int(head[_TICKS]) if shown else 0,
        late=int(head[_LATE]),
        missed=int(head[_MISSED]),
        clamp_um=float(head[_CLAMP]),
        period_s=float(head[_PERIOD]),
        reasons={name: int(n) for name, n in zip(REASONS, counts, strict=True) if n},
        shown_s=float(head[_SHOWN]),
        rows=rows[order],
    )


def _path(machine: str, home: Home) -> Path:
    name = machine_folder(machine, home).name
    label = hashlib.sha256(str(home.root).encode()).hexdigest()[:12]
    return _MEMORY / f"dtwin-{os.getuid()}-{label}-{name}"


RECENT_S = 5.0
"""Controller time that a state is told of."""
_NOW_S = 0.5
"""Controller time that is now: what was before a pause, or in it, is no longer true."""
_CORRECTS_NOW = (safety.OK, safety.SHRUNK, safety.CLAMPED, safety.SLEWED)
_SILENT_S = 1.0


@dataclass(frozen=True)
class _LiveState:
    """What a served machine is doing now.

    ``word``, one of "starting", "correcting", "outside", "held", "silent": ``starting``: no tick was seen yet;
    ``outside``: outside the model's range now; ``held``: zeros are sent now for another reason, as of a dry run;
    ``silent``: the loop shows no new ticks.
    ``said``: the same as the end of a sentence that begins with the machine.
    ``outside_share``: share of the newest ticks outside the model's range.
    """

    word: str
    said: str
    outside_share: float = 0.0

    def as_dict(self) -> dict[str, str | float]:
        return asdict(self)


def live_state(seen: Seen | None, now_s: float) -> _LiveState:
    """Return what a board shows of the newest seconds.

    ``seen``: the board; None when there is none, as before the first tick and of loops that have none.
    ``now_s``: this computer's ``time.monotonic()``.
    """
    if seen is None or not seen.ticks:
        return _LiveState("starting", "is held by a server that has shown no tick yet")
    silent_s = now_s - seen.shown_s
    if silent_s > _SILENT_S:
        return _LiveState("silent", f"was not answered for {silent_s:z.0f} s: what is in force is not known")
    reasons = seen.column("reason")[seen.newest(RECENT_S)].astype(int)
    outside = float(np.mean(reasons == safety.OUTSIDE))
    beyond = f"outside the model's range for {100 * outside:z.0f} % of the newest {RECENT_S:z.0f} s"
    now = seen.column("reason")[seen.newest(_NOW_S)].astype(int)
    held = now[~np.isin(now, (*_CORRECTS_NOW, safety.OUTSIDE))]
    # A latched guard stays so: what was before it is no longer true.
    if now[-1] == safety.LATCHED or 2 * len(held) > len(now):
        often = safety.LATCHED if now[-1] == safety.LATCHED else Counter(held.tolist()).most_common(1)[0][0]
        return _LiveState("held", f"is not corrected now: {REASONS[often].replace('_', ' ')}", outside)
    if 2 * np.count_nonzero(now == safety.OUTSIDE) > len(now):
        return _LiveState("outside", f"is not corrected now: {beyond}", outside)
    if not seen.corrects:
        return _LiveState("held", "is not corrected: a dry run sends zeros", outside)
    return _LiveState("correcting", "is being corrected" + (f", {beyond}" if outside > 0 else ""), outside)
