"""Check a champion again on the machine as it is now; release and roll back when it harms."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.lifecycle.evidence import compute
from dtwin.lifecycle.train import geometry_of
from dtwin.machines.cobot import VirtualCobot
from dtwin.progress import Progress
from dtwin.serve.bundle import Bundle
from dtwin.serve.machine_file import MACHINE_TYPES
from dtwin.serve.pointer import renew_proof
from dtwin.train.circle_evidence import plan_within
from dtwin.train.evidence_record import newest
from dtwin.train.promotion import withdraw
from dtwin.train.recheck import CheckedRun, Recheck, interleaved_runs, judge, judge_evidence
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.results import CONDITIONS_FILE


@dataclass(frozen=True)
class Rechecked:
    """A check and what came of it.

    Attributes
    ----------
    withdrawn : bool
        Whether the champion was barred; sessions that serve it release within a second or two.
    restored : str
        Version that is champion now, empty when nothing is served any more.
    """

    version: RegisteredVersion
    found: Recheck
    withdrawn: bool
    restored: str
    runs: int

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-ready mapping."""
        return {
            "machine": self.version.machine,
            "version": self.version.version,
            "withdrawn": self.withdrawn,
            "restored": self.restored or None,
            "runs": self.runs,
            **self.found.as_dict(),
        }


def recheck(
    home: Home,
    machine: str,
    *,
    without: Sequence[str] = (),
    with_: Sequence[str] = (),
    cobot: VirtualCobot | None = None,
    blocks: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> Rechecked:
    """Judge a champion by circles with and without it, and withdraw it when it harms.

    Parameters
    ----------
    without, with_ : sequence of str
        Campaigns in the lake that were measured without and with it, as for ``dtwin evidence``;
        when none is named the virtual cobot is measured.
    cobot : VirtualCobot, optional
        The virtual machine as it is now; by default the one of the seed, as it was.
    blocks : int
        Passes over all conditions.
    seed : int
        Of the virtual machine, of order and noise.

    Raises
    ------
    InputError
        When there is no champion, or the machine is real and no campaigns are named.
    """
    registry = Registry(home)
    champion = registry.version(machine, "champion")
    given: Sequence[Mapping[str, Any]]
    if without or with_:
        evidence = compute(home, champion, without, with_)
        given, found = evidence.runs, judge_evidence(evidence)
    else:
        circles = _measure(registry, champion, cobot, blocks, seed, progress)
        given, found = [vars(run) for run in circles], judge(circles)
    now = datetime.now(UTC)
    stamp = now.strftime("%Y%m%d-%H%M%S")
    record = found.as_dict() | {"runs": [dict(run) for run in given]}
    withdrawn, restored = False, None
    if found.verdict == "worse":
        _, restored = withdraw(registry, home, machine, found.reason)
        withdrawn = True
    if found.verdict == "helps":
        proved = now.isoformat(timespec="seconds")
        renew_proof(machine, home, int(champion.version), proved)
        registry.mark(champion, {"proved": proved})
    registry.attach(champion, {f"recheck-{stamp}.json": json.dumps(record, indent=1)})
    registry.mark(champion, {"recheck": f"{stamp} {found.verdict}: {found.reason}"[:500]})
    return Rechecked(champion, found, withdrawn, restored.version if restored else "", len(given))


def _measure(
    registry: Registry,
    champion: RegisteredVersion,
    cobot: VirtualCobot | None,
    blocks: int,
    seed: int,
    progress: Progress | None,
) -> list[CheckedRun]:
    geometry = geometry_of(registry, champion)
    if not geometry.get("virtual", False) or geometry.get("type") not in MACHINE_TYPES:
        raise InputError(
            "this machine's circles have to be measured on it",
            code="recheck.real",
            where=f"machine {champion.machine}",
            hint="dtwin campaign --with champion, then: dtwin recheck --without C --with C",
        )
    return interleaved_runs(
        Bundle.from_dict(registry.bundle(champion)),
        cobot or VirtualCobot(seed=seed),
        tcp_mm=np.asarray(geometry.get("tcp_mm", [0.0, 0.0, 0.0]), float),
        conditions=_conditions(registry, champion),
        blocks=blocks,
        seed=seed,
        progress=progress,
    )


def _conditions(registry: Registry, champion: RegisteredVersion) -> list[tuple[str, float, float]]:
    """Return the circles of its promotion, or without evidence those that it was trained for."""
    kept = newest(registry, champion)
    if kept is not None:
        rows = kept.content["conditions"]
        return [(str(c["plane"]), float(c["radius_mm"]), float(c["feed_mm_min"])) for c in rows]
    trained = registry.read_json(champion, CONDITIONS_FILE)
    return list(plan_within([(p, float(r), float(f)) for p, r, f in trained]).conditions)
