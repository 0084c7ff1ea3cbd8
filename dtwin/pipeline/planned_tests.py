"""Tests of a machine that are planned: what they would tell, and those that wait for their measurement."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from dtwin.atomic import make_folder, write_text
from dtwin.config import Home
from dtwin.errors import DtwinError, InputError
from dtwin.kinds.kind import Kind, Planned
from dtwin.kinds.machine import PLAN, VirtualMachine
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.rows import by_campaign, campaign_of, meta_of
from dtwin.lake.store import Lake
from dtwin.local_time import local_day
from dtwin.machine_record import read_record
from dtwin.physics.candidates import applicable
from dtwin.physics.effect import Effect
from dtwin.physics.experiment import detectable
from dtwin.physics.observations import Observations
from dtwin.physics.problem import unweighted
from dtwin.plan_file import planned_document, read_plan_file
from dtwin.schema import Floats, Run, RunMeta, require_name

_USUAL_AXES = "XYZ"
# Of what an effect shows beside the set-ups, so much is shown by another one too: they look alike.
_ALIKE = 0.95
# A thousand, as in 1.000 and 1,000, or one with three decimals, or two numbers.
_OF_THOUSANDS = re.compile(r"[1-9]\d{0,2}(\.\d00|(\.\d{3}){2,})|0\d\d")
_Where = tuple[object, ...]


def draft_of(home: Home, machine: str, kind: str = "") -> dict[str, Any]:
    """Return a plan file of a kind with the settings of the machine's last test, else usual ones, as TOML is read.

    Figures are compared under one condition. Its name holds machine and day, so that it becomes a campaign of its own.

    ``kind``: that of the machine's last test without.

    Raises ``InputError`` when the kind is not known, or has no form for a plan.
    """
    record = read_record(home, require_name(machine, "the machine"))
    axes = (record.reach if record is not None else {}) or {axis: {} for axis in _USUAL_AXES}
    lake = Lake(home.lake)
    kind, last = _last_test(lake, machine, kind)
    runs = [lake.load(last[0], signals=False), *(Run(meta_of(row), {}) for row in last[1:])] if last else []
    document = {table: dict(known) for table, known in kind_named(kind).draft(machine, axes, runs).items()}
    stem = f"{machine}-{document['plan']['name']}-{local_day().isoformat()}"
    taken = {*lake.campaigns(), *(path.stem for path in home.plans.glob("*.toml"))}
    free = (stem if n == 1 else f"{stem}-{n}" for n in range(1, len(taken) + 2))
    document["plan"]["name"] = next(name for name in free if name not in taken)
    return document


def _last_test(lake: Lake, machine: str, kind: str) -> tuple[str, list[dict[str, Any]]]:
    """Return the kind and the rows of the last test of a machine that has a form for a plan; ``kind``: only of it."""
    among = [kind] if kind else drafting_kinds()
    tests = by_campaign(row for row in lake.runs(machine=machine) if row["kind"] in among)
    last = max(tests.values(), key=lambda rows: max((r["started"] or "", r["ingested"]) for r in rows), default=[])
    return (str(last[0]["kind"]) if last else among[0]), last


def with_settings(document: Mapping[str, Any], told: Mapping[str, str]) -> dict[str, Any]:
    """Return a plan file with some settings told anew, each read as what it is in the draft.

    ``document``: as :func:`draft_of` returns it.
    ``told``: by name; the parts of a list are separated by commas, semicolons or spaces.
    Raises ``InputError`` when there is no such setting, or it cannot be read.
    """
    out = {table: dict(known) for table, known in document.items()}
    for name, text in told.items():
        table = next((table for table, known in out.items() if name in known), None)
        if table is None or name in ("kind", "machine"):
            allowed = [n for known in out.values() for n in known if n not in ("kind", "machine")]
            raise InputError("no such setting", code="plan.setting", got=name[:40], allowed=", ".join(allowed))
        out[table][name] = _read(name, text, out[table][name])
    return out


def _read(name: str, text: str, usual: Any) -> Any:
    wanted = usual[0] if isinstance(usual, list) else usual
    parts = [part for part in re.split(r"[,;\s]+", text) if part] if isinstance(usual, list) else [text.strip()]
    if isinstance(wanted, float) and any(map(_OF_THOUSANDS.fullmatch, parts)):
        raise InputError(
            "a setting can be read in two ways",
            code="plan.setting",
            where=name,
            got=text[:60],
            allowed="numbers with no sign between their thousands, such as 1000 or 1.5",
        )
    try:
        read = [type(wanted)(part) for part in parts]
        return read if isinstance(usual, list) else read[0]
    except ValueError:
        raise InputError(
            "a setting cannot be read",
            code="plan.setting",
            where=name,
            got=text[:60],
            allowed={int: "a whole number", float: "a number"}.get(type(wanted), "text")
            + (", several separated by commas" if isinstance(usual, list) else ""),
        ) from None


def foretold(
    home: Home, document: Mapping[str, Any], library: Mapping[str, Effect], longest_s: float = math.inf
) -> dict[str, Any]:
    """Return how long a planned test takes, what it would show, and what it could not tell apart, JSON-ready.

    ``longest_s``: what a test of more measuring would show is not computed: time and memory grow with its runs.
    Returns ``name``, ``machine``, ``kind``; ``minutes`` and ``mounting_minutes``; ``lines``; ``findings``;
    ``noise_um``; ``detectable``: effects with the smallest size that is detected with a power of 80 %, null when it is
    not visible; ``alike``: groups of effects that it could not tell apart; both null where the kind cannot tell, or the
    test is too long; ``virtual``: the virtual machine that can be measured at once, else empty.
    Raises ``InputError`` when a rule of the kind is broken.
    """
    planned = planned_document(document, str(document.get("plan", {}).get("name", "the plan")))
    kind = kind_named(planned.kind)
    obs = kind.foreseen(planned) if kind.offers("foreseen") and planned.duration_s <= longest_s else None
    shown = [] if obs is None else detectable(obs, library, noise_um=planned.noise_um)
    virtual = _virtual_machine(home, str(planned.summary["machine"]), kind)
    return {
        "name": planned.summary["name"],
        "machine": planned.summary["machine"],
        "kind": planned.kind,
        "minutes": planned.duration_s / 60.0,
        "mounting_minutes": planned.mounting_s / 60.0,
        "lines": list(planned.lines),
        "findings": [finding.as_dict() for finding in planned.findings],
        "noise_um": planned.noise_um,
        "detectable": None if obs is None else [_size(one.as_dict()) for one in shown],
        "alike": None if obs is None else _alike(obs, library),
        "virtual": "" if virtual is None else virtual[0].name,
        "document": dict(document),
    }


def _size(one: dict[str, Any]) -> dict[str, Any]:
    return {**one, **{name: one[name] if np.isfinite(one[name]) else None for name in ("amplitude", "rms_um")}}


def _alike(obs: Observations, library: Mapping[str, Effect]) -> list[list[str]]:
    """Return groups of effects of which the runs show each almost wholly where they show another one."""
    problem = unweighted(obs, [])
    seen: dict[str, Floats] = {}
    for instance in applicable(library, obs, [])[0]:
        whole = problem.whitened(obs.regressors(instance, instance.effect.start_shape))
        beside = whole - problem.basis @ (problem.basis.T @ whole)
        left, sizes, _ = np.linalg.svd(beside, full_matrices=False)
        visible = left[:, sizes > 1e-6 * max(float(np.linalg.norm(whole)), 1e-12)]
        if visible.shape[1]:
            seen[instance.label] = visible
    groups: list[set[str]] = []
    for label, mine in seen.items():
        mates = {
            other
            for other, theirs in seen.items()
            if other != label and ((theirs.T @ mine) ** 2).sum() >= _ALIKE * min(mine.shape[1], theirs.shape[1])
        }
        if mates:
            touched = [group for group in groups if group & {label, *mates}]
            groups = [group for group in groups if group not in touched]
            groups.append({label, *mates}.union(*touched))
    return [[label for label in seen if label in group] for group in groups]


def _virtual_machine(home: Home, machine: str, kind: Kind) -> tuple[VirtualMachine, dict[str, str], int] | None:
    """Return the virtual machine that a machine is by its newest campaign of a kind, with its options and a seed.

    The seed is another one for each test, where a seed is of noise and set-ups alone, else that of the machine.

    None for a real one, and for a virtual one of which that campaign does not state every option.
    """
    rows = [row for row in Lake(home.lake).runs(machine=machine) if row["kind"] == kind.name]
    if not rows:
        return None
    newest = max(rows, key=lambda row: str(row["ingested"]))["campaign"]
    geometry = campaign_of([row for row in rows if row["campaign"] == newest]).machine_geometry
    virtual = next((one for one in kind.machines if one.type == geometry.get("type") and PLAN in one.options), None)
    if virtual is None or not geometry.get("virtual"):
        return None
    told = {name: str(geometry[name]) for name, values in virtual.options.items() if geometry.get(name) in values}
    # One of which it is not stated what it is like would be another machine.
    if {*told, PLAN} != set(virtual.options):
        return None
    campaigns = {row["campaign"] for row in Lake(home.lake).runs(machine=machine)}
    stated = geometry.get("seed")
    own = stated if isinstance(stated, int) and stated >= 0 else 0
    return virtual, virtual.chosen(told), len(campaigns) if virtual.seeds_measuring else own


def measured_by(home: Home, document: Mapping[str, Any]) -> tuple[str, dict[str, str], int] | None:
    """Return the virtual machine that measures a plan, its options, and a seed; None when a real machine does."""
    planned = planned_document(document, "the plan")
    virtual = _virtual_machine(home, str(planned.summary["machine"]), kind_named(planned.kind))
    return virtual and (virtual[0].name, *virtual[1:])


def keep_plan(home: Home, document: Mapping[str, Any]) -> str:
    """Keep a plan whose measurement is waited for, and return its name.

    Raises ``InputError`` when it breaks a rule, or its name is taken.
    """
    name = free_name(home, planned_document(document, "the plan"))
    write_plan(home, document)
    return name


def free_name(home: Home, planned: Planned) -> str:
    """Return the name of a plan, which no other one and no campaign may have."""
    name = require_name(str(planned.summary["name"]), "plan.name")
    if _place(home, name).exists() or name in Lake(home.lake).campaigns():
        raise InputError(
            "a plan or a campaign of this name is there already",
            code="plan.name",
            got=name,
            hint="give it another name",
        )
    return name


def write_plan(home: Home, document: Mapping[str, Any]) -> None:
    """Write the file of a plan whose rules and name were checked."""
    path = _place(home, str(document["plan"]["name"]))
    make_folder(path.parent)
    write_text(path, tomli_w.dumps(dict(document)), "the plan")


def _place(home: Home, name: str) -> Path:
    return home.plans / f"{require_name(name, 'the plan')}.toml"


def drop_plan(home: Home, name: str) -> None:
    """Take a plan back; the campaign that answered it stays."""
    _kept(home, name).unlink()


def kept_plan(home: Home, name: str) -> dict[str, Any]:
    """Return a plan that was kept, as TOML is read."""
    return read_plan_file(_kept(home, name))


def _kept(home: Home, name: str) -> Path:
    path = _place(home, name)
    if not path.exists():
        names = ", ".join(sorted(path.stem for path in home.plans.glob("*.toml")))
        raise InputError("no such plan", code="plan.unknown", got=name, allowed=names or "none")
    return path


def kept_plans(home: Home, machine: str) -> list[dict[str, Any]]:
    """Return the plans of a machine, the newest first, each with the campaign that answered it, JSON-ready.

    A campaign answers a plan when it has its name; else the first one that came in later, of the same machine and kind, and
    with all its conditions.

    Returns ``name``, ``kind``, ``made`` (ISO 8601) and ``answer``, empty while it waits.
    """
    made = sorted(_plans_of(home, machine), key=lambda plan: plan[0], reverse=True)
    if not made:
        return []
    rows = by_campaign(Lake(home.lake).runs(machine=machine))
    taken = {planned.summary["name"] for _, planned in made} & set(rows)
    out = []
    for when, planned in reversed(made):
        name = str(planned.summary["name"])
        answer = name if name in rows else _answer(planned, when, rows, taken)
        taken.add(answer)
        out.append({"name": name, "kind": planned.kind, "made": when, "answer": answer})
    return out[::-1]


def _plans_of(home: Home, machine: str) -> Iterator[tuple[str, Planned]]:
    for path in home.plans.glob("*.toml"):
        try:
            planned = planned_document(read_plan_file(path), str(path))
        except DtwinError:  # Somebody changed the file: `dtwin plan FILE` says what is wrong.
            continue
        if planned.summary["machine"] == machine:
            when = datetime.fromtimestamp(path.stat().st_mtime, UTC)
            yield when.isoformat(timespec="seconds"), planned


def _answer(planned: Planned, when: str, rows: Mapping[str, Sequence[Mapping[str, Any]]], taken: set[str]) -> str:
    kind = kind_named(planned.kind)
    if not kind.offers("foreseen"):
        return ""
    wanted = {_where(meta) for meta in kind.foreseen(planned).runs}
    later = [
        (str(mine[0]["ingested"]), name)
        for name, mine in rows.items()
        if name not in taken
        and mine[0]["kind"] == planned.kind
        and str(mine[0]["ingested"])[:19] > when[:19]
        and wanted <= {_where(meta_of(row)) for row in mine}
    ]
    return min(later)[1] if later else ""


def _where(meta: RunMeta) -> _Where:
    """Return what a plan and its measurement must agree on."""
    return meta.plane, meta.radius_mm, meta.feed_mm_min, meta.condition.get("axis")


def drafting_kinds() -> list[str]:
    """Return the kinds that have a form for a plan."""
    return [kind.name for kind in kinds() if kind.offers("draft")]
