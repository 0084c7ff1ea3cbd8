"""What every page needs: the home, the library, results that are kept, work in progress, and what can act in a campaign."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

from fastapi import Depends, Request

from dtwin.config import Home
from dtwin.errors import DtwinError, InputError, StoreError
from dtwin.kinds.registry import kind_named
from dtwin.lake.store import Lake
from dtwin.physics.effect import Effect
from dtwin.physics.library import Library, campaign_instances
from dtwin.physics.state import AXES_OF
from dtwin.pipeline.home_catalogue import Overview, TwinLine, catalogue, distinct, twin_lines, twins_stamp
from dtwin.pipeline.kept import stamp_of
from dtwin.pipeline.machine_history import machine_history
from dtwin.twins.of_kind import AnyTwin, AnyTwins, twins_with
from dtwin.twins.verbs import Twins
from dtwin.workbench._access import Access
from dtwin.workbench._jobs import Jobs
from dtwin.workbench._uploads import Trays

_Result = TypeVar("_Result")
# So long a page waits for what is read once and kept.
_PATIENCE_S = 0.7


class Cache:
    """The newest results by key; a key holds the version of what it was made from.

    Two requests for the same absent key make it once.
    """

    def __init__(self, most: int = 48) -> None:
        self.most = most
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()
        self._making: dict[Hashable, threading.Lock] = {}
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], _Result]) -> _Result:
        """Return the result of a key, made now when it is absent."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return cast(_Result, self._kept[key])
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                if key in self._kept:
                    return cast(_Result, self._kept[key])
            made = make()
            with self._lock:
                self._kept[key] = made
                self._making.pop(key, None)
                while len(self._kept) > self.most:
                    self._kept.popitem(last=False)
        return made


@dataclass
class Bench:
    """State of one server.

    ``effects_path``: folder of the user's own effects; their code is run.
    ``cache``, ``live``: what is kept of data, and pictures of loops that run: these change all the time, and must not push out those.
    """

    home: Home
    access: Access
    effects_path: Path | None = None
    cache: Cache = field(default_factory=Cache)
    live: Cache = field(default_factory=Cache)

    def __post_init__(self) -> None:
        """Find what an earlier server left."""
        self.jobs = Jobs(self.folder / "jobs")
        self.trays = Trays(self.folder / "uploads")
        self._place = _place_of(self.home.root)

    def require_home(self) -> None:
        """Refuse to go on where the home was taken away: its pages would say that nothing was ever measured."""
        place = _place_of(self.home.root)
        if self._place is not None and place != self._place:
            raise StoreError(
                "the home is gone: it was moved, renamed or deleted while the workbench runs",
                code="home.gone",
                where=str(self.home.root),
                allowed="the folder as it was",
                hint="move it back and reload, or stop the workbench and start it with DTWIN_HOME=FOLDER dtwin ui",
            )
        self._place = place
        self.home.require_parts()

    @property
    def folder(self) -> Path:
        """What the workbench keeps for itself."""
        return self.home.root / "workbench"

    @property
    def lake(self) -> Lake:
        """The lake."""
        return Lake(self.home.lake)

    @property
    def library(self) -> Mapping[str, Effect]:
        """Effects, the user's own ones included; read again when one of their files changes."""
        return self._own()[0]

    @property
    def effect_errors(self) -> Mapping[str, str]:
        """The user's effect files that cannot be used, and why."""
        return self._own()[1]

    @property
    def twins(self) -> Twins:
        """The verbs."""
        return Twins(self.home, self.library)

    def twins_with(self, name: str) -> AnyTwins:
        """Return the verbs for a twin, whatever its kind."""
        return twins_with(self.home, self.library, name)

    def twin_lines(self) -> Sequence[TwinLine]:
        """Return the twins of every kind, by name."""
        return self.cache.get(("twins", self.twins_version), lambda: twin_lines(self.home))

    @property
    def twins_version(self) -> tuple[tuple[str, int], ...]:
        """What changes with every twin."""
        return tuple(sorted(twins_stamp(self.home).items()))

    def own_files(self) -> list[Path]:
        """Return the user's effect files that are switched on."""
        if self.effects_path is None or not self.effects_path.is_dir():
            return []
        return sorted(self.effects_path.glob("*.py"))

    def _own(self) -> tuple[Library, dict[str, str]]:
        files = self.own_files()
        stamp = tuple((str(f), f.stat().st_mtime_ns) for f in files)
        return self.cache.get(("library", stamp), lambda: _usable(files))

    def campaigns(self) -> Sequence[Overview]:
        """Return all campaigns, the newest ingest first."""
        return self.cache.get(("catalogue", *self.lake_version), lambda: catalogue(self.home))

    def campaigns_soon(self) -> Sequence[Overview] | None:
        """Return the same; None where a page would have to wait for it: that many are read once, and are kept."""

        def read() -> None:
            with suppress(DtwinError):  # The next who asks is told.
                self.campaigns()

        reading = threading.Thread(target=read, daemon=True)
        reading.start()
        reading.join(_PATIENCE_S)
        return None if reading.is_alive() else self.campaigns()

    def campaigns_of(self, machine: str, kind: str = "") -> list[str]:
        """Return the names of the campaigns of a machine, sorted; of one kind where it is given."""
        return sorted(one.name for one in self.campaigns() if one.machine == machine and kind in ("", one.kind))

    def able_to(self, twin: AnyTwin, verb: str) -> list[str]:
        """Return the campaigns of a twin whose kind has a verb."""
        kind_of = {one.name: one.kind for one in self.campaigns()}
        return [name for name in twin.campaigns if name in kind_of and kind_named(kind_of[name]).offers(verb)]

    def history(self, machine: str) -> dict[str, Any]:
        """Return what is known of a machine, its tests, and how its figures went."""
        version = self.lake_version
        files = self.cache.get(("files", machine, *version), lambda: self.lake.files_by_campaign(machine))
        return machine_history(self.home, machine, library=self.library, twins=self.twin_lines(), files=files)

    def run_rows(self, campaign: str) -> Sequence[Mapping[str, Any]]:
        """Return the rows of the runs of a campaign, left out ones too, read once for each version.

        Raises ``InputError`` when there is no such campaign.
        """

        def read() -> Sequence[Mapping[str, Any]]:
            rows = self.lake.runs(campaign, left_out=True)
            if not rows:
                self.lake.campaign(campaign)
            return rows

        return self.cache.get(("rows", campaign, *self.lake_version), read)

    @property
    def lake_version(self) -> tuple[int, int]:
        """What changes with the rows of the runs: versions of the tables that they come from."""
        tables = self.lake.tables
        return tables["runs"].version(), tables["amendments"].version()

    def stamp(self, campaign: str) -> str:
        """Return a hash of the runs of a campaign: other campaigns do not change it."""
        rows = self.run_rows(campaign)
        return self.cache.get(("stamp", campaign, *self.lake_version), lambda: stamp_of(rows))


def bench_of(request: Request) -> Bench:
    """Return the state of the server that answers a request."""
    return cast(Bench, request.app.state.bench)


async def _here(request: Request) -> Bench:
    return bench_of(request)


Here = Annotated[Bench, Depends(_here)]
"""The same as an argument of what answers."""


def _place_of(root: Path) -> tuple[int, int] | None:
    """Return which folder stands at a path: one that was made anew under the old name is another."""
    try:
        known = root.stat()
    except OSError:
        return None
    return known.st_dev, known.st_ino


def _usable(files: Sequence[Path]) -> tuple[Library, dict[str, str]]:
    """Return the library with the files that work; one that does not must not stop the rest."""
    good: list[Path] = []
    errors: dict[str, str] = {}
    for file in files:
        try:
            Library([*good, file])
            good.append(file)
        except InputError as error:
            errors[file.name] = error.render()
    return Library(good), errors


def possible_effects(rows: Sequence[Mapping[str, Any]], library: Mapping[str, Effect]) -> list[Effect]:
    """Return the effects that can act in a campaign, set-up terms left out, by name.

    ``rows``: its rows, at least one.
    """
    planes = distinct(rows, "plane")
    conditions = map(json.loads, distinct(rows, "condition_json"))
    alone = {str(axis) for condition in conditions if (axis := condition.get("axis"))}
    axes = sorted({axis for plane in planes for axis in AXES_OF[plane]} | alone)
    geometry = json.loads(rows[0]["geometry_json"])
    instances = campaign_instances(library, rows[0]["kind"], planes, axes, geometry)
    effects = {i.effect.name: i.effect for i in instances if not i.effect.setup}
    return [effects[name] for name in sorted(effects)]
