"""From a registered version to the bundle that is served, and back."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from dtwin.config import Home
from dtwin.errors import GateRefusal, InputError, StoreError, in_a_line
from dtwin.kinds.registry import kind_of, machine_of_type
from dtwin.locks import locked
from dtwin.machine_record import changed_since
from dtwin.people import acting, read_people
from dtwin.schema import require_name
from dtwin.serve.bundle import Bundle
from dtwin.serve.bundle_file import replace_bundle, save_bundle
from dtwin.serve.pointer import clear_trial, on_trial, proven_states, resolve, write_machine, write_pointer
from dtwin.serve.withdrawn import serve_again, stop_serving, withdrawn_why
from dtwin.shared_documents import follow_shared
from dtwin.train.closed_loop import Evidence
from dtwin.train.evidence_record import Record, contrary, records
from dtwin.train.gates import Verdict, evidence_gate
from dtwin.train.promotion_books import bundle_path, by_pointer, enter, history, remember, require_comment, was_champion
from dtwin.train.registry import FAULTS, RegisteredVersion, Registry, model_name

# Tag of a version that may be tried but never become champion; its value says why.
TRIAL_ONLY = "trial_only"


def check_version(registry: Registry, version: RegisteredVersion) -> tuple[Bundle, list[Verdict]]:
    """Return a version's bundle and the verdicts of the offline gates."""
    bundle = Bundle.from_dict(registry.bundle(version))
    if bundle.machine != version.machine:
        raise GateRefusal(
            "the bundle is for another machine", code="promote.machine", got=bundle.machine, allowed=version.machine
        )
    verdicts = kind_of(bundle).gates(bundle, registry.metrics(version))
    withdrawn = version.tags.get("state") == "withdrawn"
    verdicts.append(Verdict("not withdrawn", not withdrawn, version.tags.get("state", "candidate")))
    return bundle, verdicts


def promote(
    registry: Registry,
    home: Home,
    version: RegisteredVersion,
    *,
    geometry: Mapping[str, Any],
    evidence: Evidence | None,
    despite: Sequence[str] = (),
    comment: str = "",
    valid_days: float = 0.0,
) -> Path:
    """Make a version the champion of its machine, or refuse with the reasons.

    ``geometry``: the machine's geometry, for the serving host.
    ``evidence``: closed-loop evidence, computed from runs just now; without it nothing becomes champion.
    ``despite``: names of the evidence on record that speaks against the version; all of it must be named.
    ``valid_days``: how long the evidence holds; 0 for ever.
    Returns the served bundle.
    Raises ``GateRefusal`` when a gate says no.
    """
    require_comment(comment)
    bundle, verdicts = check_version(registry, version)
    if version.tags.get(TRIAL_ONLY):
        verdicts.append(Verdict("the twin is confirmed", False, version.tags[TRIAL_ONLY]))
    proved = ""
    if evidence is None:
        verdicts.append(Verdict("closed-loop evidence", False, "none: measure it on trial first"))
    else:
        real = not bool(geometry.get("virtual", False))
        kept = records(registry, version)
        proved = _proved(evidence, kept)
        verdicts += evidence_gate(evidence, bundle, real=real)
        verdicts += _against(kept, despite)
        changed = changed_since(home, version.machine, proved)
        doubt = changed_since(home, version.machine, proved, doubtful=True)
        which = f"; {doubt}: if that came after the evidence, measure again" if doubt and not changed else ""
        told = f"{changed or 'no event'} after the evidence of {proved[:10]}{which}"
        verdicts.append(Verdict("machine unchanged since the evidence", not changed, told))
    _record_verdicts(registry, version, verdicts)
    if not all(v.passed for v in verdicts):
        remember(home, version, "refused", comment, verdicts, despite)
        raise _refusal(version, verdicts)
    _require_second_person(home, version, comment, verdicts)
    kind = evidence.kind if evidence else "none"
    with _alone(home, version.machine):
        previous = by_pointer(registry, home, version.machine)
        _write_machine(version.machine, home, geometry)
        path = _freeze(home, version, bundle, verdicts, kind, valid_days)
        serve_again(version.machine, home, int(version.version))
        write_pointer(version.machine, home, path, int(version.version), "champion", proved)
        if on_trial(version.machine, home) == int(version.version):
            # Its bundle now states the evidence, so that the trial's checksum is no longer the file's.
            clear_trial(version.machine, home)
        # Another computer may have promoted at the same time: then nothing is written in the books.
        follow_shared(home)
        enter(registry, previous, version, kind, proved)
        remember(home, version, "champion", comment, verdicts, despite)
    return path


def trial(
    registry: Registry, home: Home, version: RegisteredVersion, *, geometry: Mapping[str, Any], comment: str = ""
) -> Path:
    """Put a version on trial: served only with ``--trial``, under a tight clamp.

    Raises ``GateRefusal`` when an offline gate says no.
    """
    require_comment(comment)
    bundle, verdicts = check_version(registry, version)
    _record_verdicts(registry, version, verdicts)
    if not all(v.passed for v in verdicts):
        remember(home, version, "refused", comment, verdicts)
        raise _refusal(version, verdicts)
    path = bundle_path(home, version)
    with _alone(home, version.machine):
        by_pointer(registry, home, version.machine)
        version = registry.version(version.machine, version.version)
        # What is champion, or may be again, keeps its bundle with the evidence: its pointer names the checksum.
        if not (version.tags.get("evidence") and path.is_file()):
            path = _freeze(home, version, bundle, verdicts, "none")
        _write_machine(version.machine, home, geometry)
        write_pointer(version.machine, home, path, int(version.version), "trial")
        if version.tags.get("state") not in ("champion", "previous"):
            registry.mark(version, {"state": "trial"})
        remember(home, version, "trial", comment, verdicts)
    return path


def rollback(registry: Registry, home: Home, machine: str, comment: str = "") -> RegisteredVersion | None:
    """Bar the champion and restore the one before it; without one None, and nothing is served any more.

    Raises ``InputError`` when the machine has neither.
    """
    require_comment(comment)
    with _alone(home, machine):
        return _roll_back(registry, home, machine, by_pointer(registry, home, machine), comment)


def withdraw(
    registry: Registry, home: Home, judged: RegisteredVersion, reason: str
) -> tuple[RegisteredVersion, RegisteredVersion | None]:
    """Take a champion away as ``rollback`` does. When another one became champion meanwhile, that stays.

    ``reason``: why; kept in the history, in the registry and beside the bundles.
    Returns ``withdrawn``, ``restored``: the version that was withdrawn, and the champion from now on, None when there is
    none.
    """
    machine = judged.machine
    with _alone(home, machine):
        # First what moves the machine, then the books.
        stop_serving(machine, home, int(judged.version), reason)
        champion = by_pointer(registry, home, machine)
        if champion is None or champion.version == judged.version:
            return judged, _roll_back(registry, home, machine, judged, reason)
        registry.mark(judged, {"state": "withdrawn", "withdrawn_why": reason[:500]})
        remember(home, judged, "rollback", reason, [])
        return judged, champion


@contextlib.contextmanager
def _alone(home: Home, machine: str) -> Iterator[None]:
    """Wait for others that promote or roll back: pointer and books of one come before those of the next.

    Raises ``StoreError`` that says which version is in force, when not all could be written: the pointer is moved first.
    """
    with locked(home.root / "locks" / f"promote-{require_name(machine, 'the machine')}.lock", wait=True):
        try:
            yield
        except (StoreError, *FAULTS) as error:
            raise StoreError(
                "not all of it could be written",
                code="promote.unfinished",
                where=f"machine {machine}; in force now: {_in_force(home, machine)}",
                got=getattr(error, "got", None) or in_a_line(error),
                hint="see that there is free space and that the registry answers, then run this again",
            ) from error


def _in_force(home: Home, machine: str) -> str:
    """Return which versions a machine may be served with, in words."""
    told = []
    for model in ("latest", "trial"):
        with contextlib.suppress(InputError, GateRefusal):
            resolved = resolve(model, machine, home)
            told.append(f"version {resolved.version} ({resolved.state})")
    return ", ".join(told) or "no version"


def _roll_back(
    registry: Registry, home: Home, machine: str, present: RegisteredVersion | None, comment: str
) -> RegisteredVersion | None:
    previous = _previous(registry, home, machine)
    if previous is not None:
        proved = previous.tags.get("proved", "")
        write_pointer(machine, home, bundle_path(home, previous), int(previous.version), "champion", proved)
    elif present is not None:
        write_pointer(machine, home, bundle_path(home, present), int(present.version), "withdrawn")
    else:
        raise InputError(
            "there is no champion, and none before it to go back to",
            code="rollback.none",
            where=f"machine {machine}",
            hint="dtwin models shows the history",
        )
    replaced = present is not None and (previous is None or present.version != previous.version)
    if present is not None and replaced:
        stop_serving(machine, home, int(present.version), comment or "rolled back")
    if previous is not None:
        registry.mark(previous, {"state": "champion"}, alias="champion")
    if present is not None and replaced:
        registry.mark(present, {"state": "withdrawn", "withdrawn_why": comment[:500]})
        remember(home, present, "rollback", comment, [])
    # Last: a rollback that a kill cut off before is done again, one that was done goes back no further.
    registry.client.delete_registered_model_alias(model_name(machine), "champion" if previous is None else "previous")
    return None if previous is None else registry.version(machine, previous.version)


def _previous(registry: Registry, home: Home, machine: str) -> RegisteredVersion | None:
    """Return the champion before the present one, if it may be served again."""
    try:
        previous = registry.version(machine, "previous")
    except InputError:
        return None
    return (
        previous if was_champion(home, previous) and not withdrawn_why(machine, home, int(previous.version)) else None
    )


def _require_second_person(home: Home, version: RegisteredVersion, comment: str, verdicts: Sequence[Verdict]) -> None:
    """Let a promotion that two people must want wait for the second.

    Raises ``GateRefusal`` when nobody else proposed this version since the last that was decided.
    """
    if not read_people(home).second_person:
        return
    said = history(home, version.machine)
    decided = max((k for k, e in enumerate(said) if e["action"] in ("champion", "rollback")), default=-1)
    proposed = [e for e in said[decided + 1 :] if e["action"] == "proposed" and e["version"] == version.version]
    if any(e.get("who") not in (None, acting()) for e in proposed):
        return
    if not proposed:
        remember(home, version, "proposed", comment, verdicts)
    raise GateRefusal(
        f"version {version.version} of {version.machine} passed, and waits for a second person",
        code="promote.second",
        where=f"machine {version.machine}",
        got=f"proposed by {acting()}",
        hint="another person promotes the same version, at the workbench or by dtwin promote",
    )


def listed(registry: Registry, home: Home, machine: str | None = None) -> list[tuple[RegisteredVersion, str]]:
    """Return the versions of a machine, of all without one, each with the state in which serving would take it."""
    every = registry.every_version() if machine is None else {machine: registry.versions(machine)}
    return [pair for versions in every.values() for pair in zip(versions, _states(versions, home), strict=True)]


def state_of(version: RegisteredVersion, home: Home) -> str:
    """Return the state in which serving would take a version, whatever its tags say."""
    return _states([version], home)[0]


def _states(versions: Sequence[RegisteredVersion], home: Home) -> list[str]:
    """Return the states of versions of one machine."""
    tagged = {int(v.version): v.tags.get("state", "candidate") for v in versions}
    states = proven_states(versions[0].machine, tagged, home) if versions else {}
    return [states[number] for number in tagged]


def verdict_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """Return verdicts as lines of text."""
    return [f"{'pass' if v.passed else 'FAIL'}  {v.gate}: {v.reason}" for v in verdicts]


def _against(kept: Sequence[Record], despite: Sequence[str]) -> list[Verdict]:
    """Judge whether every record that speaks against a version is known to who promotes it."""
    against = contrary(kept)
    known = {record.id for record in against}
    strange = [name for name in despite if name not in known]
    if strange:
        raise InputError(
            "no such evidence against the version",
            code="promote.despite",
            got=", ".join(strange)[:200],
            allowed=", ".join(sorted(known)) or "there is none",
        )
    if not against:
        return []
    told = "; ".join(f"{r.id} of {r.time[:19]}: worse at {', '.join(r.worse)}" for r in against)
    return [Verdict("evidence against it is named", known <= set(despite), told)]


def _write_machine(machine: str, home: Home, geometry: Mapping[str, Any]) -> None:
    """Keep what the serving host must know; only robots have a chain and a tool to know of."""
    known = machine_of_type(geometry.get("type"))
    if known.robot if known else "tcp_mm" in geometry:
        write_machine(machine, home, dict(geometry))


def _freeze(
    home: Home,
    version: RegisteredVersion,
    bundle: Bundle,
    verdicts: Sequence[Verdict],
    kind: str,
    valid_days: float = 0.0,
) -> Path:
    provenance = dataclasses.replace(
        bundle.provenance,
        mlflow_version=version.version,
        evidence=kind,
        gates={v.gate: v.passed for v in verdicts},
        valid_days=valid_days,
    )
    frozen = dataclasses.replace(bundle, model_version=int(version.version), provenance=provenance)
    path = bundle_path(home, version)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_bundle(path, partial(save_bundle, frozen, path))
    return path


def _record_verdicts(registry: Registry, version: RegisteredVersion, verdicts: Sequence[Verdict]) -> None:
    passed = all(v.passed for v in verdicts)
    registry.mark(version, {"gates": "passed" if passed else "refused"})
    registry.attach(version, {"gates.txt": "\n".join(verdict_lines(verdicts)) + "\n"})


def _refusal(version: RegisteredVersion, verdicts: Sequence[Verdict]) -> GateRefusal:
    failed = [f"{v.gate}: {v.reason}" for v in verdicts if not v.passed]
    return GateRefusal(
        f"version {version.version} of {version.machine} is not promoted",
        code="promote.refused",
        got="; ".join(failed),
        hint="dtwin train makes another candidate; evidence that is known to speak against it is named by --despite",
    )


def _proved(evidence: Evidence, kept: Sequence[Record]) -> str:
    """Return when a correction was last seen to help: when its newest runs were measured.

    A virtual machine keeps no calendar: there it is when the evidence was computed, the last of what is kept.
    """
    real = evidence.runs if evidence.kind == "real" else ()
    started = [run["started"] for run in real if run["way"] == "with" and run["started"]]
    computed = kept[-1].time if kept else datetime.now(UTC).isoformat()
    return max(started, default=f"{computed[:19]}+00:00")
