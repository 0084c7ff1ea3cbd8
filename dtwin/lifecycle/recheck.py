"""Check a champion again on the machine as it is now; release and roll back when it harms."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from dtwin.config import Home
from dtwin.errors import InputError
from dtwin.kinds.machine import EvidenceRequest, VirtualMachine
from dtwin.lifecycle.evidence import compute, keep_looked, look, virtual_of
from dtwin.lifecycle.train import geometry_of
from dtwin.progress import Progress, silent
from dtwin.serve.bundle import Bundle
from dtwin.serve.pointer import renew_proof
from dtwin.train.closed_loop import WITHOUT, Evidence
from dtwin.train.evidence_record import newest
from dtwin.train.promotion import withdraw
from dtwin.train.registry import RegisteredVersion, Registry
from dtwin.train.still_helps import Recheck, judge, judge_evidence

if TYPE_CHECKING:
    from dtwin.lifecycle.evidence import Looked
    from dtwin.train.still_helps import CheckedRun

# Days after those of the evidence for promotion: copies of its runs would prove nothing.
_LATER = 500


@dataclass(frozen=True)
class Rechecked:
    """A check and what came of it.

    ``withdrawn``: whether the champion was withdrawn; sessions that serve it release within a second or two.
    ``restored``: version that is champion now, empty when nothing is served any more.
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
    virtual: VirtualMachine | None = None,
    blocks: int = 3,
    seed: int = 0,
    progress: Progress = silent,
) -> Rechecked:
    """Judge a champion by runs with and without it, and withdraw it when it harms.

    ``without``, ``with_``: campaigns in the lake that were measured without and with it, as for ``dtwin evidence``;
    when none is named the virtual machine is measured, or, where nothing can be served on it, predicted.
    ``virtual``: the virtual machine as it is now; by default that of its type, as it was.
    ``blocks``: passes over all conditions, where it is measured by pairs.
    ``seed``: of the virtual machine, of order and noise.
    Raises ``InputError`` when there is no champion, or the machine is real and no campaigns are named.
    """
    champion = Registry(home).version(machine, "champion")
    if without or with_:
        evidence = compute(home, champion, without, with_)
        return _settled(home, champion, evidence.runs, judge_evidence(evidence))
    looked = look_again(home, champion, virtual=virtual, blocks=blocks, seed=seed, progress=progress)
    return settled(home, champion, looked)


def left_out(registry: Registry, machine: str) -> str:
    """Return why the champion of a machine cannot be checked from here, empty when it can."""
    champion = registry.champion(machine)
    if champion is None:
        return "no champion"
    if not geometry_of(registry, champion).get("virtual", False):
        return "a real machine has to be measured: dtwin campaign --with champion, then dtwin recheck"
    return ""


def look_again(
    home: Home,
    champion: RegisteredVersion,
    *,
    virtual: VirtualMachine | None = None,
    blocks: int = 3,
    seed: int = 0,
    progress: Progress = silent,
) -> list[CheckedRun] | Looked:
    """Measure a virtual machine with and without its champion: by pairs where it takes them; nothing is written."""
    registry = Registry(home)
    geometry = geometry_of(registry, champion)
    if not geometry.get("virtual", False):
        raise InputError(
            "what a correction does to this machine has to be measured on it",
            code="recheck.real",
            where=f"machine {champion.machine}",
            hint="dtwin campaign --with champion, then: dtwin recheck --without C --with C",
        )
    known = virtual or virtual_of(geometry)
    if known.offers("prediction") or not known.offers("checked"):
        return look(home, champion, seed=_LATER + seed, progress=progress)
    bundle = Bundle.from_dict(registry.bundle(champion))
    return known.checked(EvidenceRequest(registry, champion, bundle, geometry, None, seed, progress), blocks)


def settled(home: Home, champion: RegisteredVersion, looked: list[CheckedRun] | Looked) -> Rechecked:
    """Judge a champion by what :func:`look_again` saw, keep it, and withdraw the champion when it harms."""
    if isinstance(looked, list):
        return _settled(home, champion, [vars(run) for run in looked], judge(looked))
    kept = newest(Registry(home), champion)
    before = set(kept.content["campaigns"].get(WITHOUT, ())) if kept is not None else set()
    evidence = keep_looked(home, champion, looked)
    if not isinstance(looked, Evidence):
        return _settled(home, champion, evidence.runs, judge_evidence(evidence))
    # A prediction uses every campaign: what no evidence held before is what judges.
    conditions = tuple(c for c in evidence.conditions if c["campaign"] not in before)
    if not conditions:
        raise InputError(
            "every campaign has judged this champion before",
            code="recheck.campaign",
            where=f"machine {champion.machine}",
            got=", ".join(sorted(before))[:80],
            hint="measure it without a correction once more, and dtwin ingest the campaign",
        )
    runs = [run for run in evidence.runs if run["campaign"] not in before]
    return _settled(home, champion, runs, judge_evidence(replace(evidence, conditions=conditions)))


def _settled(
    home: Home, champion: RegisteredVersion, given: Sequence[Mapping[str, Any]], checked: Recheck
) -> Rechecked:
    registry = Registry(home)
    now = datetime.now(UTC)
    stamp = now.strftime("%Y%m%d-%H%M%S")
    record = checked.as_dict() | {"runs": [dict(run) for run in given]}
    withdrawn, restored = False, None
    if checked.verdict == "worse":
        _, restored = withdraw(registry, home, champion, checked.reason)
        withdrawn = True
    if checked.verdict == "helps":
        proved = now.isoformat(timespec="seconds")
        renew_proof(champion.machine, home, int(champion.version), proved)
        registry.mark(champion, {"proved": proved})
    registry.attach(champion, {f"recheck-{stamp}.json": json.dumps(record, indent=1)})
    registry.mark(champion, {"recheck": f"{stamp} {checked.verdict}: {checked.reason}"[:500]})
    return Rechecked(champion, checked, withdrawn, restored.version if restored else "", len(given))
