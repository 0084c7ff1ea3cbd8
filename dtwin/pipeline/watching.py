"""Bring into the lake what arrives in a folder, and say what does not belong there."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from dtwin.acquire.arrivals import Arrival, Arrivals
from dtwin.acquire.ingest import ingest, open_source, worst
from dtwin.atomic import write_text
from dtwin.config import Home
from dtwin.errors import DtwinError, StoreError
from dtwin.lake.store import Lake
from dtwin.locks import locked
from dtwin.machine_record import recorded
from dtwin.pipeline.home_catalogue import catalogue

_Outcome = Literal["ingested", "unchanged", "unknown machine", "not accepted", "not reachable"]
_SETTLE_S = 10.0
_ALONE = (".b5r",)


@dataclass(frozen=True)
class WatchEvent:
    """What became of something that arrived.

    ``outcome``: ``ingested``, ``unchanged`` (the same content was there), ``unknown machine`` (left where it is), ``not
    accepted`` (the reader says no), ``not reachable`` (the folder cannot be read).
    ``campaign``: campaign in the lake, empty when nothing was ingested.
    """

    path: str
    outcome: _Outcome
    message: str
    campaign: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return asdict(self)


class FolderWatch:
    """Ingests what arrives in a folder, each thing once; goes on after a restart.

    ``home``: lake, and what is known of the folder's files.
    ``machines``: machines that may be ingested, besides those that the lake knows already.
    ``settle_s``: time for which a file must stand still before it is read.
    ``note_at_once``: note what was seen when it was told; else when :meth:`note` is called.
    """

    def __init__(
        self,
        folder: Path,
        home: Home,
        machines: Collection[str] = (),
        settle_s: float = _SETTLE_S,
        note_at_once: bool = True,
    ) -> None:
        self._arrivals = Arrivals(folder, settle_s, lambda path: path.suffix.lower() in _ALONE)
        self._home, self._named = home, frozenset(machines)
        self._file = _state_file(home, folder)
        self._known: dict[str, dict[str, Any]] = _read(self._file)
        self._gone, self._at_once = False, note_at_once

    @property
    def idle(self) -> bool:
        """Whether nothing that was seen is still being written."""
        return not self._arrivals.moving

    def look(self) -> Iterator[WatchEvent]:
        """Look once, and yield what is new since the last look; it is noted after that, so that a kill tells it again."""
        try:
            arrived = self._arrivals.look()
        except OSError as error:
            told = not self._gone
            self._gone = True
            reason = f"the folder cannot be read now: {error.strerror or error}; looking again"
            if told:
                yield WatchEvent(str(self._arrivals.folder), "not reachable", reason)
            return
        self._gone = False
        for arrival in arrived:
            event = self._taken(arrival)
            if event is not None:
                yield event
                if self._at_once:
                    self.note()

    def note(self) -> None:
        """Keep what was seen: another watch says no more of it."""
        write_text(self._file, json.dumps(self._known, indent=1), "the state of the watch")

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the folder against a second watch of this home."""
        with locked(self._file.with_suffix(".lock")) as mine:
            if not mine:
                raise StoreError(
                    "the folder is watched already",
                    code="watch.busy",
                    where=str(self._arrivals.folder),
                    hint="one dtwin watch is enough",
                )
            yield

    def _taken(self, arrival: Arrival) -> WatchEvent | None:
        """Ingest an arrival unless its look is known; None when there is nothing to say."""
        name = str(arrival.path)
        before = self._known.get(name)
        stamp = [list(part) for part in arrival.stamp]
        if before is not None and before["stamp"] == stamp and not self._now_known(before):
            return None
        try:
            digest = arrival.sha256
            event, machine = self._judged(arrival, digest)
        except (OSError, StoreError) as error:
            if isinstance(error, StoreError) and error.code != "store.busy":
                raise
            # Gone, locked by who writes it, or another ingest goes on: the next look tells.
            return None
        self._known[name] = {
            "stamp": stamp,
            "sha256": digest,
            "outcome": event.outcome,
            "machine": machine,
            "campaign": event.campaign,
        }
        return event

    def _judged(self, arrival: Arrival, digest: str) -> tuple[WatchEvent, str]:
        name = str(arrival.path)
        if name != os.fsencode(name).decode(errors="replace"):
            said = "its name is not in UTF-8, and could not be kept beside its runs: rename it"
            return WatchEvent(name, "not accepted", said), ""
        for other, known in self._known.items():
            if known["sha256"] == digest and known["outcome"] in ("ingested", "unchanged"):
                said = "nothing in it has changed" if other == name else f"the same as {other}"
                event = WatchEvent(name, "unchanged", said, known["campaign"])
                return event, known["machine"]
        try:
            campaign, _, _ = open_source(arrival.path)
            if campaign.machine not in self._machines():
                said = (
                    f"nothing is known of a machine {campaign.machine!r}: left where it is; to take "
                    f"it in: dtwin machine add {campaign.machine}, or dtwin watch {self._arrivals.folder} --machine {campaign.machine}"
                )
                return WatchEvent(name, "unknown machine", said), campaign.machine
            report = ingest(arrival.path, Lake(self._home.lake))
        except DtwinError as error:
            if isinstance(error, StoreError):
                raise
            said = f"{error.render()}\n  left where it is; read again when it changes"
            return WatchEvent(name, "not accepted", said), ""
        counts = f"{len(report.added)} runs added, {len(report.unchanged)} unchanged"
        said = f"{counts}, worst finding: {worst(report.findings)}"
        outcome: _Outcome = "ingested" if report.added else "unchanged"
        return WatchEvent(name, outcome, said, report.campaign), campaign.machine

    def _now_known(self, before: dict[str, Any]) -> bool:
        """Tell whether what was left aside is of a machine that has become known since."""
        return before["outcome"] == "unknown machine" and before["machine"] in self._machines()

    def _machines(self) -> frozenset[str]:
        # Those with a record, too: somebody who may has added them.
        return self._named | {one.machine for one in catalogue(self._home) if one.used} | set(recorded(self._home))


def watch(
    folder_watch: FolderWatch,
    tell: Callable[[WatchEvent], None],
    wait: Callable[[float], bool],
    *,
    every_s: float,
    once: bool = False,
) -> None:
    """Look again and again.

    ``tell``: is told of everything that happened.
    ``wait``: waits so many seconds; true ends the watch.
    ``once``: end when everything that is there has been taken or refused.
    """
    with folder_watch.alone():
        first = True
        while True:
            for event in folder_watch.look():
                tell(event)
            if once and not first and folder_watch.idle:
                return
            first = False
            if wait(every_s):
                return


def _state_file(home: Home, folder: Path) -> Path:
    resolved = str(folder.resolve())
    digest = hashlib.sha256(os.fsencode(resolved)).hexdigest()[:16]
    return home.root / "watch" / f"{digest}.json"


def _read(path: Path) -> dict[str, dict[str, Any]]:
    """Return what an earlier watch knew; a damaged file only costs work: the lake knows its runs."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        wanted = {"stamp", "sha256", "outcome", "machine", "campaign"}
        good = isinstance(document, dict) and all(set(known) == wanted for known in document.values())
    except (OSError, ValueError, TypeError):
        return {}
    return document if good else {}
