"""Check a champion again on the machine as it is now; release and roll back when it harms."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.machines.cobot import VirtualCobot
from dtwin.pipeline.modelling import CONDITIONS_FILE, evidence_of, geometry_of
from dtwin.serve.bundle import Bundle
from dtwin.serve.machine_file import MACHINE_TYPES
from dtwin.train.evidence import plan_within
from dtwin.train.promotion import withdraw
from dtwin.train.recheck import CheckedRun, Recheck, interleaved_runs, judge, read_runs
from dtwin.train.registry import RegisteredVersion, Registry

_MAX_BYTES = 10_000_000


@dataclass(frozen=True)
class Rechecked:
    """A check and what came of it.

    Attributes
    ----------
    version : RegisteredVersion
        The champion that was checked.
    found : Recheck
        The verdict.
    withdrawn : bool
        Whether the champion was barred; sessions that serve it release within a second or two.
    restored : str
        Version that is champion now, empty when nothing is served any more.
    runs : int
        Number of circles.
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
    runs: Sequence[CheckedRun] | None = None,
    cobot: VirtualCobot | None = None,
    blocks: int = 3,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
) -> Rechecked:
    """Judge a champion by circles with and without it, and withdraw it when it harms.

    Parameters
    ----------
    home : Home
        Registry and bundles.
    machine : str
        The machine.
    runs : sequence of CheckedRun, optional
        Circles that were measured on a real machine; without, the virtual cobot is measured.
    cobot : VirtualCobot, optional
        The virtual machine as it is now; by default the one of the seed, as it was.
    blocks : int
        Passes over all conditions.
    seed : int
        Of the virtual machine, of order and noise.
    progress : callable, optional
        Called with (done, total, what).

    Raises
    ------
    InputError
        When there is no champion, or the machine is real and no runs are given.
    """
    registry = Registry(home)
    champion = registry.version(machine, "champion")
    given = list(runs) if runs is not None else None
    if given is None:
        given = _measure(registry, champion, cobot, blocks, seed, progress)
    found = judge(given)
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    record = found.as_dict() | {"runs": [vars(run) for run in given]}
    withdrawn, restored = False, None
    if found.verdict == "worse":
        _, restored = withdraw(registry, home, machine, found.reason)
        withdrawn = True
    registry.attach(champion, {f"recheck-{stamp}.json": json.dumps(record, indent=1)})
    registry.mark(champion, {"recheck": f"{stamp} {found.verdict}: {found.reason}"[:500]})
    return Rechecked(champion, found, withdrawn, restored.version if restored else "", len(given))


def runs_file(path: Path) -> list[CheckedRun]:
    """Return the runs that were measured on a real machine.

    Raises
    ------
    InputError
        When the file cannot be read or holds something else.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError("too large")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            "the runs cannot be read", code="recheck.file", where=str(path), got=str(error)[:160]
        ) from error
    return read_runs(content, str(path))


def _measure(
    registry: Registry,
    champion: RegisteredVersion,
    cobot: VirtualCobot | None,
    blocks: int,
    seed: int,
    progress: Callable[[int, int, str], None] | None,
) -> list[CheckedRun]:
    geometry = geometry_of(registry, champion)
    if not geometry.get("virtual", False) or geometry.get("type") not in MACHINE_TYPES:
        raise InputError(
            "this machine's circles have to be measured on it",
            code="recheck.real",
            where=f"machine {champion.machine}",
            hint="measure each circle with and without the correction, in random order, and give "
            "the runs with --runs FILE",
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
    kept = evidence_of(registry, champion)
    if kept is not None:
        rows = kept["conditions"]
        return [(str(c["plane"]), float(c["radius_mm"]), float(c["feed_mm_min"])) for c in rows]
    trained = registry.read_json(champion, CONDITIONS_FILE)
    return list(plan_within([(str(p), float(r), float(f)) for p, r, f in trained]).conditions)
