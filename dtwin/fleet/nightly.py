"""One night of a fleet: take in, diagnose, check champions, and say what somebody should look at."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.errors import DtwinError, StoreError
from dtwin.fleet.alerts import Alert, Told, sorted_alerts, tell
from dtwin.fleet.channels import channels_of
from dtwin.fleet.jobs import DIAGNOSE, Job, recheck_job
from dtwin.fleet.run import FleetRun, run_fleet
from dtwin.local_time import local_day
from dtwin.pipeline.machine_history import machine_history, machine_overviews
from dtwin.pipeline.watching import FolderWatch, WatchEvent, watch
from dtwin.progress import Progress, StageProgress, silent

# Champions are checked a little less than a day after the last time: nights do not begin to the second.
_DAYS = 0.9
_DRIFT = "drift."
_LONGEST_WAIT_S = 60.0


@dataclass
class Night:
    """What a night did.

    ``arrived``: what became of what lay in the folder.
    ``alerts``: all that is open now, told before or not.
    """

    diagnosed: FleetRun
    rechecked: FleetRun
    arrived: list[WatchEvent] = field(default_factory=list)
    alerts: list[Alert] = field(default_factory=list)
    told: Told | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "arrived": [event.as_dict() for event in self.arrived],
            "diagnosed": self.diagnosed.as_dict(),
            "rechecked": self.rechecked.as_dict(),
            "alerts": [alert.as_dict() for alert in self.alerts],
            "told": self.told.as_dict() if self.told else None,
        }


def nightly(
    home: Home,
    *,
    folder: Path | None = None,
    machines: Collection[str] = (),
    on: str = "local",
    workers: int | None = None,
    seed: int = 0,
    progress: StageProgress = silent,
    today: date | None = None,
    settle_s: float = 10.0,
) -> Night:
    """Take in what arrived, diagnose what is new, check champions, and tell what is late, failed or changed.

    ``folder``: where new measurements arrive; only those of machines that are known are taken in.
    ``machines``: all without names.
    ``on``, ``workers``: as for :func:`dtwin.fleet.run.engine`.
    ``today``: the day by which a test is overdue.
    ``settle_s``: time for which a file must stand still; what does not within a minute is left to the next night.
    """
    channels = channels_of(home)
    seen = None if folder is None else FolderWatch(folder, home, settle_s=settle_s, note_at_once=False)
    arrived = [] if seen is None else _taken_in(seen, settle_s)

    def done(job: Job) -> FleetRun:
        run = FleetRun(job.name, on)
        try:
            return run_fleet(
                home, job, machines, on=on, workers=workers, seed=seed, progress=partial(progress, job.name), into=run
            )
        except StoreError as error:
            # Of this night a scheduler that is away is told, too, and all else that there is to tell.
            run.failed[f"fleet {job.name}"] = error.as_dict()
            return run

    night = Night(done(DIAGNOSE), done(recheck_job(_DAYS)), arrived)
    day = today or local_day()
    night.alerts = sorted_alerts(
        [*_of_work(night, folder), *_of_machines(home, machines, day, partial(progress, "history"))]
    )
    night.told = tell(home, night.alerts, channels, today)
    # A night that is cut short before tells the next time what it refused.
    if seen is not None and arrived:
        seen.note()
    return night


def _taken_in(seen: FolderWatch, settle_s: float) -> list[WatchEvent]:
    """Return what became of all that stands still in a folder."""
    arrived: list[WatchEvent] = []
    until = time.monotonic() + _LONGEST_WAIT_S

    def wait(seconds: float) -> bool:
        time.sleep(seconds)
        return time.monotonic() > until

    watch(seen, arrived.append, wait, every_s=min(1.0, settle_s), once=True)
    return arrived


def _of_work(night: Night, folder: Path | None) -> Iterator[Alert]:
    """Yield what failed tonight."""
    for event in night.arrived:
        if event.outcome not in ("ingested", "unchanged"):
            # Folders of several machines may hold files of one name.
            name = Path(event.path).relative_to(folder) if folder and event.path != str(folder) else event.path
            yield Alert("failed", str(name), f"{event.outcome}: {event.message.splitlines()[0]}")
    for run in (night.diagnosed, night.rechecked):
        for name, error in run.failed.items():
            yield Alert("failed", name, f"{run.job}: {error['message']}")
    for name, said in night.rechecked.done.items():
        if said["withdrawn"]:
            yield Alert("withdrawn", name, f"the champion was withdrawn: {said['headline']}")


def _of_machines(home: Home, machines: Collection[str], today: date, progress: Progress) -> Iterator[Alert]:
    """Yield what is overdue, what changed, what crosses a limit, and champions that drifted."""
    drifts = _drifts(home, machines)
    names = [m["machine"] for m in machine_overviews(home) if not machines or m["machine"] in machines]
    for done, name in enumerate(names, start=1):
        progress(done, len(names), name)
        try:
            history = machine_history(home, name)
        except DtwinError as error:
            yield Alert("failed", name, f"history: {error.message}")
            continue
        due = history["next_test"]
        if due and due["on"] < today.isoformat():
            yield Alert("overdue", name, f"a test was due on {due['on']}: {due['why']}")
        for one in history["series"]:
            if one["crossing"] is not None:
                limit = one["crossing"]["limit"]
                yield Alert(
                    "limit",
                    f"{name} {one['name']}",
                    f"reaches {limit:g} {one['unit']} from {one['crossing']['earliest']} on",
                )
            elif one["state"] in ("changed", "trend"):
                newest = one["changes"][0]
                yield Alert("changed", f"{name} {one['name']}", newest["text"], newest["seen"])
        yield from drifts.get(name, ())


def _drifts(home: Home, machines: Collection[str]) -> dict[str, list[Alert]]:
    """Return what was said of champions that drifted, by machine; without ``machines`` of all."""
    if home.no_registry_yet:
        return {}
    from dtwin.train.registry import Registry

    registry = Registry(home)
    champions = {name: registry.champion(name) for name in registry.machines() if not machines or name in machines}
    return {
        name: [
            Alert("drifted", f"{name} {tag.removeprefix(_DRIFT)}", said.removeprefix("DRIFT: "))
            for tag, said in champion.tags.items()
            if tag.startswith(_DRIFT) and said.startswith("DRIFT: ")
        ]
        for name, champion in champions.items()
        if champion is not None
    }
