"""Which test of a machine tells most for its time: proposals of every kind, by bits per minute."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.kind import Planned
from dtwin.kinds.registry import kind_named, kinds
from dtwin.lake.store import Lake
from dtwin.local_time import local_day
from dtwin.machine_record import MachineRecord
from dtwin.physics.effect import Effect
from dtwin.physics.library import Library
from dtwin.physics.next_test import Knowledge, Made, Unknown, unclear
from dtwin.physics.observations import Observations
from dtwin.physics.state import AXES_OF
from dtwin.pipeline.machine_history import record_of
from dtwin.pipeline.machine_joint import compared, newest_tests
from dtwin.pipeline.planned_tests import draft_of
from dtwin.plan_file import planned_document
from dtwin.progress import Progress, silent
from dtwin.twins.measured import load

_USUAL_AXES = "XYZ"


def machine_next(
    home: Home,
    machine: str,
    allowed: Sequence[str] = (),
    minutes: float | None = None,
    progress: Progress = silent,
    library: Mapping[str, Effect] | None = None,
) -> dict[str, Any]:
    """Return the tests that could be made next, JSON-ready, most bits per minute first.

    ``allowed``: kinds of test for which there is an instrument; all without.
    ``minutes``: longest time, mounting the instrument included.
    Returns ``machine``; ``measured``: campaigns that count, the newest of each kind with the same planes or axes;
    ``passed_over``: those of them that cannot have a twin, with the reason;
    ``unclear``: groups of effects that they find and do not tell apart; ``untold``: causes whose size they do not tell;
    ``tests``: ``name``, ``kind``, ``minutes``, ``bits``, ``bits_per_minute``, ``told`` and ``document``, the plan file.
    Raises ``InputError`` when the machine is not known, a kind proposes no tests, or none is short enough.
    """
    lake, known = Lake(home.lake), Library() if library is None else library
    rows = lake.runs(left_out=True, machine=machine)
    record = record_of(home, machine, rows)
    chosen = newest_tests(rows, machine)
    together: Mapping[str, Any] = (
        compared(home, machine, chosen, known, progress) if chosen else {"tests": [], "settled": [], "passed_over": {}}
    )
    counted, groups = [test["campaign"] for test in together["tests"]], _groups(together)
    every = [load(home, name).obs for name in counted]
    measured = [Made(obs, left) for obs, left in zip(every, unclear(groups, every, known), strict=True)]
    plans = _proposed(record, allowed, [test.obs for test in measured])
    within = [(p, document) for p, document in plans if minutes is None or _minutes(p) <= minutes]
    if not plans:
        raise InputError(
            "no kind of test proposes anything for these axes",
            code="machine.proposals",
            where=machine,
            got=", ".join(record.axes) or "no axis",
            hint=f"dtwin machine add {machine} --axis X:travel_mm=500 --axis Y:travel_mm=400",
        )
    if not within:
        raise InputError(
            "no proposed test is that short",
            code="machine.minutes",
            where=machine,
            got=f"{minutes:g} min",
            allowed=f"{min(_minutes(p) for p, _ in plans):z.0f} min or more, mounting included",
        )
    planned = [kind_named(p.kind).foreseen(p) for p, _ in within]
    noise_um = {p.kind: p.noise_um for p, _ in within}
    # A test without repeats has the usual noise of its kind, also of one that nothing is proposed of.
    for kind in {test.obs.grid.kind for test in measured} - set(noise_um):
        noise_um[kind] = planned_document(draft_of(home, machine, kind), kind).noise_um
    knowledge = Knowledge(measured, planned, known, noise_um)
    tests = []
    for number, (plan, document) in enumerate(within):
        worth = knowledge.worth(number)
        tests.append(
            {
                "name": document["plan"]["name"],
                "kind": plan.kind,
                "minutes": _minutes(plan),
                "bits": worth.bits,
                "bits_per_minute": worth.bits / _minutes(plan),
                "told": [gain.as_dict() for gain in worth.told],
                "document": document,
            }
        )
    return {
        "machine": machine,
        "measured": counted,
        "passed_over": together["passed_over"],
        "unclear": list(dict.fromkeys(_by_axis(group, known) for test in measured for group in test.unclear)),
        "untold": _by_cause(knowledge.untold),
        "tests": sorted(tests, key=lambda test: -test["bits_per_minute"]),
    }


def _groups(together: Mapping[str, Any]) -> list[list[list[str]]]:
    """Return what each test found, settled by the others."""
    left = {(s["campaign"], tuple(s["group"])): s["left"] for s in together["settled"]}
    return [[left.get((t["campaign"], tuple(g))) or g for g in t["found"]] for t in together["tests"]]


def _by_axis(group: Sequence[str], library: Mapping[str, Effect]) -> tuple[str, ...]:
    """Return a group; of a difference of two axes that was found alone, the effect on each of them."""
    if len(group) > 1:
        return tuple(group)
    name, _, plane = group[0].partition(" ")
    alike = [e.name for e in library.values() if e.cause == library[name].cause and e.per == "axis"]
    return tuple(f"{other} {axis}" for axis in AXES_OF[plane] for other in alike[:1])


def _by_cause(unknowns: Sequence[Unknown]) -> list[str]:
    """Return each cause once, with its axes."""
    axes: dict[str, dict[str, None]] = {}
    for unknown in unknowns:
        axes.setdefault(unknown.name, {})[unknown.axis] = None
    return [f"{name} {', '.join(filter(None, of))}".rstrip() for name, of in axes.items()]


def _minutes(plan: Planned) -> float:
    return (plan.duration_s + plan.mounting_s) / 60.0


def _proposed(
    record: MachineRecord, allowed: Sequence[str], measured: Sequence[Observations]
) -> list[tuple[Planned, dict[str, Any]]]:
    """Return plans with their documents, named after machine and day so that each becomes a campaign of its own."""
    axes: Mapping[str, Mapping[str, float]] = (
        record.reach or {axis: {} for obs in measured for axis in obs.axes} or {axis: {} for axis in _USUAL_AXES}
    )
    day = local_day().isoformat()
    out = []
    for kind in [kind_named(name) for name in allowed] or [kind for kind in kinds() if kind.offers("proposals")]:
        for document in kind.proposals(record.name, axes):
            named = {**document["plan"], "name": f"{record.name}-{document['plan']['name']}-{day}"}
            made = {**document, "plan": named}
            out.append((planned_document(made, named["name"]), made))
    return out
