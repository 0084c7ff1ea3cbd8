"""What can be done for many machines: which units there are, the work on one, and who keeps its result.

A unit is worked on anywhere by a function of this module that reads the home and writes nothing but short cuts.
What it returns is kept by the one process that conducts the job.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtwin.config import Home
from dtwin.documents import finite
from dtwin.errors import GateRefusal, StoreError
from dtwin.kinds.registry import kind_named
from dtwin.lake.rows import by_campaign
from dtwin.lake.store import Lake
from dtwin.pipeline.kept import keep, kept_already, stamp_of

if TYPE_CHECKING:
    from dtwin.train.registry import RegisteredVersion

DIAGNOSES = "diagnoses"
_Units = tuple[list["Unit"], dict[str, str]]


@dataclass(frozen=True)
class Unit:
    """One piece of work.

    ``name``: a campaign, or a machine: what is reported and resumed by.
    ``stamp``: of what the result depends on.
    """

    name: str
    machine: str
    stamp: str = ""


@dataclass(frozen=True)
class Job:
    """Work for many machines.

    ``units``: returns what is to do in a home for some machines (all without names), and what is passed over: names and
    why.
    ``work``: returns the result of a unit; takes the home's folder, the unit and a seed, all of which can be sent.
    ``keep``: keeps a result, and returns what is said of it, JSON-ready.
    """

    name: str
    units: Callable[[Home, Collection[str]], _Units]
    work: Callable[[str, Unit, int], Any]
    keep: Callable[[Home, Unit, Any], dict[str, Any]]


def _campaigns(home: Home, machines: Collection[str]) -> _Units:
    """Return campaigns that were not diagnosed since their runs changed."""
    units, passed = [], {}
    for name, rows in by_campaign(Lake(home.lake).runs(left_out=True, machine=machines or None)).items():
        kind = kind_named(str(rows[0]["kind"]))
        stamp = _stamp(rows)
        if all(row["left_out"] for row in rows):
            passed[name] = "all its runs are left out"
        elif not kind.offers("rows"):
            passed[name] = kind.lacks("rows").message
        elif kept_already(home, DIAGNOSES, name, stamp) is not None:
            passed[name] = "diagnosed already"
        else:
            units.append(Unit(name, str(rows[0]["machine"]), stamp))
    return units, passed


def _stamp(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return what a diagnosis depends on: runs of a campaign, and effects that are known."""
    from dtwin.physics.library import Library

    return f"{stamp_of(rows)} {' '.join(Library())}"


def _require(there: object, asked: object, unit: Unit, what: str) -> None:
    """Refuse what is not of the unit that was asked for: a worker of another computer may have another home."""
    if there != asked:
        raise StoreError(
            f"a worker has other {what} than the home that asked it",
            code="fleet.other",
            where=f"{unit.name}, worked on by {platform.node()}",
            got=str(there)[:120],
            allowed=str(asked)[:120],
            hint="give workers the same home and version of dtwin; where runs changed meanwhile, give the command again",
        )


def _diagnosed(root: str, unit: Unit, seed: int) -> dict[str, Any]:
    """Return what the runs of a campaign can tell, from nothing but the set-up."""
    from dtwin.physics.diagnose import diagnose
    from dtwin.physics.library import Library
    from dtwin.physics.twin import data_lines
    from dtwin.twins.measured import load

    loaded = load(Home(Path(root)), unit.name)
    _require(_stamp(Lake(Home(Path(root)).lake).runs(unit.name, left_out=True)), unit.stamp, unit, "runs or effects")
    diagnosis = replace(diagnose(loaded.obs, [], Library(), seed=seed), told=tuple(data_lines(loaded.data)))
    started = min((meta.started or "" for meta in loaded.obs.runs), default="")
    head = {"campaign": unit.name, "machine": unit.machine, "kind": loaded.obs.campaign.kind, "started": started}
    # As it is after being written and read: the same wherever it was computed.
    return json.loads(json.dumps(finite(head | diagnosis.as_dict())))


def _keep_diagnosis(home: Home, unit: Unit, result: Any) -> dict[str, Any]:
    from dtwin.fleet.alerts import line_of

    # Before it is kept: what a worker of another version answers may be no diagnosis.
    told = {name: line_of(result)[name] for name in ("verdict", "headline")}
    _require((result["campaign"], result["machine"]), (unit.name, unit.machine), unit, "answers")
    keep(home, DIAGNOSES, unit.name, unit.stamp, result)
    return told


def _trainable(home: Home, machines: Collection[str]) -> _Units:
    """Return for each machine its newest campaign, when it has runs that no version was trained on."""
    from dtwin.lifecycle.schedule import news
    from dtwin.train.registry import Registry

    units, passed, seen = [], {}, set()
    for item in news(home, Registry(home), machines):
        if item.machine in seen:
            continue
        if item.obstacle:
            passed[item.campaign] = item.obstacle
            continue
        seen.add(item.machine)
        if item.is_new:
            units.append(Unit(item.campaign, item.machine, item.digest))
        else:
            passed[item.campaign] = "every run was trained on already"
    return units, passed


def _trained(root: str, unit: Unit, seed: int) -> Any:
    from dtwin.lifecycle.drift import usable
    from dtwin.lifecycle.schedule import digest_of
    from dtwin.lifecycle.train import trained

    rows = Lake(Home(Path(root)).lake).runs(unit.name)
    _require(digest_of([row for row in rows if usable(row)]), unit.stamp, unit, "runs")
    return trained(Home(Path(root)), unit.name, seed=seed)


def _register(home: Home, unit: Unit, result: Any) -> dict[str, Any]:
    from dtwin.lifecycle.drift import trained_rows
    from dtwin.lifecycle.schedule import compared, digest_of
    from dtwin.lifecycle.train import registered
    from dtwin.train.registry import Registry

    _require((result.report.campaign, result.report.machine), (unit.name, unit.machine), unit, "answers")
    registry = Registry(home)
    before = {version.version for version in registry.versions(unit.machine)}
    if unit not in _trainable(home, (unit.machine,))[0]:
        raise _late(unit)
    made = registered(home, result)
    # Two that look at the same moment both see nothing: numbers tell who was first.
    for other in registry.versions(unit.machine):
        if (
            other.version not in before
            and int(other.version) < int(made.version.version)
            and digest_of(trained_rows(registry, Lake(home.lake), other)) == unit.stamp
        ):
            registry.drop(made.version, other)
            raise _late(unit)
    comparison = compared(home, made)
    return {
        "version": made.version.version,
        "proposed": made.training.report.proposed,
        "gates_passed": all(verdict.passed for verdict in made.verdicts),
        "against_champion": comparison.verdict if comparison is not None else None,
    }


def _late(unit: Unit) -> GateRefusal:
    return GateRefusal(
        "another computer, or somebody, trained on these runs meanwhile, or they changed",
        code="fleet.late",
        where=unit.name,
        hint="nothing is registered twice; give the command again for what is new",
    )


def _champions(days: float, home: Home, machines: Collection[str]) -> _Units:
    """Return machines whose champion was not checked for some days."""
    if home.no_registry_yet:
        return [], {}
    from dtwin.lifecycle.recheck import left_out
    from dtwin.train.registry import Registry

    registry = Registry(home)
    units, passed = [], {}
    limit = (datetime.now(UTC) - timedelta(days=days)).strftime("%Y%m%d-%H%M%S")
    for machine in registry.machines():
        if machines and machine not in machines:
            continue
        if why := left_out(registry, machine):
            passed[machine] = why
            continue
        champion = registry.version(machine, "champion")
        if (last := champion.tags.get("recheck", "").partition(" ")[0]) > limit:
            passed[machine] = f"checked {last}"
        else:
            units.append(Unit(machine, machine, _which(champion)))
    return units, passed


def _which(champion: RegisteredVersion) -> str:
    """Return what a check of a champion depends on: another home may have another one of its number."""
    from dtwin.train.registry import MODEL

    return f"{champion.version} {champion.tags.get(MODEL, '')}".rstrip()


def _looked_at(root: str, unit: Unit, seed: int) -> Any:
    from dtwin.lifecycle.recheck import look_again
    from dtwin.train.registry import Registry

    home = Home(Path(root))
    champion = Registry(home).version(unit.machine, unit.stamp.partition(" ")[0])
    _require(_which(champion), unit.stamp, unit, "models")
    return look_again(home, champion, seed=seed)


def _settle(home: Home, unit: Unit, result: Any) -> dict[str, Any]:
    from dtwin.lifecycle.recheck import settled
    from dtwin.train.registry import Registry

    registry = Registry(home)
    champion = registry.version(unit.machine, "champion")
    if _which(champion) != unit.stamp:
        raise GateRefusal(
            "another version became champion meanwhile",
            code="fleet.champion",
            where=f"machine {unit.machine}",
            got=champion.version,
            allowed=unit.stamp.partition(" ")[0],
        )
    done = settled(home, champion, result)
    return {"verdict": done.found.verdict, "headline": done.found.reason, "withdrawn": done.withdrawn}


DIAGNOSE = Job("diagnose", _campaigns, _diagnosed, _keep_diagnosis)
TRAIN = Job("train", _trainable, _trained, _register)


def recheck_job(days: float) -> Job:
    """Return the job that checks champions which were not checked for so many days."""
    return Job("recheck", partial(_champions, days), _looked_at, _settle)
